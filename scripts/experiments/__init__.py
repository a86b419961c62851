"""The settings of the paper, each told once, and what is run in them."""
