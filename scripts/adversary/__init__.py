"""Trained adversaries: losses, training, judging and report."""
