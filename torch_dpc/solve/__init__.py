"""The forward solve and the systems of the derivative."""
