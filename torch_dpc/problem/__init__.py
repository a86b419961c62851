"""The problem: its rows, weights and terms, its reduction, and the paper's own form."""
