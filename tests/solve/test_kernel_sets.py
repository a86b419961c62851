"""The compiled kernel for priced intervals, balls and cones against projections and differences of its own."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from helpers import randn
from torch_dpc.sets.values import BALL, CONE, SetValues
from torch_dpc.solve import kernels

pytestmark = pytest.mark.skipif(kernels._kernels is None, reason="the extension is not built here (no compiler)")

#: |v - P(v + lam)| relative to 1 + |v|.
SAME = 1e-11
#: Central differences with steps of 1e-6.
DIFFERENCES = 1e-6


class Problem:
    """A random product of sets that some x meets, and samples v0; its projections are written anew here."""

    def __init__(self, seed, count=20, n_x=None, prices=0.5, kinds=(BALL, CONE), shared=True):
        self.random = np.random.default_rng(seed)
        sizes = [int(self.random.integers(1, 6)) for _ in range(int(self.random.integers(1, 10)) if kinds else 0)]
        self.kind = [int(self.random.choice(kinds)) for _ in sizes]
        intervals = int(self.random.integers(0 if sizes else 1, 20))
        self.n = sum(sizes) + intervals
        order = self.random.permutation(self.n).tolist()
        self.blocks = [order[sum(sizes[:b]) : sum(sizes[: b + 1])] for b in range(len(sizes))]
        self.intervals = order[sum(sizes) :]
        n_x = n_x or self.n + 3
        lead = () if shared else (count,)
        Ct = self.random.standard_normal((*lead, self.n, n_x)) / n_x**0.5
        self.G = Ct @ Ct.swapaxes(-1, -2)
        reached = self._reached(prices)
        self.v0 = reached + (Ct @ self.random.standard_normal((count, n_x, 1)))[..., 0] * 1.5

    def _reached(self, prices):
        """Draw the sets around a point that is returned."""
        normal, point = self.random.standard_normal, np.zeros(self.n)
        self.lower, self.upper = np.full(self.n, -np.inf), np.full(self.n, np.inf)
        self.price = np.full(self.n, np.inf)
        self.center, self.radius = [], []
        for kind, block in zip(self.kind, self.blocks, strict=True):
            point[block] = normal(len(block)) * 0.4
            if kind == CONE:
                point[block[0]] = np.linalg.norm(point[block[1:]]) + abs(normal()) * 0.3
            self.center.append(point[block] if kind == BALL else np.zeros(len(block)))
            self.radius.append(abs(normal()) * 0.5 if kind == BALL else 0.0)
        for i in self.intervals:
            point[i], width = normal(), abs(normal()) * 0.4
            self.lower[i] = point[i] - width if self.random.random() < 0.85 else -np.inf
            self.upper[i] = point[i] + width if self.random.random() < 0.85 else np.inf
            if self.random.random() < prices:
                self.price[i] = abs(normal()) + 0.01
        return point

    @property
    def values(self):
        rows = [i for block in self.blocks for i in block]
        start = np.cumsum([0, *map(len, self.blocks)])
        center = np.concatenate([*self.center, np.zeros(0)])
        integers = (torch.tensor(x, dtype=torch.int64) for x in (self.kind, start, rows))
        price = None if np.isinf(self.price).all() else torch.from_numpy(self.price)
        bounds = torch.from_numpy(self.lower), torch.from_numpy(self.upper), price
        return SetValues(*bounds, *integers, torch.from_numpy(center), torch.tensor(self.radius, dtype=torch.float64))

    @property
    def gamma(self):
        """The scale of multipliers that the kernel has: the diagonal of G, the largest of each block."""
        gamma = self.G.diagonal().copy()
        gamma = np.maximum(gamma, 1e-6 * gamma.max())
        for block in self.blocks:
            gamma[block] = gamma[block].max()
        return gamma

    def prox(self, x):
        """The proximal map with gamma = 1."""
        return self.prox_in(x, np.ones(self.n))

    def prox_in(self, x, gamma):
        pull = x - np.clip(x, self.lower, self.upper)
        with np.errstate(invalid="ignore"):
            out = x - np.clip(pull, -gamma * self.price, gamma * self.price)
        for kind, block, center, radius in zip(self.kind, self.blocks, self.center, self.radius, strict=True):
            part = x[..., block]
            if kind == BALL:
                size = np.linalg.norm(part - center, axis=-1, keepdims=True)
                shrunk = center + radius * (part - center) / np.where(size > 0, size, 1.0)
                out[..., block] = np.where(size > radius, shrunk, part)
            else:
                head, size = part[..., :1], np.linalg.norm(part[..., 1:], axis=-1, keepdims=True)
                half = (head + size) / 2
                edge = np.concatenate([half, half * part[..., 1:] / np.where(size > 0, size, 1.0)], axis=-1)
                out[..., block] = np.where(size <= head, part, np.where(size <= -head, 0.0, edge))
        return out

    def solve(self, v0=None):
        found = kernels.solve_sets(
            torch.from_numpy(self.G), torch.from_numpy(self.v0 if v0 is None else v0), self.values
        )
        return found.lam.numpy(), found.converged.numpy()

    def v_of(self, lam, v0=None):
        return (self.v0 if v0 is None else v0) - (self.G @ lam[..., None])[..., 0]

    def residual(self, lam):
        v = self.v_of(lam)
        return np.abs(v - self.prox(v + lam)).max() / (1 + np.abs(v).max())


MIXTURES = {
    "all": {},
    "dependent rows": {"n_x": 5},
    "balls": {"kinds": (BALL,), "prices": 0.0},
    "cones": {"kinds": (CONE,), "prices": 0.0},
    "priced": {"kinds": (), "prices": 0.7},
    "priced, dependent rows": {"kinds": (), "prices": 0.7, "n_x": 4},
    "one problem a sample": {"shared": False},
}


@pytest.mark.parametrize("seed", range(12))
@pytest.mark.parametrize("mixture", MIXTURES)
def test_random_sets_meet_their_conditions(mixture, seed):
    problem = Problem(seed, **MIXTURES[mixture])
    lam, converged = problem.solve()
    assert converged.all()
    assert problem.residual(lam) < SAME


def test_a_hard_price_is_a_hard_bound():
    problem = Problem(3, kinds=(), prices=0.0)
    hard, _ = problem.solve()
    problem.price[:] = 1e9
    priced, converged = problem.solve()
    assert converged.all() and np.abs(hard).max() > 0.1
    np.testing.assert_allclose(priced, hard, atol=1e-10)


def test_infeasible_problems_with_a_price_are_solved_and_others_flagged():
    problem = Problem(4, kinds=(), prices=0.0, n_x=2)
    i, j = problem.intervals[:2]
    problem.lower[i], problem.upper[i] = 60.0, 61.0  # two unknowns do not bring both there
    problem.lower[j], problem.upper[j] = 60.0, 61.0
    problem.lower[problem.intervals[2]], problem.upper[problem.intervals[2]] = -61.0, -60.0
    lam, converged = problem.solve()
    assert not converged.any()
    problem.price[:] = 2.0
    lam, converged = problem.solve()
    assert converged.all() and problem.residual(lam) < SAME


@pytest.mark.parametrize("dual", [False, True])
@pytest.mark.parametrize("seed", range(6))
def test_priced_intervals_by_either_method(seed, dual, monkeypatch):
    monkeypatch.setattr(kernels, "SETTINGS", kernels.KernelSettings(primal_dual_steps=0 if dual else 10))
    problem = Problem(seed, kinds=(), prices=0.8, n_x=6, count=50)
    lam, converged = problem.solve()
    assert converged.all() and problem.residual(lam) < SAME


@pytest.mark.parametrize("seed", range(6))
def test_curved_sets_by_the_proximal_point_method_alone(seed, monkeypatch):
    settings = kernels.KernelSettings(newton_steps=0, good=1e-9, close=1e-12)
    monkeypatch.setattr(kernels, "SETTINGS", settings)
    problem = Problem(seed)
    lam, converged = problem.solve()
    assert converged.all() and problem.residual(lam) < 1e-8


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("mixture", ["all", "balls", "cones", "priced", "one problem a sample"])
def test_the_operator_of_derivatives_against_differences(mixture, seed):
    problem = Problem(seed, count=4, **MIXTURES[mixture])
    lam, _ = problem.solve()
    v = problem.v_of(lam)
    direction, step = randn(*v.shape, seed=seed).numpy(), 1e-6
    weak = np.abs(lam) < 1e-9
    tensors = (torch.from_numpy(x) for x in (problem.G, v, lam, weak))
    moved, trusted = kernels.adjoint_sets(*tensors, problem.values, torch.from_numpy(direction))
    assert trusted.all()
    ahead, behind = (problem.solve(problem.v0 + sign * step * direction)[0] for sign in (1, -1))
    expected = (ahead - behind) / (2 * step)
    error = np.abs(moved.numpy() - expected).max(axis=1) / (1 + np.abs(expected).max(axis=1))
    assert np.median(error) < DIFFERENCES  # a sample whose active set changes within the step has no derivative there


def test_a_weak_block_is_free():
    problem = Problem(1, kinds=(BALL,), prices=0.0)
    lam, _ = problem.solve()
    weak = np.ones_like(lam, dtype=bool)
    at = (torch.from_numpy(x) for x in (problem.G, problem.v_of(lam), lam, weak))
    moved, _ = kernels.adjoint_sets(*at, problem.values, torch.ones(*lam.shape, dtype=torch.float64))
    assert (moved == 0).all()


def test_a_sample_does_not_see_the_batch_or_the_threads():
    problem = Problem(2, count=300)
    lam, _ = problem.solve()
    torch.set_num_threads(3)
    again, _ = problem.solve()
    torch.set_num_threads(1)
    assert np.array_equal(lam, again)
    alone, _ = problem.solve(problem.v0[17:18])
    assert np.array_equal(alone[0], lam[17])


def test_a_value_that_is_not_finite_flags_its_sample_alone():
    problem = Problem(5, count=3)
    problem.v0[1, 0] = np.nan
    _, converged = problem.solve()
    assert converged.tolist() == [True, False, True]


# --- the judgement, and whole calls -----------------------------------------------------------------------------------


def whole(problem):
    """A map in units for the problem, theta, and the sets in those units."""
    random, n_theta = np.random.default_rng(1), problem.n + 2
    V = random.standard_normal((problem.n, n_theta))
    unit = 2.0 ** np.repeat(random.integers(-6, 6, 1), problem.n)
    theta = np.linalg.lstsq(V, problem.v0.T, rcond=None)[0].T
    of = kernels.Map(problem.G, V, np.ones(n_theta), problem.G.diagonal().copy(), unit, 1e-15, 1e-16)
    return of, kernels.set_arrays(problem.values), np.ascontiguousarray(theta)


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("mixture", ["all", "balls", "cones", "priced"])
def test_the_judgement_against_projections(mixture, seed):
    problem = Problem(seed, **MIXTURES[mixture])
    lam, _ = problem.solve()
    for multipliers in (lam, lam + 1e-3, 0 * lam):
        raw = problem.v_of(multipliers)
        verdict = kernels.judge_sets(*map(torch.from_numpy, (problem.G, raw, multipliers)), problem.values)
        gamma = problem.gamma
        v = problem.prox_in(raw + gamma * multipliers, gamma)
        np.testing.assert_allclose(verdict.v, v, atol=1e-12)
        size = np.abs(v)
        for block in problem.blocks:
            size[:, block] = size[:, block].max(1, keepdims=True)
        np.testing.assert_allclose(verdict.missed, np.abs(raw - v) / (1 + size), atol=1e-12)
        small = np.abs(multipliers * problem.G.diagonal()) <= 1e-9 * (1 + np.abs(v))
        for block in problem.blocks:
            small[:, block] = small[:, block].all(1, keepdims=True)
        assert np.array_equal(verdict.weak, small)
        assert np.array_equal(verdict.counts[:, 0], verdict.active.sum(1))
        assert not (verdict.active & verdict.weak).any()
    assert verdict.missed.max() > 1e-3  # the multipliers of the last round are none


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("mixture", ["all", "priced", "cones"])
def test_a_whole_call_is_its_parts(mixture, seed):
    problem = Problem(seed, n_x=7, **MIXTURES[mixture])
    of, sets, theta = whole(problem)
    found = kernels.plan(of, sets, theta)
    v0 = theta @ of.V.T
    again = kernels.plan(of, sets, theta, v0)
    lam, converged = problem.solve(v0)
    assert converged.all() and (found.info[:, 0] == 0).all()
    raw = problem.v_of(lam, v0)
    verdict = kernels.judge_sets(*map(torch.from_numpy, (problem.G, raw, lam)), problem.values)
    for of_call in (found, again):
        np.testing.assert_allclose(of_call.v, verdict.v.numpy() * of.unit, rtol=1e-9, atol=1e-10)
        np.testing.assert_allclose(of_call.info[:, 3:], verdict.counts)
    assert found.convinces.all() and (again.info[:, 2] <= verdict.missed.numpy().max(1) + 1e-12).all()
    bar, lam_bar = randn(*found.v.shape, seed=1).numpy(), randn(*found.v.shape, seed=2).numpy()
    at = found.v, found.lam, found.active, found.weak
    result = kernels.plan_adjoint(of, sets, at, bar, lam_bar, of_theta=True)
    assert result is not None
    rhs = lam_bar / of.unit - (bar * of.unit) @ of.G
    in_units = (torch.from_numpy(x) for x in (of.G, found.v / of.unit, found.lam * of.unit, found.weak))
    moved, _ = kernels.adjoint_sets(*in_units, problem.values, torch.from_numpy(rhs))
    expected = bar + moved.numpy() / of.unit
    np.testing.assert_allclose(result[0], expected, rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(result[1], (expected * of.unit) @ of.V, rtol=1e-9, atol=1e-9)


def test_a_map_with_a_large_error_does_not_convince():
    problem = Problem(4, kinds=(), prices=0.0)
    of, sets, theta = whole(problem)
    sizes = np.abs(theta).max(1), (np.abs(kernels.plan(of, sets, theta).lam * of.unit) * of.moved).sum(1)
    for field, size in zip(("error_of_theta", "error_of_lam"), sizes, strict=True):
        most = kernels.SETTINGS.convincing / size[size > 0].max()
        assert kernels.plan(replace(of, **{field: 0.9 * most}), sets, theta).convinces.all()
        assert not kernels.plan(replace(of, **{field: 1.1 * most}), sets, theta).convinces.all()


def test_rounding_is_bounded_row_by_row_where_the_worst_row_does_not_convince():
    problem = Problem(4, kinds=(), prices=0.0)
    of, sets, theta = whole(problem)
    coarse = replace(of, error_of_theta=0.0, error_of_lam=1.0)
    assert not kernels.plan(coarse, sets, theta).convinces.any()
    most = kernels.SETTINGS.convincing / (np.abs(kernels.plan(of, sets, theta).lam * of.unit) @ np.abs(of.G)).max(1)
    assert kernels.plan(replace(coarse, rounding=0.9 * most.min()), sets, theta).convinces.all()
    assert not kernels.plan(replace(coarse, rounding=1.1 * most.max()), sets, theta).convinces.any()


def test_a_plan_without_a_solution_is_marked():
    problem = Problem(4, kinds=(), prices=0.0)
    of, sets, theta = whole(problem)
    theta[1, 0] = np.nan
    found = kernels.plan(of, sets, theta)
    assert found.info[1, 0] == 2 and (found.info[[0, 2], 0] == 0).all()


@pytest.mark.parametrize(
    ("place", "wrong"),
    [
        (3, np.array([3])),
        (3, np.array([1, 1])),
        (4, np.array([0, 3])),
        (4, np.array([0, 0, 2])),
        (5, np.array([0, 5])),
        (5, np.array([1, 1])),
        (5, np.array([-1, 0])),
        (6, np.zeros(3)),
        (7, np.zeros(2)),
        (0, np.zeros(5)),
    ],
)
def test_blocks_that_make_no_sense_are_refused(place, wrong):
    sets = [np.full(5, -np.inf), np.full(5, np.inf), None, np.array([1]), np.array([0, 2]), np.array([0, 1])]
    sets += [np.zeros(2), np.ones(1)]
    results = np.zeros((1, 5)), np.zeros(1, dtype=np.int64), np.zeros(1, dtype=bool)
    options = kernels.SETTINGS.compiled, 1
    kernels._kernels.solve_sets(np.eye(5), np.ones((1, 5)), tuple(sets), *results, *options)
    assert results[2].all()
    sets[place] = wrong
    with pytest.raises(ValueError, match="does not fit"):
        kernels._kernels.solve_sets(np.eye(5), np.ones((1, 5)), tuple(sets), *results, *options)
