"""Mutants of the core: small wrong changes, each of which a test must notice (`make mutants`)."""
