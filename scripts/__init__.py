"""Figures, tables and studies: one module each, run from the repository's root as `python -m scripts.NAME`."""
