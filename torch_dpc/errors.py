"""What can go wrong: the status of a solve, the exceptions and the warnings."""

from enum import IntEnum


class Status(IntEnum):
    """How the solve of one sample ended (`sol.info.status`)."""

    SOLVED = 0  #: the optimality conditions hold to the tolerance stated in `sol.info.residual`
    INFEASIBLE = 1  #: a certificate shows that no trajectory meets the constraints
    FAILED = 2  #: no engine reached the tolerance, and no certificate of infeasibility was found


class SolveError(RuntimeError):
    """A sample of the batch has no acceptable solution.

    Attributes:
        indices: the positions in the batch, one tuple a sample; `()` where the call was unbatched.
    """

    def __init__(self, message: str, indices: list[tuple[int, ...]] | None = None):
        super().__init__(message)
        self.indices = indices or []


class InfeasibleError(SolveError):
    """A sample is proven to have no solution: the constraints exclude each other."""


class ExcitationWarning(UserWarning):
    """The recorded input does not excite the system enough for the windows asked for."""
