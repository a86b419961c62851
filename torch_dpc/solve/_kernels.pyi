"""The functions of `_kernels.c`: contiguous arrays in, results into arrays that are given."""

from typing import Any

from numpy import ndarray

instructions: str

def settings(**settings: float) -> Any: ...
def solve_boxes(
    G: ndarray,
    v0: ndarray,
    lower: ndarray,
    upper: ndarray,
    lam: ndarray,
    iterations: ndarray,
    converged: ndarray,
    settings: Any,
    threads: int,
    /,
) -> None: ...
def solve_sets(
    G: ndarray,
    v0: ndarray,
    sets: tuple[ndarray | None, ...],
    lam: ndarray,
    iterations: ndarray,
    converged: ndarray,
    settings: Any,
    threads: int,
    /,
) -> None: ...
def solve_held(
    G: ndarray,
    sets: tuple[ndarray | None, ...],
    v: ndarray,
    lam: ndarray,
    weak: ndarray,
    rhs: ndarray,
    out: ndarray,
    trusted: ndarray,
    settings: Any,
    threads: int,
    /,
) -> None: ...
def judge_sets(
    G: ndarray,
    sets: tuple[ndarray | None, ...],
    raw: ndarray,
    lam: ndarray,
    v: ndarray,
    missed: ndarray,
    weak: ndarray,
    active: ndarray,
    counts: ndarray,
    done: ndarray,
    settings: Any,
    threads: int,
    /,
) -> None: ...
def plan(
    map: tuple[Any, ...],
    sets: tuple[ndarray | None, ...],
    theta: ndarray,
    v0: ndarray | None,
    v: ndarray,
    lam: ndarray,
    active: ndarray,
    weak: ndarray,
    info: ndarray,
    convinces: ndarray,
    settings: Any,
    threads: int,
    /,
) -> None: ...
def plan_adjoint(
    map: tuple[Any, ...],
    sets: tuple[ndarray | None, ...],
    v: ndarray,
    lam: ndarray,
    active: ndarray,
    weak: ndarray,
    v_bar: ndarray,
    lam_bar: ndarray | None,
    v0_bar: ndarray,
    theta_bar: ndarray | None,
    trusted: ndarray,
    settings: Any,
    threads: int,
    /,
) -> None: ...
def plan_one(
    map: tuple[Any, ...],
    sets: tuple[ndarray | None, ...],
    windows: tuple[int, ...],
    theta: ndarray,
    v: ndarray,
    lam: ndarray,
    active: ndarray,
    weak: ndarray,
    info: ndarray,
    settings: Any,
    threads: int,
    /,
) -> bool: ...
def adjoint_one(
    map: tuple[Any, ...],
    sets: tuple[ndarray | None, ...],
    v: ndarray,
    lam: ndarray,
    active: ndarray,
    weak: ndarray,
    windows: tuple[int, ...],
    bars: ndarray,
    theta_bar: ndarray,
    settings: Any,
    threads: int,
    /,
) -> bool: ...
def holds(address: int, numbers: ndarray, /) -> bool: ...
def solve_active(
    G: ndarray, active: ndarray, rhs: ndarray, out: ndarray, trusted: ndarray, settings: Any, threads: int, /
) -> None: ...
def adjoint(
    G: ndarray,
    active: ndarray,
    v_bar: ndarray,
    lam_bar: ndarray | None,
    out: ndarray,
    trusted: ndarray,
    settings: Any,
    threads: int,
    /,
) -> None: ...
