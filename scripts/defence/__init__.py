"""What a defender measures: who is seen, and what poisoned recordings do."""
