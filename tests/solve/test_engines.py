"""The two engines find the same solution, which is that of an oracle, whatever the batch and the history."""

import threading

import pytest
import torch
from torch.func import jacfwd, jacrev

import torch_dpc as dpc
from helpers import (
    HOLDING,
    PAPER,
    SMALL,
    Y_REF,
    delayed_data,
    masses_data,
    paper_layer,
    randn,
    reference_plan,
    relative,
    small_data,
    small_layer,
    windows,
)

ENGINES = ["auto", "newton", "daqp"]
SAME = 1e-10  # engines end in exact multipliers
ROUNDING = 1e-15  # of v = v0 - G lam, |G| = 1, a unit of lam: samples that almost have no solution push with 1e6
PLAN = 1e-9

PROBLEMS = {
    "inputs": {"u_set": dpc.Box(-0.5, 0.5)},
    "outputs": {"y_set": dpc.Box(-0.9, 0.9)},
    "both": {"u_set": dpc.Box(-0.7, 0.7), "y_set": dpc.Box(-1.2, 1.2)},
    "one sided": {"u_set": dpc.Box(-torch.inf, 0.1), "y_set": dpc.Box(-0.9, torch.inf)},
    "tight": {"u_set": dpc.Box(torch.tensor([-0.3, 0.1]), torch.tensor([0.3, 0.1]))},
}


@pytest.mark.parametrize("noise", [0.0, 1e-2])
@pytest.mark.parametrize("problem", PROBLEMS)
def test_engines_agree_with_an_oracle(problem, noise):
    u_ini, y_ini = windows(30, 3, seed=1, scale=0.7)
    sols = [small_layer(noise, **PROBLEMS[problem], solver=solver)(u_ini, y_ini, y_ref=Y_REF) for solver in ENGINES]
    assert (sols[0].info.n_active > 0).sum() >= 15
    for sol in sols[1:]:
        for name in ("u", "y", "lam"):
            assert relative(getattr(sol, name), getattr(sols[0], name)) < SAME, name
        assert torch.equal(sol.info.n_active, sols[0].info.n_active)
    layer = small_layer(noise, **PROBLEMS[problem])
    for i in range(6):
        u, y = reference_plan(layer, u_ini[i], y_ini[i], Y_REF)
        assert relative(sols[0].u[i], u) < PLAN and relative(sols[0].y[i], y) < PLAN


@pytest.mark.parametrize("noise", [0.0, 1e-2])
def test_engines_agree_on_the_papers_problem(noise):
    u_ini, y_ini = windows(200, seed=1)
    options = {"u_set": dpc.Box(-1.0, 1.0), "y_set": dpc.Box(-2.5, 2.5)}
    sols = [
        dpc.DPCLayer(masses_data(noise), **PAPER, **options, solver=solver, on_failure="nan")(
            u_ini, y_ini, y_ref=Y_REF, u_ref=HOLDING
        )
        for solver in ENGINES
    ]
    solved = sols[0].info.status == dpc.Status.SOLVED
    assert solved.sum() > 100
    same = SAME + ROUNDING * float(sols[0].lam[solved].abs().max())
    for sol in sols[1:]:
        assert torch.equal(sol.info.status, sols[0].info.status)
        assert relative(sol.u[solved], sols[0].u[solved]) < same
        assert relative(sol.y[solved], sols[0].y[solved]) < same


def test_where_newton_cycles_the_answer_is_still_right():
    """Output bounds that bite all at once make the active sets of a plain Newton iteration repeat."""
    layer = small_layer(0.0, solver="newton", u_set=None, y_set=dpc.Box(-0.25, 0.25))
    u_ini, y_ini = windows(40, 3, seed=9, scale=2.0)
    sol = layer(u_ini, y_ini, y_ref=Y_REF, on_failure="nan")
    other = small_layer(0.0, solver="daqp", u_set=None, y_set=dpc.Box(-0.25, 0.25))(
        u_ini, y_ini, y_ref=Y_REF, on_failure="nan"
    )
    assert torch.equal(sol.info.status, other.info.status)
    solved = sol.info.status == dpc.Status.SOLVED
    assert solved.sum() >= 10
    assert relative(sol.u[solved], other.u[solved]) < SAME


@pytest.mark.parametrize("seed", range(4))
def test_random_systems(seed):
    """Data without any structure: random inputs and outputs, random weights, bounds that cut."""
    n_u, n_y, t_ini, horizon = 2, 1, 2, 5
    u, y = randn(60, n_u, seed=seed), randn(60, n_y, seed=seed + 50)
    data = dpc.HankelData.from_trajectories(u, y, t_ini=t_ini, horizon=horizon)
    A = randn(horizon * n_u, horizon * n_u, seed=seed + 100)
    weights = {"Q": 1.0, "R": 1.0, "lambda_g": 10.0 ** (seed - 1), "lambda_s": 10.0}
    u_ini, y_ini = randn(20, t_ini, n_u, seed=seed + 1), randn(20, t_ini, n_y, seed=seed + 2)
    sets = {"u_set": dpc.Box(-0.3, 0.2), "y_set": dpc.Box(-0.4, 0.1)}
    for R in (1.0, A @ A.T):
        layers = [dpc.DPCLayer(data, **{**weights, "R": R}, **sets, solver=s, on_failure="nan") for s in ENGINES]
        sols = [layer(u_ini, y_ini, y_ref=torch.ones(n_y)) for layer in layers]
        assert all((sol.info.status == 0).all() for sol in sols)
        assert max(relative(sol.u, sols[0].u) for sol in sols) < SAME
        for i in range(4):
            plan, _ = reference_plan(layers[0], u_ini[i], y_ini[i], torch.ones(n_y))
            assert relative(sols[0].u[i], plan) < PLAN


@pytest.mark.parametrize("solver", ENGINES)
def test_an_answer_does_not_depend_on_what_was_asked_before(solver):
    layer = small_layer(0.0, y_set=dpc.Box(-0.9, 0.9), solver=solver)
    u_ini, y_ini = windows(6, 3, seed=1, scale=0.7)
    first = [layer(a, b, y_ref=Y_REF) for a, b in zip(u_ini, y_ini, strict=True)]
    for a, b, before in reversed(list(zip(u_ini, y_ini, first, strict=True))):
        again = layer(a, b, y_ref=Y_REF)
        assert torch.equal(again.u, before.u) and torch.equal(again.y, before.y) and torch.equal(again.lam, before.lam)


@pytest.mark.parametrize("solver", ENGINES)
def test_a_failed_sample_leaves_nothing_behind(solver):
    """DAQP returns the answer before with a flag that says solved, after an update that it rejected."""
    layer = small_layer(0.0, solver=solver, u_set=dpc.Box(-0.5, 0.5), y_set=dpc.Box(-0.9, 0.9))
    impossible = small_layer(0.0, solver=solver, u_set=dpc.Box(-0.1, 0.1), y_set=dpc.Box(5.0, 6.0))
    u_ini, y_ini = windows(1, 3, seed=1, scale=0.7)
    before = layer(u_ini[0], y_ini[0], y_ref=Y_REF)
    with pytest.raises(ValueError, match="`y_ini`.*finite"):
        layer(u_ini[0], torch.full_like(y_ini[0], torch.nan), y_ref=Y_REF)
    for _ in range(2):
        with pytest.raises(dpc.InfeasibleError):
            impossible(u_ini[0], y_ini[0], y_ref=Y_REF)
    assert torch.equal(layer(u_ini[0], y_ini[0], y_ref=Y_REF).u, before.u)


def test_threads_share_a_layer():
    layer = small_layer(0.0, y_set=dpc.Box(-0.9, 0.9))
    u_ini, y_ini = windows(64, 3, seed=1, scale=0.7)
    expected = [layer(a, b, y_ref=Y_REF).u for a, b in zip(u_ini, y_ini, strict=True)]
    found = [None] * 64

    def work(start):
        for _ in range(5):
            for i in range(start, 64, 4):
                found[i] = layer(u_ini[i], y_ini[i], y_ref=Y_REF).u

    threads = [threading.Thread(target=work, args=(k,)) for k in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert all(torch.equal(a, b) for a, b in zip(found, expected, strict=True))


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 16, 17, 130, 300])
def test_a_batch_is_its_samples_on_every_path(count):
    layer = small_layer(0.0, y_set=dpc.Box(-0.9, 0.9))
    u_ini, y_ini = windows(count, 3, seed=2, scale=0.7)
    sol = layer(u_ini, y_ini, y_ref=Y_REF)
    for i in {0, count // 2, count - 1}:
        alone = layer(u_ini[i], y_ini[i], y_ref=Y_REF)
        assert relative(sol.u[i], alone.u) < SAME and relative(sol.lam[i], alone.lam) < SAME


def test_info_says_what_happened():
    layer = small_layer(0.0, y_set=dpc.Box(-0.9, 0.9))
    u_ini, y_ini = windows(20, 3, seed=2, scale=0.7)
    for solver in ENGINES:
        layer = dpc.DPCLayer(small_data(0.0), **SMALL, u_set=dpc.Box(-0.5, 0.5), solver=solver)
        info = layer(u_ini, y_ini, y_ref=Y_REF).info
        for name in ("status", "iterations", "n_active", "n_weakly_active"):
            assert getattr(info, name).shape == (20,) and getattr(info, name).dtype == torch.int64
        assert info.residual.shape == (20,) and info.residual.max() < 1e-11
        assert (info.status == dpc.Status.SOLVED).all() and not info.n_weakly_active.any()
        assert (info.iterations <= 50).all() and (info.iterations >= 0).all()
        assert "status" in repr(info)


# --- weakly active rows -----------------------------------------------------------------------------------------------


def test_at_a_kink_the_gradient_lies_between_the_one_sided_ones():
    layer = small_layer(0.0, u_set=dpc.Box(-1.0, 1.0))
    u_ini, y_ini = HOLDING.expand(3, 2), Y_REF.expand(3, 4)
    sol = layer(u_ini, y_ini, y_ref=Y_REF, u_ref=HOLDING)
    assert relative(sol.u, HOLDING.expand(6, 2)) < SAME and sol.info.n_weakly_active == 12 and sol.info.n_active == 0
    jacobian = jacrev(lambda y: layer(u_ini, y, y_ref=Y_REF, u_ref=HOLDING).u)(y_ini)
    free = small_layer(0.0, u_set=None)
    assert relative(jacobian, jacrev(lambda y: free(u_ini, y, y_ref=Y_REF, u_ref=HOLDING).u)(y_ini)) < SAME
    # Ask for less of every input: the plan leaves its bounds, along the derivative returned; ask for more: it stays.
    slope = jacfwd(lambda u_ref: layer(u_ini, y_ini, y_ref=Y_REF, u_ref=u_ref).u)(HOLDING).sum(-1)
    assert slope.min() > 0
    for step, expected in ((-1e-6, slope), (1e-6, 0 * slope)):
        moved = (layer(u_ini, y_ini, y_ref=Y_REF, u_ref=HOLDING + step).u - sol.u) / step
        assert (moved - expected).abs().max() < 1e-6 * slope.max()


@pytest.mark.parametrize("solver", ["newton", "daqp"])
def test_one_weakly_active_row_is_bracketed(solver):
    """A single step, a single input: the scalar problem whose solution is a clipped line."""
    data = delayed_data(n=60, t_ini=2, horizon=1)
    layer = dpc.DPCLayer(data, 0.0, 1.0, 1.0, 1e3, dpc.Box(-0.5, 0.5), solver=solver)
    u_ini, y_ini = torch.zeros(2, 1, dtype=torch.float64), torch.zeros(2, 2, dtype=torch.float64)

    def plan(u_ref):
        return layer(u_ini, y_ini, u_ref=u_ref).u[0, 0]

    for u_ref, slope, weak in ((0.4, 1.0, 0), (0.6, 0.0, 0), (0.5, 1.0, 1), (-0.5, 1.0, 1), (-0.7, 0.0, 0)):
        x = torch.tensor([u_ref], dtype=torch.float64, requires_grad=True)
        plan(x).backward()
        assert plan(x).item() == pytest.approx(min(max(u_ref, -0.5), 0.5), abs=1e-12)
        assert x.grad.item() == pytest.approx(slope, abs=1e-9)
        assert layer(u_ini, y_ini, u_ref=x.detach()).info.n_weakly_active.item() == weak
        one_sided = sorted(((plan(x + s * 1e-4) - plan(x)) / (s * 1e-4)).item() for s in (1, -1))
        assert one_sided[0] - 1e-9 <= x.grad.item() <= one_sided[1] + 1e-9


def test_at_the_masses_steady_state_all_inputs_are_weakly_active():
    layer = paper_layer()
    plant = dpc.systems.OscillatingMasses()
    y = [plant.reset(Y_REF)] + [plant.step(HOLDING) for _ in range(5)]
    y_ini = torch.stack(y).requires_grad_()
    for batch in ((), (1,), (20,)):
        sol = layer(HOLDING.expand(*batch, 6, 2), y_ini.expand(*batch, 6, 4), y_ref=Y_REF, u_ref=HOLDING)
        assert (sol.info.n_weakly_active == 50).all() and (sol.info.n_active == 0).all()
        (found,) = torch.autograd.grad(sol.u.sum(), y_ini)
        free = paper_layer(u_set=None)(HOLDING.expand(6, 2), y_ini, y_ref=Y_REF, u_ref=HOLDING)
        (expected,) = torch.autograd.grad(free.u.sum(), y_ini)
        assert expected.norm() > 1 and relative(found, expected * max(1, sum(batch))) < 1e-8


# --- boxes ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("bounds", "says"),
    [
        ((1.0, -1.0), "`lower` must be at most `upper`"),
        ((torch.zeros(2), torch.tensor([1.0, -1.0])), "`lower` must be at most `upper`"),
        ((torch.nan, 1.0), "`lower`.*NaN"),
        ((-1.0, torch.tensor([1.0, torch.nan])), "`upper`.*NaN"),
        ((torch.inf, torch.inf), "`lower` must be below"),
        ((-torch.inf, -torch.inf), "`upper` above"),
        ((torch.tensor([0]), 1.0), "`lower` must hold floating-point numbers, got torch.int64"),
        (("a", 1.0), "`lower` must be a number or an array"),
    ],
    ids=str,
)
def test_bad_boxes_are_named(bounds, says):
    with pytest.raises(ValueError, match=says):
        dpc.Box(*bounds)
