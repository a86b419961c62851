"""The attacks of several steps: never worse than Algorithm 1, right where the answer is known, and their edges."""

import copy
import dataclasses
import functools
import math

import numpy as np
import pytest
import torch
from scipy.optimize import brentq, minimize

import torch_dpc as dpc
from helpers import HOLDING, Y_REF, generator, paper_layer, randn, relative, small_layer, windows
from recordings import quadrotor_recording
from torch_dpc import attacks
from torch_dpc.attacks.base import within_budget
from torch_dpc.attacks.loop import SETTINGS, Walk
from torch_dpc.attacks.objective import psi_and_gradient

EXACT = 1e-10
INSIDE = 1e-9  # the promise
ROUNDING = 1e-9  # of psi: the plans of a batch depend on its size in the last bits
CONVERGED = 1e-6  # of the decrease of psi, after 200 steps


@functools.cache
def masses():
    """Return layer, windows, references, cost and the size of a budget."""
    refs = {"y_ref": Y_REF, "u_ref": HOLDING}
    return paper_layer(), windows(20, seed=4), refs, attacks.TargetInput(torch.zeros(2)), 0.1


@functools.cache
def quadrotor():
    u, y = quadrotor_recording()
    layer = dpc.DPCLayer(
        dpc.HankelData.from_trajectories(u, y, t_ini=6, horizon=25),
        Q=torch.block_diag(10 * torch.eye(3), torch.zeros(3, 3)),
        R=1.0,
        lambda_g=100.0,
        lambda_s=1e6,
        u_set=dpc.Box(-1.0, 1.0),
    )
    starts = range(0, 500, 25)
    window = tuple(torch.stack([w[k : k + 6] for k in starts]) for w in (u, y))
    y_ref = torch.tensor([0.3, 0.0, 1.0, 0.0, 0.0, 0.0], dtype=torch.float64)
    return layer, window, {"y_ref": y_ref}, attacks.TargetInput(torch.tensor([0.0, 1.0, 0.0])), 0.003


PLANTS = {"masses": masses, "quadrotor": quadrotor}
BUDGETS = {
    "ball": lambda rho: attacks.RelativeBall(rho),
    "absolute ball": lambda rho: attacks.Ball(rho),
    "box": lambda rho: attacks.Box(rho / 3, relative=True),
    # of smaller ones a single entry is often the best there is, and Algorithm 1 finds it
    "1-norm": lambda rho: attacks.L1Ball(2 * rho, relative=True),
    "ellipsoid": lambda rho: attacks.Ellipsoid(rho / 3, relative=True),
    "sparse": lambda rho: attacks.SparseBall(2, rho, relative=True),
    "by channel": lambda rho: attacks.PerChannel(attacks.RelativeBall(rho)),
}
MULTI_STEP = {
    "projected gradient": attacks.ProjectedGradientAttack,
    "with momentum": functools.partial(attacks.ProjectedGradientAttack, momentum=0.5),
    "with restarts": functools.partial(attacks.ProjectedGradientAttack, steps=10, restarts=3),
    "Frank-Wolfe": attacks.FrankWolfeAttack,
}
every_plant = pytest.mark.parametrize("plant", PLANTS.values(), ids=PLANTS)
every_budget = pytest.mark.parametrize("budget", BUDGETS.values(), ids=BUDGETS)
every_attack = pytest.mark.parametrize("make", MULTI_STEP.values(), ids=MULTI_STEP)


def costs_of(plant):
    layer, _, _, target, _ = plant()
    return {"target": target, "tracking": attacks.TrackingError(layer.data, layer.Q)}


def psi_at(layer, cost, u_ini, y_ini, p, refs):
    """Return psi(u*(p)) of an attack's answer: one solve, and the cost bound to the true window."""
    if hasattr(cost, "given"):
        cost = cost.given(u_ini=u_ini, y_ini=y_ini, **refs)
    return cost(layer(u_ini, y_ini + p, **refs))


# --- what is promised -------------------------------------------------------------------------------------------------


@every_plant
@every_budget
@every_attack
@pytest.mark.parametrize("kind", ["target", "tracking"])
def test_never_worse_than_algorithm_1_and_better_on_average(plant, budget, make, kind):
    layer, (u_ini, y_ini), refs, _, rho = plant()
    cost, budget = costs_of(plant)[kind], budget(rho)
    first = attacks.LinearizedAttack(layer, cost, budget)(u_ini, y_ini, **refs)
    p = make(layer, cost, budget)(u_ini, y_ini, **refs, generator=generator(1))
    assert budget.excess(p, y_ini).max() <= INSIDE and budget.excess(first, y_ini).max() <= INSIDE
    nominal, once, more = (psi_at(layer, cost, u_ini, y_ini, q, refs) for q in (torch.zeros_like(p), first, p))
    assert (more <= once + ROUNDING * once.abs()).all() and (more <= nominal).all()
    assert (once - more).mean() > 1e-5 * (nominal - once).mean() > 0


def affine_problem(seed=0):
    """Return a layer without constraints, so that u*(p) = u*(0) + S p, a window, the cost, S and u*(0) - target."""
    layer, (u_ini, y_ini) = small_layer(u_set=None), (w[0] for w in windows(1, 3, seed=seed))
    target = torch.tensor([0.5, -0.5], dtype=torch.float64)
    S = torch.autograd.functional.jacobian(lambda y: layer(u_ini, y).u.reshape(-1), y_ini).reshape(-1, 12)
    miss = layer(u_ini, y_ini).u.detach().reshape(-1) - target.repeat(6)
    return layer, u_ini, y_ini, attacks.TargetInput(target), S, miss


@pytest.mark.parametrize("make", [attacks.ProjectedGradientAttack, attacks.FrankWolfeAttack])
@pytest.mark.parametrize("radius", [0.05, 0.5])
def test_without_constraints_the_ball_is_a_trust_region_problem(make, radius):
    """min 1/2 |S p + e|^2 subject to |p| <= r:  p = -(S'S + mu I)^-1 S'e, mu >= 0 the root of |p| = r."""
    layer, u_ini, y_ini, cost, S, miss = affine_problem()
    values, vectors = torch.linalg.eigh(S.T @ S)
    b = vectors.T @ (S.T @ miss)

    def step(mu):
        return -vectors @ (b / (values.clamp_min(0) + mu))

    mu = brentq(lambda m: float(step(m).norm()) - radius, 1e-12, 1e6, xtol=1e-14)
    least = 0.5 * (S @ step(mu) + miss).square().sum()
    p = make(layer, cost, attacks.Ball(radius), steps=200)(u_ini, y_ini)
    psi = 0.5 * (S @ p.reshape(-1) + miss).square().sum()
    assert abs(float(psi - least)) < CONVERGED * float(0.5 * miss.square().sum() - least) * (
        1e3 if make is attacks.FrankWolfeAttack else 1  # it gains on the optimum like 1 / k
    )


def test_without_constraints_the_box_is_a_bounded_least_squares_problem():
    layer, u_ini, y_ini, cost, S, miss = affine_problem(1)
    A, e = S.numpy(), miss.numpy()
    found = minimize(
        lambda p: 0.5 * np.square(A @ p + e).sum(),
        np.zeros(12),
        jac=lambda p: A.T @ (A @ p + e),
        bounds=[(-0.1, 0.1)] * 12,
        method="L-BFGS-B",
        options={"ftol": 1e-15, "gtol": 1e-12, "maxiter": 10000},
    )
    p = attacks.ProjectedGradientAttack(layer, cost, attacks.Box(0.1), steps=200)(u_ini, y_ini)
    psi = 0.5 * (S @ p.reshape(-1) + miss).square().sum()
    assert float(psi) - found.fun < CONVERGED * float(0.5 * miss.square().sum() - found.fun)


# --- the loop ---------------------------------------------------------------------------------------------------------


@every_attack
@pytest.mark.parametrize("batch", [(), (0,), (1,), (2, 3)], ids=str)
def test_batches_keep_their_shape_and_their_samples(make, batch):
    layer, (u_ini, y_ini), refs, cost, rho = masses()
    n = math.prod(batch)
    u_ini, y_ini = (w[:n].reshape(*batch, *w.shape[1:]) for w in (u_ini, y_ini))
    attack = make(layer, cost, attacks.RelativeBall(rho), steps=5)
    p = attack(u_ini, y_ini, **refs, generator=generator(1))
    assert p.shape == y_ini.shape and p.dtype == torch.float64 and not p.requires_grad
    if make is not MULTI_STEP["with restarts"]:  # whose random starts depend on the batch
        for i in np.ndindex(batch):
            assert relative(p[i], attack(u_ini[i], y_ini[i], **refs)) < 1e-6  # a kink may amplify rounding


def test_references_and_radii_of_a_batch_follow_their_samples_when_others_leave():
    layer, (u_ini, y_ini), refs, cost, _ = masses()
    u_ini, y_ini = u_ini[:6], y_ini[:6]
    y_ref = Y_REF * torch.linspace(0.0, 1.0, 6, dtype=torch.float64)[:, None, None]
    y_ref[2] = 100.0  # every input at its bound: no gradient, so this sample leaves at once
    targets = randn(6, 1, 2, seed=2)

    def own_target(sol):
        return 0.5 * (sol.u - targets).square().sum((-2, -1))

    radii = torch.linspace(0.1, 0.6, 6, dtype=torch.float64)
    p = attacks.ProjectedGradientAttack(layer, own_target, attacks.Ball(radii))(u_ini, y_ini, y_ref=y_ref)
    assert not p[2].any()
    for i in range(6):
        alone = attacks.ProjectedGradientAttack(layer, attacks.TargetInput(targets[i]), attacks.Ball(radii[i]))
        assert relative(p[i], alone(u_ini[i], y_ini[i], y_ref=y_ref[i])) < 1e-5 or i == 2


class Watched:
    """A layer that remembers how many samples each call had."""

    def __init__(self, layer):
        self.layer, self.data, self.sizes = layer, layer.data, []

    def __call__(self, u_ini, y_ini, **options):
        self.sizes.append(len(y_ini))
        return self.layer(u_ini, y_ini, **options)


class Fragile(Watched):
    """A layer that has no plan for a window longer than a limit."""

    limit = 1.001

    def __call__(self, u_ini, y_ini, **options):
        sol = self.layer(u_ini, y_ini, **options)
        lost = torch.linalg.vector_norm(y_ini, dim=(-2, -1)) > self.limit
        table = sol.info.table.clone()
        table[lost, 0] = dpc.Status.FAILED
        info = copy.copy(sol.info)
        info.table = table
        return dataclasses.replace(sol, u=torch.where(lost[:, None, None], torch.nan, sol.u), info=info)


def test_samples_without_a_gradient_or_progress_leave_the_batch():
    layer, (u_ini, y_ini), _, cost, rho = masses()
    watched = Watched(layer)
    y_ref = Y_REF.expand(20, 1, 4).clone()
    y_ref[5:] = 100.0  # saturated: 15 samples without a gradient
    attacks.ProjectedGradientAttack(watched, cost, attacks.RelativeBall(rho), steps=100)(u_ini, y_ini, y_ref=y_ref)
    assert watched.sizes[0] == 20 and watched.sizes[1] == 5 and watched.sizes == sorted(watched.sizes, reverse=True)
    assert len(watched.sizes) < 102 and watched.sizes[-1] < 5

    stuck, noise = Watched(layer), [0.0]

    def only_gets_worse(sol):
        noise[0] += 1.0
        return 100.0 + noise[0] + sol.u.sum((-2, -1))

    attacks.ProjectedGradientAttack(stuck, only_gets_worse, attacks.Ball(1e-3), steps=100)(u_ini, y_ini)
    assert len(stuck.sizes) <= SETTINGS.patience + 2


def test_samples_without_a_plan_leave_at_once():
    layer, (u_ini, y_ini), refs, cost, _ = masses()
    fragile = Fragile(layer)
    fragile.limit, y_ini = 0.5, torch.ones_like(y_ini)
    for make in (attacks.ProjectedGradientAttack, attacks.FrankWolfeAttack):
        watched = Watched(fragile)
        assert not make(watched, cost, attacks.Ball(0.1))(u_ini, y_ini, **refs).any() and watched.sizes == [20]


def test_cut_off_after_its_first_step_the_loop_is_algorithm_1():
    layer, (u_ini, y_ini), refs, cost, rho = masses()
    problem = (layer, cost, attacks.RelativeBall(rho))
    first = attacks.LinearizedAttack(*problem)(u_ini, y_ini, **refs)
    for make in (attacks.ProjectedGradientAttack, attacks.FrankWolfeAttack):
        assert torch.equal(make(*problem, steps=0)(u_ini, y_ini, **refs), first)


def test_steps_are_those_of_the_textbook():
    """Frank-Wolfe goes 2 / (k + 2) of the way to the vertex; momentum adds to what is left of the last direction."""
    layer, y_ini = small_layer(), randn(5, 3, 4)
    problem = (layer, attacks.TargetInput(HOLDING), attacks.BallBudget(0.1))
    walk, vertex = Walk.at(randn(5, 3, 4, seed=1)), randn(5, 3, 4, seed=2)
    for k in (0, 1, 4):
        step = attacks.FrankWolfeAttack(*problem)._direction(walk, vertex, y_ini, k)
        torch.testing.assert_close(step, 2 / (k + 2) * (vertex - walk.p))
    momentum = attacks.ProjectedGradientAttack(*problem, momentum=0.5)
    walk.gradient, walk.velocity = randn(5, 3, 4, seed=3), randn(5, 3, 4, seed=4)
    unit = walk.gradient / walk.gradient.norm(dim=(-2, -1), keepdim=True)
    kept = 0.5 * walk.velocity + unit
    step = momentum._direction(walk, vertex, y_ini, 0)
    torch.testing.assert_close(walk.velocity, kept)
    length = 0.5 * 1.5 * 0.1  # the step size, longer after a success, times the budget
    torch.testing.assert_close(step, -length * kept / kept.norm(dim=(-2, -1), keepdim=True))


def test_restarts_repeat_by_their_generator_and_never_hurt():
    layer, (u_ini, y_ini), refs, cost, rho = masses()
    budget = attacks.L1Ball(rho, relative=True)

    def attacked(restarts, seed):
        attack = attacks.ProjectedGradientAttack(layer, cost, budget, steps=8, restarts=restarts)
        return attack(u_ini, y_ini, **refs, generator=generator(seed))

    one, more, again, other = attacked(1, 7), attacked(4, 7), attacked(4, 7), attacked(4, 8)
    assert torch.equal(more, again) and not torch.equal(more, other)
    psi_one, psi_more = (psi_at(layer, cost, u_ini, y_ini, p, refs) for p in (one, more))
    assert (psi_more <= psi_one * (1 + ROUNDING)).all() and psi_more.mean() < psi_one.mean() - 1e-3


@every_attack
def test_plans_without_a_solution_are_never_chosen(make):
    layer, (u_ini, y_ini), refs, cost, _ = masses()
    y_ini = y_ini / torch.linalg.vector_norm(y_ini, dim=(-2, -1), keepdim=True)
    fragile, budget = Fragile(layer), attacks.Ball(0.1)
    first = attacks.LinearizedAttack(fragile, cost, budget)(u_ini, y_ini, **refs)
    p = make(fragile, cost, budget)(u_ini, y_ini, **refs, generator=generator(1))
    lost = torch.linalg.vector_norm(y_ini + first, dim=(-2, -1)) > Fragile.limit
    assert lost.any() and not lost.all()  # Algorithm 1, unjudged, falls into it
    assert (torch.linalg.vector_norm(y_ini + p, dim=(-2, -1)) <= Fragile.limit).all()
    nominal, once, more = (cost(layer(u_ini, y_ini + q, **refs)) for q in (torch.zeros_like(p), first, p))
    assert (more[~lost] <= once[~lost] * (1 + ROUNDING)).all() and (more <= nominal).all()
    if make is not attacks.FrankWolfeAttack:  # which cannot take a step back
        assert (more < nominal)[lost].all()


@every_attack
def test_zero_measurements_zero_gradients_and_no_plan_give_zero(make):
    u_ini, y_ini = windows(3, 3, seed=1)
    cost, budget = attacks.TargetInput(torch.ones(2)), attacks.RelativeBall(0.1)
    silent = small_layer(u_set=dpc.Box(-1e-3, 1e-3))
    far = {"y_ref": 100 * Y_REF, "u_ref": 100 * HOLDING}
    without = small_layer(0.0, y_set=dpc.Box(50.0, 60.0))
    nothing = torch.zeros_like(y_ini)
    for p in (
        make(small_layer(), cost, budget)(u_ini, nothing, generator=generator()),
        make(silent, cost, budget)(u_ini, y_ini, **far, generator=generator()),
        make(without, cost, budget, steps=2)(u_ini, y_ini, generator=generator()),
    ):
        assert torch.equal(p, nothing)


@every_budget
@pytest.mark.parametrize("dtype", [torch.float32, torch.float16])
def test_lower_precision_stays_in_its_budget_to_1e9(budget, dtype):
    layer, (u_ini, y_ini), refs, cost, rho = masses()
    u_ini, y_ini, budget = u_ini.to(dtype), y_ini.to(dtype), budget(rho)
    every = [attacks.LinearizedAttack(layer, cost, budget), attacks.FrankWolfeAttack(layer, cost, budget, steps=3)]
    every += [attacks.ProjectedGradientAttack(layer, cost, budget, steps=3)]
    every += [attacks.RandomAttack(budget)] if dtype == torch.float32 else []
    for attack in every:
        p = attack(u_ini, y_ini, **refs, generator=generator())
        assert p.dtype == dtype and p.abs().amax((-2, -1)).min() > 0
        assert budget.excess(p.double(), y_ini.double()).max() <= INSIDE
    exact = every[0](u_ini.double(), y_ini.double(), **refs)
    assert relative(every[0](u_ini, y_ini, **refs).double(), exact) < 10 * torch.finfo(dtype).eps


def test_an_attack_that_leaves_its_budget_is_caught():
    class Leaky(attacks.Ball):
        def project(self, p, y_ini):
            return (1 + 1e-8) * super().project(p, y_ini)

    layer, (u_ini, y_ini), refs, cost, _ = masses()
    with pytest.raises(AssertionError, match="left its budget by 1"):
        attacks.ProjectedGradientAttack(layer, cost, Leaky(0.1))(u_ini, y_ini, **refs)
    p = attacks.Ball(0.1).random(y_ini, generator())
    assert torch.equal(within_budget(p, y_ini, attacks.Ball(0.1)), p)
    with pytest.raises(AssertionError, match="left its budget"):
        within_budget(p, y_ini, attacks.Ball(0.1 * (1 - 1e-8)))


def test_a_budget_of_ones_own_needs_two_methods():
    class LastStep(attacks.Budget):
        """|p| <= 0.1 on the newest measurement alone."""

        def minimize_linear(self, c, y_ini):
            return attacks.Ball(0.1).minimize_linear(self.last(c), y_ini)

        def project(self, p, y_ini):
            return attacks.Ball(0.1).project(self.last(p), y_ini)

        @staticmethod
        def last(p):
            return torch.cat([torch.zeros_like(p[..., :-1, :]), p[..., -1:, :]], dim=-2)

    layer, (u_ini, y_ini), refs, cost, _ = masses()
    for make in (attacks.ProjectedGradientAttack, attacks.FrankWolfeAttack):
        p = make(layer, cost, LastStep())(u_ini, y_ini, **refs)
        assert not p[:, :-1].any() and p[:, -1].norm(dim=-1).max() <= 0.1 + 1e-10 and p.any()


# --- bad input --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"steps": -1}, "`steps` must be an integer, 0 or more"),
        ({"steps": 2.0}, "`steps` must be an integer"),
        ({"restarts": 0}, "`restarts` must be an integer, 1 or more"),
        ({"step_size": 0.0}, "`step_size` must be positive"),
        ({"momentum": 1.0}, "`momentum` must be at least 0 and below 1"),
    ],
    ids=str,
)
def test_bad_options_are_named(options, message):
    layer, _, _, cost, rho = masses()
    with pytest.raises(ValueError, match=message):
        attacks.ProjectedGradientAttack(layer, cost, attacks.RelativeBall(rho), **options)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"y_ini": torch.zeros(4).double()}, "`y_ini` must have shape"),
        ({"y_ref": torch.zeros(7, 1, 4).double()}, r"`y_ref` must have the batch shape of y_ini, \(20,\)"),
        ({"u_ini": torch.zeros(7, 6, 2).double()}, r"`u_ini` must have the batch shape of y_ini, \(20,\)"),
        ({"y_ini": torch.zeros(20, 5, 4).double()}, "the windows have 5 steps, and the attacker's data need t_ini = 6"),
    ],
    ids=["one row", "references", "inputs", "short"],
)
def test_shapes_that_do_not_fit_are_named(change, message):
    layer, (u_ini, y_ini), refs, cost, rho = masses()
    call = {"u_ini": u_ini, "y_ini": y_ini, **refs, **change}
    with pytest.raises(ValueError, match=message):
        attacks.ProjectedGradientAttack(layer, cost, attacks.RelativeBall(rho))(**call)


def test_a_cost_gives_one_number_a_sample():
    layer, (u_ini, y_ini), refs, _, rho = masses()
    with pytest.raises(ValueError, match=r"`cost` must return one number a sample, \(20,\), got \(\)"):
        attacks.LinearizedAttack(layer, lambda sol: sol.u.sum(), attacks.RelativeBall(rho))(u_ini, y_ini, **refs)


def test_psi_and_gradient_where_there_is_no_plan():
    layer, (u_ini, y_ini) = small_layer(0.0, y_set=dpc.Box(50.0, 60.0)), windows(2, 3, seed=1)
    zero = torch.zeros_like(y_ini)
    psi, gradient = psi_and_gradient(layer, attacks.TargetInput(torch.ones(2)), u_ini, y_ini, zero, None, None, 0)
    assert (psi == torch.inf).all() and torch.equal(gradient, zero)
