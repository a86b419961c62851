"""The benchmark: its problems, rows, reference in higher precision, and report."""
