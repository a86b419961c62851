"""What the commands `python -m torch_dpc check` and `audit` compute; `torch_dpc.__main__` reads their arguments."""
