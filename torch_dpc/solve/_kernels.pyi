"""The kernels as `_kernels.c` exports them: contiguous arrays in, results into arrays that are given."""

from numpy import ndarray

instructions: str

def solve_boxes(
    G: ndarray,
    v0: ndarray,
    lower: ndarray,
    upper: ndarray,
    lam: ndarray,
    iterations: ndarray,
    converged: ndarray,
    hysteresis: float,
    standing_out: float,
    touching: float,
    pivots: int,
    threads: int,
    /,
) -> None: ...
def solve_active(
    G: ndarray, active: ndarray, rhs: ndarray, out: ndarray, trusted: ndarray, standing_out: float, threads: int, /
) -> None: ...
def adjoint(
    G: ndarray,
    active: ndarray,
    v_bar: ndarray,
    lam_bar: ndarray | None,
    out: ndarray,
    trusted: ndarray,
    standing_out: float,
    threads: int,
    /,
) -> None: ...
