"""How far any perturbation can move the plan, certified by a matrix inequality."""

from __future__ import annotations

import numpy as np
import scipy
import torch
from torch import Tensor

from ..checks import check_type
from ..errors import SolveError
from ..layer import DPCLayer
from .budgets import Budget

#: The eigenvalue is enlarged by this fraction before the inequality is checked, so that rounding cannot break it.
MARGIN = 1e-6
#: Exponents of the smooth maximum of the eigenvalues, each started from the result of the one before.
EXPONENTS = (4.0, 16.0, 64.0)
#: What the line search sees where tau is not admissible: a logarithm above all that occur, but finite.
REFUSED = 1e6
#: Eigenvalues of G at or below this fraction of the largest mean that rows depend on each other.
DEPENDENT = 1e-12


class SensitivityBound(float):
    """L of |u(p) - u(0)| <= L |p|, a number.

    Attributes:
        covers_outputs: whether it also holds for plans that a bound of the outputs holds.
    """

    covers_outputs: bool

    def __new__(cls, value: float, covers_outputs: bool) -> SensitivityBound:
        """Return a number that knows what it covers."""
        bound = super().__new__(cls, value)
        bound.covers_outputs = covers_outputs
        return bound

    def __repr__(self) -> str:
        return f"SensitivityBound({float(self):.6g}, covers_outputs={self.covers_outputs})"


def sensitivity_bound(layer: DPCLayer, budget: Budget | None = None, *, outputs: bool = False) -> SensitivityBound:
    """Return L such that |u(p) - u(0)| <= L |p| for every window, every reference and every p, of any attack.

    Between two plans, dv = Vp dp - G dlam and dlam_i dv_i >= 0 for every row i of a box, whichever rows are active. So
    gamma with

        |du|^2 - gamma |dp|^2 + 2 sum over i of tau_i dlam_i dv_i <= 0   for all (dp, dlam), for some tau >= 0

    gives L = sqrt(gamma). The least such gamma is a linear matrix inequality in (gamma, tau). Eliminating dlam leaves a
    smooth function of tau, which is minimised; the inequality is then checked by the eigenvalues of its matrix.

    Args:
        layer: its sets are boxes; one problem, not a batch of weights.
        budget: entries of the window that it fixes at 0 do not count; by default every entry does.
        outputs: whether bounds of the outputs count too. Where outputs can be held, the plan answers to small
            perturbations with the weight lambda_s, and L is of the order of sqrt(2 lambda_s). By default they do not:
            L then holds between plans that no bound of the outputs holds, which `plan.lam` shows.

    Raises:
        ValueError: the layer has other sets than boxes.
        SolveError: the matrix inequality could not be confirmed.

    Example:
        >>> from torch_dpc import Box, HankelData, collect, systems
        >>> u, y = collect(systems.OscillatingMasses(), 120, generator=torch.Generator().manual_seed(0))
        >>> data = HankelData.from_trajectories(u, y, t_ini=4, horizon=5)
        >>> layer = DPCLayer(data, Q=10.0, R=1.0, lambda_g=1.0, lambda_s=1e4, u_set=Box(-1.0, 1.0))
        >>> L, p = sensitivity_bound(layer), torch.full((4, 4), 0.01, dtype=torch.float64)
        >>> bool((layer(u[:4], y[:4] + p).u - layer(u[:4], y[:4]).u).norm() <= L * p.norm())
        True
    """
    check_type("layer", layer, DPCLayer)
    if budget is not None:
        check_type("budget", budget, Budget)
    if not layer.has_bounds:
        raise ValueError("`layer` must have boxes as its sets.")
    reduction, data = layer.reduction.detach(), layer.data
    n_u, first = data.horizon * data.n_u, data.t_ini * data.n_u
    lower, upper = layer.bounds(reduction.G.device)
    held = (lower.isfinite() | upper.isfinite()).expand(len(reduction.G)).clone()
    if not outputs:
        held[n_u : n_u + data.horizon * data.n_y] = False
    Vp = reduction.V[:, first : first + data.t_ini * data.n_y]
    Vp = Vp[:, _touched(budget, data.t_ini, data.n_y).to(Vp.device)]
    _, size, directions = torch.linalg.svd(Vp, full_matrices=False)
    Vp = Vp @ directions.mT[:, size > 0]  # an isometry of what is seen of p
    is_u = torch.arange(len(held), device=held.device) < n_u
    A, G = Vp[held], reduction.G[held][:, held]
    free = Free(Vp[:n_u], reduction.G[is_u][:, held])
    gamma = _independent(A, G, free) if _is_definite(G) else _dependent(A, G, free)
    return SensitivityBound(gamma**0.5, outputs)


class Free:
    """du = A dp - G dlam for all inputs, the rows of the plan that are judged."""

    def __init__(self, A: Tensor, G: Tensor):
        self.A, self.G = A, G


def _touched(budget: Budget | None, t_ini: int, n_y: int) -> Tensor:
    """Return which entries of a window a budget can touch, `(t_ini n_y,)`."""
    touched = torch.ones(t_ini * n_y, dtype=torch.bool)
    if budget is not None:
        for piece in budget.norm_bounds(torch.ones(t_ini, n_y, dtype=torch.float64)):
            if len(piece.matrix) == 1 and piece.radius == 0.0:
                touched[np.flatnonzero(piece.matrix[0])] = False
    return touched


def _is_definite(G: Tensor) -> bool:
    values = torch.linalg.eigvalsh(G) if len(G) else torch.ones(1)
    return bool(values[0] > DEPENDENT * values[-1])


def _independent(A: Tensor, G: Tensor, free: Free) -> float:
    """Return the least gamma over tau, one for each row."""

    def schur(log_tau: Tensor) -> Tensor | None:
        """Return the matrix whose largest eigenvalue is gamma; None where tau is not admissible."""
        tau = log_tau.exp()
        S = tau[:, None] * G + G * tau - free.G.mT @ free.G
        factor, failed = torch.linalg.cholesky_ex(S)
        if bool(failed):
            return None
        X = torch.linalg.solve_triangular(factor, tau[:, None] * A - free.G.mT @ free.A, upper=False)
        return free.A.mT @ free.A + X.mT @ X

    def smooth(x: np.ndarray, exponent: float) -> tuple[float, np.ndarray]:
        with torch.enable_grad():
            log_tau = torch.from_numpy(x).requires_grad_()
            matrix = schur(log_tau)
            if matrix is None:
                return REFUSED, np.zeros_like(x)
            values = torch.linalg.eigvalsh(matrix).clamp_min(0.0)
            largest = values.amax().detach()
            value = (largest * (values / largest).pow(exponent).sum().pow(1 / exponent)).log()
            (gradient,) = torch.autograd.grad(value, log_tau)
        return value.item(), gradient.numpy()

    log_tau = np.full(len(G), np.log(float(torch.linalg.eigvalsh(G)[-1]) if len(G) else 1.0))
    if len(G):
        for exponent in EXPONENTS:
            found = scipy.optimize.minimize(
                smooth, log_tau, (exponent,), jac=True, method="L-BFGS-B", options={"maxiter": 500}
            )
            log_tau = found.x
    matrix = schur(torch.from_numpy(log_tau))
    assert matrix is not None, "the search only accepts admissible multipliers"
    gamma = float(torch.linalg.eigvalsh(matrix)[-1]) * (1 + MARGIN)
    _confirm(gamma, torch.from_numpy(log_tau).exp(), A, G, free)
    return gamma


def _confirm(gamma: float, tau: Tensor, A: Tensor, G: Tensor, free: Free) -> None:
    """Check the inequality by the eigenvalues of its whole matrix, scaled to a unit diagonal."""
    corner = free.A.mT @ free.A - gamma * torch.eye(A.shape[1], dtype=A.dtype)
    cross = A.mT * tau - free.A.mT @ free.G
    rest = free.G.mT @ free.G - tau[:, None] * G - G * tau
    whole = torch.cat([torch.cat([corner, cross], 1), torch.cat([cross.mT, rest], 1)])
    scale = whole.diagonal().abs().clamp_min(torch.finfo(whole.dtype).tiny).rsqrt()
    largest = float(torch.linalg.eigvalsh(scale[:, None] * whole * scale)[-1])
    if not largest <= len(whole) * torch.finfo(whole.dtype).eps:
        raise SolveError(f"the matrix inequality of the sensitivity bound holds only to {largest:.1e}.")


def _dependent(A: Tensor, G: Tensor, free: Free) -> float:
    """Return gamma for rows that depend on each other, where all tau must be equal.

    With G = C C' the plan moves by dv = C dx, dx the projection's answer to X dp, and the sum is tau dx'(X dp - dx):

        gamma = least over tau of the largest eigenvalue of tau^2 X' (2 tau I - Cu'Cu)^-1 X,  du = Cu dx.
    """
    values, vectors = torch.linalg.eigh(G)
    kept = values > DEPENDENT * values[-1]
    root, inverse = vectors[:, kept] * values[kept].sqrt(), vectors[:, kept] / values[kept].sqrt()
    X, Cu = inverse.mT @ A, free.G @ inverse  # free.G = Cu C'
    largest = torch.linalg.matrix_norm(Cu, ord=2).square()
    factors = torch.logspace(-3, 3, 61, dtype=A.dtype)  # convex in tau; a percent of it is enough
    eye = torch.eye(root.shape[1], dtype=A.dtype)
    gammas = []
    for tau in (0.5 * largest * (1 + factor) for factor in factors):
        half = torch.linalg.solve_triangular(torch.linalg.cholesky(2 * tau * eye - Cu.mT @ Cu), X, upper=False)
        gammas.append(tau.square() * torch.linalg.matrix_norm(half, ord=2).square())
    return float(torch.stack(gammas).min()) * (1 + MARGIN)
