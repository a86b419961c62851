"""Attacks on the measurements."""
