"""What an attacker who knows less can do: the data's own predictor, surrogates, and attacks that only query."""

import functools

import pytest
import torch

import torch_dpc as dpc
from helpers import (
    HOLDING,
    PAPER,
    Y_REF,
    generator,
    masses_data,
    paper_layer,
    randn,
    relative,
    small_data,
    small_layer,
    windows,
)
from recordings import quadrotor_recording
from torch_dpc import attacks
from torch_dpc.attacks.base import AttackCall

EXACT = 1e-9  # of the noise-free predictor: its recording has a condition of 1e5
INSIDE = 1e-9
DIFFERENCES = 1e-5  # of gradients by differences of 1e-4


# --- the predictor and the cost that uses it --------------------------------------------------------------------------


def run(state, u):
    """Return the true outputs of the masses from a state, y[k] before u[k] is applied, and the state at the end."""
    plant, ys = dpc.systems.OscillatingMasses(), []
    y = plant.reset(state)
    for step in u:
        ys.append(y)
        y = plant.step(step)
    return torch.stack(ys), y


@functools.cache
def true_futures(n=5):
    """Return windows of the masses, inputs to come, and the true outputs under them."""
    u = randn(n, 31, 2, seed=1)
    y = torch.stack([run(state, inputs)[0] for state, inputs in zip(randn(n, 4, seed=2), u, strict=True)])
    return u[:, :6], y[:, :6], u[:, 6:], y[:, 6:]


def test_noise_free_data_predict_the_true_model():
    u_ini, y_ini, u, y = true_futures()
    predictor = attacks.Predictor(masses_data())
    assert relative(predictor(u_ini, y_ini, u), y) < EXACT
    assert relative(predictor(u_ini[0], y_ini[0], u[0]), y[0]) < EXACT
    assert relative(predictor(u_ini[0], y_ini[0], u), predictor(u_ini[:1], y_ini[:1], u)) < EXACT  # broadcast


def test_noisy_data_predict_it_better_the_less_noise_there_is():
    u_ini, y_ini, u, y = true_futures()
    errors = [relative(attacks.Predictor(masses_data(noise))(u_ini, y_ini, u), y) for noise in (1e-1, 1e-2, 1e-3, 1e-4)]
    assert errors == sorted(errors, reverse=True) and errors[0] < 1 and errors[-1] < 1e-2


@pytest.mark.parametrize("units", [1.0, 1e-4])
def test_of_noisy_data_it_is_the_subspace_predictor(units):
    """Yf W^+ by an SVD of all columns; the units of a channel change nothing."""
    u, y = quadrotor_recording()
    scale = torch.tensor([1.0, 1.0, 1.0, units, units, units], dtype=torch.float64)
    data = dpc.HankelData.from_trajectories(u, y * scale, t_ini=6, horizon=25)
    plain = dpc.HankelData.from_trajectories(u, y, t_ini=6, horizon=25)
    W = torch.cat([plain.Up, plain.Yp, plain.Uf])
    u_ini, y_ini, inputs = randn(3, 6, 3, seed=1), randn(3, 6, 6, seed=2), randn(3, 25, 3, seed=3)
    w = torch.cat([x.flatten(-2) for x in (u_ini, y_ini, inputs)], dim=-1)
    expected = (w @ (plain.Yf @ torch.linalg.pinv(W)).T).reshape(3, 25, 6)
    assert relative(attacks.Predictor(data)(u_ini, y_ini * scale, inputs), expected * scale) < 1e-8  # cond(W) near 1e5


def test_its_map_has_a_derivative():
    u_ini, y_ini, u, _ = true_futures()
    predictor = attacks.Predictor(masses_data())
    J = torch.autograd.functional.jacobian(lambda x: predictor(u_ini[0], y_ini[0], x), u[0]).reshape(100, 50)
    assert relative(predictor.matrix[:, -50:], J) < EXACT
    assert torch.linalg.matrix_norm(J.reshape(25, 4, 25, 2)[3, :, 3]) < 1e-9  # the output before the input


@pytest.mark.parametrize(("name", "shape"), [("u_ini", (5, 2)), ("y_ini", (6, 3)), ("u", (24, 2))])
def test_shapes_that_the_predictor_does_not_take_are_named(name, shape):
    call = {"u_ini": torch.zeros(6, 2), "y_ini": torch.zeros(6, 4), "u": torch.zeros(25, 2), name: torch.zeros(shape)}
    with pytest.raises(ValueError, match=f"`{name}` must have shape"):
        attacks.Predictor(masses_data())(**call)


def test_tracking_error_is_that_of_the_true_plant_under_the_poisoned_plan():
    layer, cost = paper_layer(), attacks.TrackingError(masses_data(), Q=torch.diag(torch.tensor([1.0, 2.0, 0.0, 0.5])))
    u_ini, y_ini = (w[0] for w in windows(1, seed=3))
    refs = {"y_ref": Y_REF, "u_ref": HOLDING}
    p = attacks.RandomAttack(attacks.RelativeBall(0.1))(u_ini, y_ini, generator=generator())
    sol = layer(u_ini, y_ini + p, **refs)
    state = run(y_ini[0], u_ini)[1]
    error = run(state, sol.u)[0] - Y_REF
    expected = -0.5 * (error.square() * torch.tensor([1.0, 2.0, 0.0, 0.5]).double()).sum()
    psi = cost.given(u_ini=u_ini, y_ini=y_ini, y_ref=Y_REF)(sol)
    assert relative(psi, expected) < EXACT
    believed = -0.5 * ((sol.y - Y_REF).square() * torch.tensor([1.0, 2.0, 0.0, 0.5]).double()).sum()
    assert relative(believed, expected) > 1e-3  # what the controller was made to believe is something else


def test_attacks_bind_the_cost_to_the_true_window_and_reference():
    layer, cost = paper_layer(), attacks.TrackingError(masses_data(), Q=10.0)
    u_ini, y_ini = windows(4, seed=3)
    y_ref = Y_REF + 0.1 * randn(4, 25, 4, seed=5)
    budget = attacks.RelativeBall(0.05)
    together = attacks.LinearizedAttack(layer, cost, budget)(u_ini, y_ini, y_ref=y_ref, u_ref=HOLDING)
    for i in range(4):
        x = y_ini[i].clone().requires_grad_()
        u = layer(u_ini[i], x, y_ref=y_ref[i], u_ref=HOLDING).u
        y = run(run(y_ini[i, 0], u_ini[i])[1], u)[0]  # the masses' own steps carry the derivative
        (-5 * (y - y_ref[i]).square().sum()).backward()
        expected = -0.05 * y_ini[i].norm() * x.grad / x.grad.norm()
        assert relative(together[i], expected) < 1e-6


def test_perfect_tracking_has_no_direction_and_a_random_start_finds_one():
    layer, cost = paper_layer(), attacks.TrackingError(masses_data())
    u_ini, y_ini = HOLDING.expand(6, 2), Y_REF.expand(6, 4)
    refs = {"y_ref": Y_REF, "u_ref": HOLDING}
    budget = attacks.RelativeBall(0.05)
    assert not attacks.LinearizedAttack(layer, cost, budget)(u_ini, y_ini, **refs).any()
    p = attacks.ProjectedGradientAttack(layer, cost, budget, restarts=2)(u_ini, y_ini, **refs, generator=generator())
    assert cost.given(u_ini=u_ini, y_ini=y_ini, y_ref=Y_REF)(layer(u_ini, y_ini + p, **refs)) < -1e-3


def test_a_plan_alone_does_not_say_where_the_system_is():
    with pytest.raises(ValueError, match="needs the unattacked window"):
        attacks.TrackingError(small_data())(small_layer()(*windows(1, 3)))


def test_costs_of_ones_own_may_know_the_step_the_window_and_the_references():
    seen = {}

    class Curious:
        def at(self, step):
            seen["step"] = step
            return self

        def given(self, **window):
            seen.update(window)
            return lambda sol: sol.u.sum((-2, -1))

    layer, (u_ini, y_ini) = small_layer(), windows(2, 3, seed=1)
    attacks.LinearizedAttack(layer, Curious(), attacks.Ball(0.1))(u_ini, y_ini, y_ref=Y_REF, u_ref=HOLDING, step=7)
    assert seen.pop("step") == 7
    for name, value in {"u_ini": u_ini, "y_ini": y_ini, "y_ref": Y_REF, "u_ref": HOLDING}.items():
        torch.testing.assert_close(seen[name], value)


# --- surrogates -------------------------------------------------------------------------------------------------------


def test_a_surrogate_that_is_the_victim_is_algorithm_1():
    victim, twin = (
        paper_layer(),
        dpc.DPCLayer(masses_data(), **PAPER, u_set=dpc.Box(-1.0, 1.0), y_set=dpc.Box(-5.0, 5.0)),
    )
    u_ini, y_ini = windows(3, seed=2)
    cost, budget = attacks.TargetInput(torch.zeros(2)), attacks.RelativeBall(0.1)
    same = [attacks.LinearizedAttack(layer, cost, budget)(u_ini, y_ini, y_ref=Y_REF) for layer in (victim, twin)]
    assert relative(*same) < 1e-12


@pytest.mark.parametrize("horizon", [1, 10, 40])
def test_another_horizon_cuts_the_references_or_holds_their_last_row(horizon):
    surrogate = dpc.DPCLayer(masses_data(horizon=horizon), **PAPER, u_set=dpc.Box(-1.0, 1.0))
    u_ini, y_ini = windows(3, seed=2)
    y_ref, u_ref, target = Y_REF + randn(3, 25, 4, seed=1), randn(25, 2, seed=2), randn(25, 2, seed=3)
    rows = torch.arange(horizon).clamp_max(24)
    fitting = {"y_ref": y_ref[:, rows], "u_ref": u_ref[rows]}
    budget = attacks.RelativeBall(0.1)
    given = attacks.LinearizedAttack(surrogate, attacks.TargetInput(target), budget)
    fitted = attacks.LinearizedAttack(surrogate, attacks.TargetInput(target[rows]), budget)
    p = given(u_ini, y_ini, y_ref=y_ref, u_ref=u_ref)
    assert p.any() and torch.equal(p, fitted(u_ini, y_ini, **fitting))
    tracking = attacks.LinearizedAttack(surrogate, attacks.TrackingError(surrogate.data), budget)
    assert torch.equal(tracking(u_ini, y_ini, y_ref=y_ref, u_ref=u_ref), tracking(u_ini, y_ini, **fitting))
    with pytest.raises(ValueError, match=f"the plans have {horizon} steps and the `data` of TrackingError predict 25"):
        attacks.LinearizedAttack(surrogate, attacks.TrackingError(masses_data()), budget)(u_ini, y_ini, y_ref=y_ref)


def test_a_surrogate_with_a_shorter_past_leaves_the_older_rows_alone():
    surrogate = dpc.DPCLayer(masses_data(t_ini=4), **PAPER, u_set=dpc.Box(-1.0, 1.0))
    u_ini, y_ini = windows(3, seed=2)
    cost, budget = attacks.TargetInput(torch.zeros(2)), attacks.Ball(0.1)
    p = attacks.LinearizedAttack(surrogate, cost, budget)(u_ini, y_ini, y_ref=Y_REF)
    short = attacks.LinearizedAttack(surrogate, cost, budget)(u_ini[:, 2:], y_ini[:, 2:], y_ref=Y_REF)
    assert not p[:, :2].any() and torch.equal(p[:, 2:], short)
    with pytest.raises(ValueError, match="may look at fewer past steps than the controller, not at more"):
        attacks.LinearizedAttack(paper_layer(), cost, budget)(u_ini[:, 2:], y_ini[:, 2:])


@pytest.mark.parametrize(
    "change",
    [
        {"data": masses_data(seed=3)},
        {"data": masses_data(1e-3, seed=3)},
        {"data": masses_data(steps=200, seed=3)},
        {"data": masses_data(horizon=20)},
        {"Q": 20.0, "R": 0.5},
        {"lambda_s": 1e5},
    ],
    ids=["other data", "noise", "fewer samples", "horizon", "weights", "lambda_s"],
)
def test_an_attack_planned_on_a_surrogate_still_hurts(change):
    victim = paper_layer()
    surrogate = dpc.DPCLayer(**{"data": masses_data(), **PAPER, "u_set": dpc.Box(-1.0, 1.0), **change})
    u_ini, y_ini = windows(20, seed=4)
    refs = {"y_ref": Y_REF, "u_ref": HOLDING}
    cost, budget = attacks.TargetInput(torch.zeros(2)), attacks.RelativeBall(0.1)
    nominal = cost(victim(u_ini, y_ini, **refs)).mean()
    effects = []
    for layer in (victim, surrogate):
        p = attacks.ProjectedGradientAttack(layer, cost, budget)(u_ini, y_ini, **refs)
        assert budget.excess(p, y_ini).max() <= INSIDE
        effects.append(nominal - cost(victim(u_ini, y_ini + p, **refs)).mean())
    assert 0.5 * effects[0] < effects[1] < 1.01 * effects[0]


# --- attacks that only ask --------------------------------------------------------------------------------------------


def problem():
    return small_layer(), attacks.TargetInput(torch.tensor([0.5, -0.5])), attacks.RelativeBall(0.05)


def test_finite_differences_give_algorithm_1_away_from_kinks():
    layer, cost, budget = problem()
    u_ini, y_ini = windows(4, 3, seed=2)
    asking = attacks.FiniteDifferenceAttack(layer, cost, budget)
    p, known = (
        asking(u_ini, y_ini, y_ref=Y_REF),
        attacks.LinearizedAttack(layer, cost, budget)(u_ini, y_ini, y_ref=Y_REF),
    )
    assert relative(p, known) < DIFFERENCES
    assert asking.n_queries == 4 * (1 + 2 * 12 + 1)  # at zero, around it, and the answer
    asking(u_ini[0], y_ini[0], y_ref=Y_REF)
    assert asking.n_queries == 5 * 26


def test_the_slope_by_queries_is_the_slope():
    """Algorithm 1 looks at the direction alone: the size of the slope counts where psi and its slope are compared."""
    layer, cost, budget = problem()
    u_ini, y_ini = windows(4, 3, seed=2)
    call = AttackCall(u_ini, y_ini, Y_REF, None, None, 0)
    p = torch.zeros_like(y_ini)
    psi, slope = attacks.FiniteDifferenceAttack(layer, cost, budget)._objective(call).gradient(p)
    right = attacks.ProjectedGradientAttack(layer, cost, budget)._objective(call).gradient(p)
    assert relative(psi, right[0]) < DIFFERENCES and relative(slope, right[1]) < DIFFERENCES


def test_random_directions_are_cheaper_and_rougher():
    layer, cost, budget = problem()
    u_ini, y_ini = windows(20, 3, seed=2)
    known = attacks.LinearizedAttack(layer, cost, budget)(u_ini, y_ini)
    cosines = []
    for directions in (3, 30, 300):
        attack = attacks.FiniteDifferenceAttack(layer, cost, budget, directions=directions)
        p = attack(u_ini, y_ini, generator=generator(1))
        assert torch.equal(p, attack(u_ini, y_ini, generator=generator(1)))
        assert attack.n_queries == 2 * 20 * (2 * directions + 2)
        cosines.append(float(((p * known).sum((-2, -1)) / (0.05 * y_ini).square().sum((-2, -1))).mean()))
    # the cosine of an estimate from m normal directions in n = 12 dimensions is about (m / (m + n + 1))^(1/2)
    for cosine, m in zip(cosines, (3, 30, 300), strict=True):
        assert abs(cosine - (m / (m + 13)) ** 0.5) < 0.15
    assert cosines == sorted(cosines)


def test_with_steps_it_goes_on_as_projected_gradient():
    layer, cost, budget = problem()
    u_ini, y_ini = windows(6, 3, seed=2)
    once, more = (attacks.FiniteDifferenceAttack(layer, cost, budget, steps=s) for s in (0, 10))
    psi = [cost(layer(u_ini, y_ini + attack(u_ini, y_ini))) for attack in (once, more)]
    assert (psi[1] <= psi[0] * (1 + 1e-12)).all() and psi[1].mean() < psi[0].mean()
    assert more.n_queries < 6 * (11 * 25 + 1)  # samples that have arrived do not ask any more


def test_random_search_spends_its_queries_and_only_improves():
    layer, cost, budget = problem()
    u_ini, y_ini = windows(10, 3, seed=2)
    nominal = cost(layer(u_ini, y_ini))
    last = nominal
    for queries in (1, 10, 100, 400):
        attack = attacks.RandomSearchAttack(layer, cost, budget, queries=queries)
        p = attack(u_ini, y_ini, generator=generator(1))
        assert attack.n_queries == 10 * queries and budget.excess(p, y_ini).max() <= INSIDE
        psi = cost(layer(u_ini, y_ini + p))
        assert (psi <= last * (1 + 1e-12)).all()  # the same draws, cut off later
        last = psi
    best = cost(layer(u_ini, y_ini + attacks.ProjectedGradientAttack(layer, cost, budget)(u_ini, y_ini)))
    assert (nominal - last).mean() > 0.9 * (nominal - best).mean()


@pytest.mark.parametrize(
    "make",
    [
        attacks.FiniteDifferenceAttack,
        functools.partial(attacks.FiniteDifferenceAttack, steps=3, directions=10),
        functools.partial(attacks.RandomSearchAttack, queries=20),
    ],
    ids=["differences", "directions", "search"],
)
@pytest.mark.parametrize("batch", [(), (0,), (1,), (2, 3)], ids=str)
def test_they_take_every_batch_and_precision(make, batch):
    layer, cost, budget = problem()
    u_ini, y_ini = windows(6, 3, seed=1)
    n = torch.Size(batch).numel()
    u_ini, y_ini = (w[:n].float().reshape(*batch, *w.shape[1:]) for w in (u_ini, y_ini))
    y_ref = randn(*batch, 6, 4, seed=3)
    p = make(layer, cost, budget)(u_ini, y_ini, y_ref=y_ref, generator=generator())
    assert p.shape == y_ini.shape and p.dtype == torch.float32
    assert (budget.excess(p.double(), y_ini.double()) <= INSIDE).all()


def test_any_controller_can_be_asked_and_shows_its_inputs_alone():
    """y is not shown; a plan of NaN is none; budgets without convexity and costs from the true window work."""
    layer = small_layer()
    asked = []

    def controller(u_ini, y_ini, *, y_ref, u_ref):
        asked.append(y_ini.shape[:-2].numel())
        u = layer(u_ini, y_ini, y_ref=y_ref, u_ref=u_ref).u
        return torch.where((y_ini[..., -1, 0] > 0.3)[..., None, None], torch.nan, u)

    u_ini, y_ini = windows(5, 3, seed=1)
    y_ini = y_ini - torch.relu(y_ini[:, -1:, :1] - 0.25) * torch.tensor([1.0, 0.0, 0.0, 0.0])
    cost, budget = attacks.TrackingError(layer.data), attacks.SparseBall(1, 0.2)
    for make in (attacks.FiniteDifferenceAttack, attacks.RandomSearchAttack):
        attack, before = make(controller, cost, budget), sum(asked)
        p = attack(u_ini, y_ini, y_ref=Y_REF, generator=generator())
        assert attack.n_queries == sum(asked) - before
        assert ((y_ini + p)[:, -1, 0] <= 0.3).all() and p.any() and budget.excess(p, y_ini).max() <= INSIDE
        with pytest.raises(AttributeError, match="'y'"):
            make(controller, lambda seen: seen.y.sum((-2, -1)), budget)(u_ini, y_ini)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda *a: attacks.FiniteDifferenceAttack(*a, probe=0.0), "`probe` must be positive"),
        (lambda *a: attacks.FiniteDifferenceAttack(*a, directions=0), "`directions` must be a positive integer"),
        (lambda *a: attacks.RandomSearchAttack(*a, queries=0), "`queries` must be a positive integer"),
    ],
    ids=["probe", "directions", "queries"],
)
def test_bad_options_are_named(make, message):
    with pytest.raises(ValueError, match=message):
        make(*problem())
