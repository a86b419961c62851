"""Tuned weights: searches, judging and report."""
