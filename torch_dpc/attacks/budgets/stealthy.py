"""A budget of what a detector lets pass."""

from __future__ import annotations

import copy
from typing import Any, Protocol

import torch
from torch import Tensor

from ...checks import check_has
from .base import Budget, NormBound, direction, euclidean, standard_normal
from .norms import BallBudget, SparseBallBudget

#: Bisections of the dual variable, to the last bit of float64.
HALVINGS = 60
#: Newton steps for the multiplier of the ball; they converge in about six.
NEWTON_STEPS = 12
#: Answers stay below the level of alarm by this fraction of it, so that rounding cannot raise one.
BELOW = 1e-6


class QuadraticDetector(Protocol):
    """A detector that alarms where |E_u u_ini + E_y y_ini|^2 > 1."""

    def maps(self) -> tuple[Tensor, Tensor]:
        """Return E_u and E_y, `(k, t_ini n_u)` and `(k, t_ini n_y)`."""


class StealthyBudget(Budget):
    """Inside a ball and inside what a detector lets pass, {p : |p| <= radius, score(u_ini, y_ini + p) <= 1}.

    Where the unattacked window alarms by itself, its own score takes the place of 1: p = 0 is admissible.

    Args:
        budget: a `BallBudget` or `RelativeBallBudget`.
        detector: a calibrated :class:`torch_dpc.detection.ConsistencyDetector`.

    Raises:
        ValueError: another budget, or a detector that is not calibrated.

    Example:
        >>> import torch_dpc as dpc
        >>> plant, generator = dpc.systems.OscillatingMasses(), torch.Generator().manual_seed(0)
        >>> u, y = dpc.collect(plant, 600, generator=generator)
        >>> data = dpc.HankelData.from_trajectories(u[:300], y[:300], t_ini=4, horizon=10)
        >>> detector = dpc.detection.ConsistencyDetector(data).calibrate(u[300:], y[300:], false_alarms=0.05)
        >>> budget = StealthyBudget(BallBudget(0.5), detector)
        >>> p = dpc.attacks.RandomAttack(budget)(u[:4], y[:4], generator=generator)
        >>> bool(detector.alarms(u[:4], y[:4] + p)), bool(0 < p.norm() <= 0.5)
        (False, True)
    """

    def __init__(self, budget: Budget, detector: QuadraticDetector):
        if not isinstance(budget, BallBudget) or isinstance(budget, SparseBallBudget):
            raise ValueError(f"`budget` must be a BallBudget or RelativeBallBudget, got {type(budget).__name__}.")
        check_has("detector", detector, "a calibrated ConsistencyDetector", "maps")
        self.budget, self.detector = budget, detector
        self.E_u, self.E_y = detector.maps()
        # E_y = left size axes'; for noise-free data sizes differ by 1e8, and E_y'E_y would lose the small ones
        self.left, self.size, axes = torch.linalg.svd(self.E_y, full_matrices=False)
        self.axes = axes.mT
        self.past: Tensor | None = None  # E_u u_ini, `(*batch, k)`

    def __repr__(self) -> str:
        return f"StealthyBudget({self.budget}, {self.detector})"

    def given(self, u_ini: Tensor) -> StealthyBudget:
        """Return the budget of windows with these inputs."""
        bound = copy.copy(self)
        bound.past = u_ini.detach().double().flatten(-2) @ self.E_u.mT.to(u_ini.device)
        return bound

    def minimize_linear(self, c: Tensor, y_ini: Tensor) -> Tensor:
        """Return argmin over the set of <c, p>.

        Strong duality: it is the minimum over (1 - lam) (|p|^2 / radius^2 - 1) + lam (score - level) / level <= 0, one
        ellipsoid, for the lam in [0, 1] at which both constraints hold; a bisection finds it.
        """
        problem = self._in_axes(y_ini)
        c_axes = self._to_axes(direction(c.double()))
        low = torch.zeros_like(problem.level)
        high = torch.ones_like(low)
        for _ in range(HALVINGS):
            lam = (low + high) / 2
            heavier = problem.score(problem.lowest(c_axes, lam)) > problem.level
            low, high = torch.where(heavier, lam, low), torch.where(heavier, high, lam)
        ball_alone = problem.lowest(c_axes, torch.zeros_like(low))
        p = torch.where(problem.score(ball_alone) <= problem.level, ball_alone, problem.lowest(c_axes, high))
        return torch.where(euclidean(c) > 0, self._inside(p, problem, y_ini), 0.0).to(c.dtype)

    def project(self, p: Tensor, y_ini: Tensor) -> Tensor:
        """Return the nearest admissible perturbation, by its two multipliers."""
        problem = self._in_axes(y_ini)
        return self._inside(problem.nearest(self._to_axes(p.double())), problem, y_ini).to(p.dtype)

    def random(self, y_ini: Tensor, generator: Any = None) -> Tensor:
        return self.minimize_linear(-standard_normal(y_ini, generator), y_ini)

    def excess(self, p: Tensor, y_ini: Tensor) -> Tensor:
        problem = self._in_axes(y_ini)
        # Answers aim at a level that is lower by BELOW, or at the clean score, which rounding may exceed by as much.
        level = (problem.clean * (1 + BELOW)).clamp_min(1.0)
        of_score = (problem.score(self._to_axes(p.double())) / level).clamp_min(0.0).sqrt()[..., 0] - 1
        return torch.maximum(of_score, self.budget.excess(p.double(), y_ini.double()))

    def norm_bounds(self, y_ini: Tensor) -> list[NormBound]:
        problem, offset = self._in_axes(y_ini), self._offset(y_ini)
        score = NormBound(self.E_y.numpy(), offset.numpy(force=True), float(problem.level[..., 0]) ** 0.5)
        return [*self.budget.norm_bounds(y_ini), score]

    def _offset(self, y_ini: Tensor) -> Tensor:
        if self.past is None:
            raise ValueError("a StealthyBudget needs the inputs of the window: call budget.given(u_ini).")
        return self.past + y_ini.detach().double().flatten(-2) @ self.E_y.mT.to(y_ini.device)

    def _in_axes(self, y_ini: Tensor) -> _TwoEllipsoids:
        offset = self._offset(y_ini)
        clean = offset.square().sum(-1, keepdim=True)
        radius = self.budget._reach(y_ini.detach().double())[..., 0].expand_as(clean)
        size = self.size.to(offset.device)
        slope = offset @ self.left.to(offset.device) * size
        level = clean.clamp_min(1.0 - BELOW)
        return _TwoEllipsoids(size.square(), slope, clean, radius, level)

    def _to_axes(self, p: Tensor) -> Tensor:
        return p.flatten(-2) @ self.axes.to(p.device)

    def _inside(self, x: Tensor, problem: _TwoEllipsoids, y_ini: Tensor) -> Tensor:
        x = problem.drawn_in(x) @ self.axes.mT.to(x.device)
        return x.reshape(y_ini.shape)


class _TwoEllipsoids:
    """|x| <= radius and score(x) = sum curvature x^2 + 2 slope x + clean <= level, in the axes of the score.

    Args:
        curvature: `(n,)`.
        slope: `(*batch, n)`.
        clean, radius, level: `(*batch, 1)`.
    """

    def __init__(self, curvature: Tensor, slope: Tensor, clean: Tensor, radius: Tensor, level: Tensor):
        self.curvature, self.slope, self.clean, self.radius, self.level = curvature, slope, clean, radius, level

    def score(self, x: Tensor) -> Tensor:
        return (self.curvature * x.square() + 2 * self.slope * x).sum(-1, keepdim=True) + self.clean

    def lowest(self, c: Tensor, lam: Tensor) -> Tensor:
        """Return argmin of <c, x> over the weighted sum of both constraints."""
        tiny = torch.finfo(c.dtype).tiny
        ball = (1 - lam) / self.radius.square().clamp_min(tiny)
        d = (ball + lam * self.curvature / self.level).clamp_min(tiny)
        slope = lam * self.slope / self.level
        constant = -(1 - lam) + lam * (self.clean - self.level) / self.level
        size = (slope.square() / d).sum(-1, keepdim=True) - constant
        length = (c.square() / d).sum(-1, keepdim=True).clamp_min(tiny).sqrt()
        x = -slope / d - size.clamp_min(0.0).sqrt() * (c / d) / length
        return torch.where(self.radius > 0, x, 0.0)

    def nearest(self, z: Tensor) -> Tensor:
        """Return the nearest point, (z - nu slope) / (1 + mu + nu curvature) with multipliers mu, nu >= 0.

        For every nu the best mu puts the point into the ball; the score then falls with nu, which is bisected.
        """
        low, high = torch.zeros_like(self.level), torch.ones_like(self.level)
        for _ in range(HALVINGS):  # nu = t / (1 - t)
            t = (low + high) / 2
            outside = self.score(self._in_ball(z, t)) > self.level
            low, high = torch.where(outside, t, low), torch.where(outside, high, t)
        free = self._in_ball(z, torch.zeros_like(low))
        return torch.where(self.score(free) > self.level, self._in_ball(z, high), free)

    def _in_ball(self, z: Tensor, t: Tensor) -> Tensor:
        """Return (z - nu slope) / (1 + mu + nu curvature) for the least mu that puts it into the ball.

        Newton's method on 1 / |x(mu)| = 1 / radius, from the left: that function is nearly linear.
        """
        nu = t / (1 - t).clamp_min(1e-16)
        top, bottom = z - nu * self.slope, 1 + nu * self.curvature
        mu = torch.zeros_like(t)
        for _ in range(NEWTON_STEPS):
            x = top / (bottom + mu)
            length = x.norm(dim=-1, keepdim=True)
            falls = (x.square() / (bottom + mu)).sum(-1, keepdim=True).clamp_min(1e-300)
            step = length.square() * (length - self.radius) / (falls * self.radius.clamp_min(1e-300))
            mu = (mu + step).clamp_min(0.0)
        return top / (bottom + mu)

    def drawn_in(self, x: Tensor) -> Tensor:
        """Return x, scaled towards 0, which is admissible, as far as its rounding asks."""
        a = (self.curvature * x.square()).sum(-1, keepdim=True)
        b = (self.slope * x).sum(-1, keepdim=True)
        room = (self.level - self.clean).clamp_min(0.0)
        # the larger root of a s^2 + 2 b s = room, written without cancellation
        root = (b.square() + a * room).sqrt()
        largest = torch.where(b > 0, room / (b + root).clamp_min(1e-300), (root - b) / a.clamp_min(1e-300))
        fits = a + 2 * b <= room
        of_score = torch.where(fits, 1.0, largest.clamp(0.0, 1.0))
        length = x.norm(dim=-1, keepdim=True)
        of_ball = torch.where(length > self.radius, self.radius / length.clamp_min(1e-300), 1.0)
        return x * torch.minimum(of_score, of_ball)
