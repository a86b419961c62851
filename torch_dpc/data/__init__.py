"""Recorded data: Hankel matrices, from recordings or streams, and their row space."""
