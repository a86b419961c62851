"""What a mutant is."""

from typing import NamedTuple


class Mutant(NamedTuple):
    """A text that stands once in a file, what replaces it, and the tests that are asked.

    Attributes:
        name: what is wrong then.
        file: below the root.
        old, new: the texts.
        tests: paths below tests/, with a keyword expression after a space.
        kernels: whether the compiled kernels are in use; without them the torch path is asked.
    """

    name: str
    file: str
    old: str
    new: str
    tests: str
    kernels: bool = True
