"""Random problems, each replayed from its stream and index, against the reference in tests/oracles."""
