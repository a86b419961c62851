"""Weights that hold under attack: both derivatives of the objective, the gauge, the attacker, and the search."""

import io
import math

import pytest
import torch

import torch_dpc as dpc
from helpers import central, delayed_layer, delayed_windows, randn, relative, small_data, small_layer, windows
from torch_dpc import tuning

BUDGET = dpc.attacks.RelativeBall(0.05)
TARGET = dpc.attacks.TargetInput(torch.tensor([0.4, -0.3]))
# Central differences of step 1e-4 in logarithms: their own error is 1e-8 of the derivative.
STEP, DIFFERENCES = 1e-4, 1e-6


def objective(n=4, *, layer=None, u_ref=None, **options):
    """Runs that begin near the reference: a horizon of 0.6 s decides little of those that begin far from it."""
    layer = small_layer() if layer is None else layer
    u_ini, y_ini = windows(n, t_ini=3, seed=3, scale=0.1)
    y_ref = torch.tensor([0.1, -0.1, 0.0, 0.0])
    options.setdefault("predictor", tuning.Predictor(layer.data))
    return tuning.RobustObjective(layer, tuning.Windows(u_ini, y_ini, y_ref, u_ref), BUDGET, **options)


def scales_at(vector):
    scales = tuning.WeightScales(small_layer())
    torch.nn.utils.vector_to_parameters(vector, scales.parameters())
    return scales


def gradient(objective, vector):
    scales = scales_at(vector.clone())
    objective(scales)["total"].backward()
    return torch.cat([s.grad.reshape(-1) for s in scales.parameters()])


def differences(objective, vector):
    return central(lambda x: objective(scales_at(x))["total"], vector, STEP)


# --- derivatives --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("psi", [TARGET, None], ids=["target", "worst"])
@pytest.mark.parametrize(("plans", "iterations"), [(1, 1), (3, 1), (1, 3)])
def test_gradient_through_the_attack_is_the_whole_derivative(psi, plans, iterations):
    J = objective(psi=psi, plans=plans, replan_every=2 if plans > 1 else None, iterations=iterations)
    at = 0.3 * randn(8, seed=1)
    assert relative(gradient(J, at), differences(J, at)) < DIFFERENCES


def test_danskin_is_the_derivative_of_the_worst_case():
    J = objective(through="danskin", iterations=100)  # the maximiser to the last digits
    at = 0.3 * randn(8, seed=1)
    assert relative(gradient(J, at), differences(J, at)) < DIFFERENCES


def test_danskin_is_the_partial_derivative_for_another_attacker():
    at = 0.3 * randn(8, seed=1)
    J = objective(psi=TARGET, through="danskin")
    layer = scales_at(at).apply_to(J.layer)
    p = dpc.attacks.LinearizedAttack(layer, TARGET, BUDGET)(J.u_ini, J.y_ini, y_ref=J.y_ref, u_ref=J.u_ref)
    held = objective(through="danskin", attack=lambda layer: lambda *_, **__: p)
    partial = gradient(J, at)
    assert relative(partial, differences(held, at)) < DIFFERENCES
    whole = gradient(objective(psi=TARGET), at)
    assert relative(partial, whole) > 1e-3  # the attacker's own answer matters here


def test_attacked_weight_zero_leaves_the_nominal_cost():
    at = 0.3 * randn(8, seed=1)
    J = objective(attacked_weight=0.0)
    value = J(scales_at(at))
    assert value["total"] == value["nominal"] < value["attacked"]


# --- what is computed ----------------------------------------------------------------------------------------------


def test_one_plan_costs_what_the_layer_the_attack_and_the_predictor_say():
    J = objective(psi=TARGET)
    nominal, attacked = J.costs(tuning.WeightScales(J.layer))
    call = {"y_ref": J.y_ref, "u_ref": J.u_ref}
    p = dpc.attacks.LinearizedAttack(J.layer, TARGET, BUDGET)(J.u_ini, J.y_ini, **call)
    for costs, seen in ((nominal, J.y_ini), (attacked, J.y_ini + p)):
        u = J.layer(J.u_ini, seen, **call).u
        y = tuning.DataPredictor(J.layer.data)(J.u_ini, J.y_ini, u)
        expected = 0.5 * (10 * (y - J.y_ref).square().sum(-1) + (u - J.u_ref).square().sum(-1)).mean(-1)
        torch.testing.assert_close(costs.detach(), expected, rtol=1e-10, atol=0)


def test_several_plans_are_the_closed_loop_of_simulate():
    """With the plant's own model as predictor, the objective is the run that `simulate` makes."""
    plant, data = dpc.systems.OscillatingMasses(), small_data()
    layer = small_layer()
    state = torch.tensor([0.5, -0.2, 0.1, 0.0])
    target = dpc.attacks.TargetInput(trajectory=0.3 * randn(40, 2))
    y_ref = 0.2 * randn(30, 4, seed=4)
    logs = [
        dpc.simulate(
            plant, dpc.DPCController(layer, 4), y_ref, steps=12, attack=attack, reset={"state": state}, u_warmup=0.1
        )
        for attack in (None, dpc.attacks.LinearizedAttack(layer, target, BUDGET))
    ]
    y = [plant.reset(state)]
    u_ini = torch.full((1, data.t_ini, 2), 0.1, dtype=torch.float64)
    y += [plant.step(u) for u in u_ini[0, :-1]]

    def model(u_ini, y_ini, u):
        x, out = y_ini[:, -1], []
        for k in range(u.shape[1]):
            x = x @ plant.A.T + (u_ini[:, -1] if k == 0 else u[:, k - 1]) @ plant.B.T
            out.append(x)
        return torch.stack(out, dim=1)

    J = tuning.RobustObjective(
        layer,
        tuning.Windows(u_ini, torch.stack(y)[None], y_ref),
        BUDGET,
        psi=target,
        predictor=model,
        cost=tuning.MeanError([0, 1]),
        plans=3,
        replan_every=4,
    )
    for cost, log in zip(J.costs(tuning.WeightScales(layer)), logs, strict=True):
        error = torch.linalg.vector_norm((log.y - log.y_ref)[:, :2], dim=1).mean()
        assert abs(float(cost.detach()) - float(error)) < 2 * tuning.MeanError.SMOOTH


def test_iterations_raise_the_worst_case():
    scales = tuning.WeightScales(small_layer())
    costs = [objective(iterations=n).costs(scales)[1].detach() for n in (1, 2, 5)]
    assert (costs[1] >= costs[0] - 1e-12).all() and (costs[2] >= costs[1] - 1e-12).all()
    assert (costs[2] > costs[0]).any()


def test_a_window_without_a_plan_holds_its_last_input():
    layer = delayed_layer()
    u_ini, y_ini = delayed_windows(3, impossible=[1])
    status = layer(u_ini, y_ini, on_failure="nan").info.status
    assert (status == torch.tensor([dpc.Status.SOLVED, dpc.Status.INFEASIBLE, dpc.Status.SOLVED])).all()
    run = {"predictor": tuning.Predictor(layer.data), "plans": 2, "replan_every": 3}
    J = tuning.RobustObjective(layer, tuning.Windows(u_ini, y_ini, torch.zeros(2)), BUDGET, **run)
    scales = tuning.WeightScales(layer)
    held = J.predictor(u_ini[1:2], y_ini[1:2], u_ini[1:2, -1:].expand(-1, 6, -1))
    seen = []
    J.cost = lambda u, y, u_ref, y_ref: (seen.append((u, y)), y.square().sum((-2, -1)))[1]
    J(scales)["total"].backward()
    assert (seen[-1][0][[1, 4], :3] == u_ini[1, -1]).all()  # nominal and attacked
    torch.testing.assert_close(seen[-1][1][1, :3], held[0, :3])
    assert all(torch.isfinite(s.grad).all() for s in scales.parameters())


# --- the gauge -----------------------------------------------------------------------------------------------------


def test_a_common_factor_changes_nothing():
    J, at = objective(psi=TARGET), 0.3 * randn(8, seed=1)
    assert J(scales_at(at))["total"].item() == pytest.approx(J(scales_at(at + 1.7))["total"].item(), rel=1e-12)
    assert abs(float(gradient(J, at).sum())) < 1e-10 * float(gradient(J, at).abs().max())


def test_scales_act_on_the_diagonals_and_keep_the_mean_of_log_R():
    Q = torch.tensor([10.0, 1.0, 0.0, 2.0], dtype=torch.float64)
    layer = dpc.DPCLayer(small_data(), Q=torch.diag(Q), R=2.0, lambda_g=3.0, lambda_s=5)
    scales = tuning.WeightScales(layer)
    vector = torch.tensor([0.1, 0.2, 1.0, 2.0, 3.0, 4.0, 0.5, -0.5], dtype=torch.float64)
    torch.nn.utils.vector_to_parameters(vector, scales.parameters())
    tuned, e = scales.apply_to(layer), vector.exp()
    torch.testing.assert_close(tuned.Q, torch.diag(Q * e[2:6]))
    torch.testing.assert_close(tuned.R, torch.diag(2 * e[6:]))
    torch.testing.assert_close(torch.stack([tuned.lambda_g, tuned.lambda_s]), e[:2] * torch.tensor([3.0, 5.0]))


def test_horizon_long_weights_are_scaled_step_by_step():
    A = randn(24, 24)
    layer = dpc.DPCLayer(small_data(), Q=A @ A.T, R=1.0, lambda_g=1.0, lambda_s=1e3)
    scales = tuning.WeightScales(layer)
    with torch.no_grad():
        scales.Q.copy_(torch.tensor([0.0, math.log(4.0), 0.0, 0.0]))
    Q = scales.apply_to(layer).Q
    rows = torch.tensor([1.0, 2.0, 1.0, 1.0], dtype=torch.float64).repeat(6)
    torch.testing.assert_close(Q, rows[:, None] * (A @ A.T) * rows)
    with pytest.raises(ValueError, match="spans the horizon"):
        objective(layer=layer)


def test_parameters_of_the_layer_are_left_alone():
    layer = small_layer(Q=torch.nn.Parameter(10 * torch.eye(4, dtype=torch.float64)))
    tuning.tune(objective(layer=layer, psi=TARGET), steps=2)
    assert layer.Q.grad is None and torch.equal(layer.Q.detach(), 10 * torch.eye(4, dtype=torch.float64))


# --- predictors and costs -------------------------------------------------------------------------------------------


def test_data_predictor_is_the_least_squares_fit_on_noisy_data():
    data = small_data()
    W = torch.cat([data.Up, data.Yp, data.Uf])
    fit = torch.linalg.lstsq(W.T, data.Yf.T).solution.T
    torch.testing.assert_close(tuning.DataPredictor(data).matrix, fit, rtol=1e-8, atol=1e-10)


# --- tuning ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("through", ["danskin", "attack"])
def test_tuning_lowers_the_objective_and_gives_a_layer_that_has_it(through):
    run = {"psi": TARGET, "plans": 4, "replan_every": 3, "cost": tuning.MeanError([0, 1]), "attacked_weight": 2.0}
    J = objective(through=through, **run)
    rows = []
    result = tuning.tune(J, steps=15, progress=rows.append)
    assert result.history == rows and [row["step"] for row in rows] == list(range(15))
    assert result.best["total"] == min(row["total"] for row in rows) < 0.85 * rows[0]["total"]
    again = objective(layer=result.layer, **run)
    assert again(tuning.WeightScales(result.layer))["total"].item() == pytest.approx(result.best["total"], rel=1e-10)


def test_tuning_with_one_free_weight_moves_that_one():
    layer = small_layer()
    scales = tuning.WeightScales(layer)
    for name, scale in scales.named_parameters():
        scale.requires_grad_(name == "lambda_s")
    result = tuning.tune(objective(psi=TARGET), steps=3, scales=scales)
    assert float(result.layer.lambda_s) != 1e3
    assert float(result.layer.lambda_g) == 1.0 and torch.equal(result.layer.Q, 10 * torch.eye(4, dtype=torch.float64))


def test_several_recordings_share_the_scales():
    layers = [dpc.DPCLayer(small_data(seed=s), Q=10.0, R=1.0, lambda_g=1.0, lambda_s=1e3) for s in (0, 1)]
    each = [objective(layer=layer, psi=TARGET) for layer in layers]
    scales = tuning.WeightScales(layers[0])
    mean = sum(J(scales)["total"].item() for J in each) / 2
    assert tuning.tune(each, steps=1).history[0]["total"] == pytest.approx(mean, rel=1e-12)


def test_limit_and_seconds_bound_the_search():
    result = tuning.tune(objective(psi=TARGET), steps=5, lr=1.0, limit=0.5)
    assert result.scales.vector.abs().max() <= 0.5
    assert len(tuning.tune(objective(psi=TARGET), steps=5, seconds=0.0).history) == 1


# --- bad input ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"through": "envelope"}, "`through` must be"),
        ({"replan_every": 7}, "`replan_every` must be at most the horizon, 6, got 7"),
        ({"plans": 0}, "`plans` must be a positive integer"),
        ({"attacked_weight": -1.0}, "`attacked_weight` must be finite and not negative"),
        ({"attack": lambda layer: None}, "has no derivative here"),
        ({"u_ref": torch.zeros(3)}, r"`u_ref` must have shape \(2,\)"),
    ],
)
def test_bad_options_are_named(options, message):
    with pytest.raises(ValueError, match=message):
        objective(**options)


def test_bad_windows_are_named():
    layer = small_layer()
    with pytest.raises(ValueError, match=r"`windows` must hold u_ini and y_ini of shape \(B, t_ini, n\)"):
        tuning.RobustObjective(layer, tuning.Windows(torch.zeros(3, 2), torch.zeros(3, 4), torch.zeros(4)), BUDGET)
    with pytest.raises(ValueError, match="`data` must be one HankelData, got list"):
        tuning.DataPredictor([])
    with pytest.raises(ValueError, match="at least one"):
        tuning.tune([])
    batched = dpc.DPCLayer(small_data(), Q=10.0, R=1.0, lambda_g=torch.tensor([1.0, 2.0]), lambda_s=1e3)
    with pytest.raises(ValueError, match="batch dimension"):
        objective(layer=batched, cost=tuning.MeanError([0]))(tuning.WeightScales(batched))


def test_data_that_would_judge_their_own_plans_are_refused():
    u_ini, y_ini = windows(2, t_ini=3, seed=3)
    with pytest.raises(ValueError, match=r"`predictor` must say what inputs truly do.*tuning.Predictor\(other_data\)"):
        tuning.RobustObjective(small_layer(), tuning.Windows(u_ini, y_ini, torch.zeros(4)), BUDGET)


# --- the gain ---------------------------------------------------------------------------------------------------------


def test_the_gain_is_that_of_the_worst_perturbation_and_below_the_certificate():
    layer = small_layer()
    free = dpc.DPCLayer(layer.data, Q=10.0, R=1.0, lambda_g=1.0, lambda_s=1e3)
    y_ini = torch.zeros(3, 4).double()
    jacobian = torch.autograd.functional.jacobian(lambda y: free(torch.zeros(3, 2).double(), y).u.flatten(), y_ini)
    expected = float(torch.linalg.svdvals(jacobian.reshape(12, 12))[0])
    assert float(tuning.plan_gain(layer)) == pytest.approx(expected, rel=1e-8)
    pytest.importorskip("clarabel", reason="extra `exact`")
    assert float(tuning.plan_gain(layer)) <= float(dpc.attacks.sensitivity_bound(layer)) * (1 + 1e-9)


def test_the_gain_in_the_objective_has_its_derivative_and_falls():
    at = 0.3 * randn(8, seed=1)
    J = objective(psi=TARGET, gain_weight=0.1)
    assert relative(gradient(J, at), differences(J, at)) < DIFFERENCES
    value = J(scales_at(at))
    expected = value["nominal"] + value["attacked"] + 0.1 * value["gain"]
    torch.testing.assert_close(value["total"], expected)
    result = tuning.tune(objective(psi=TARGET, gain_weight=10.0), steps=10, progress=False)
    assert float(tuning.plan_gain(result.layer)) < float(tuning.plan_gain(small_layer()))


# --- progress ---------------------------------------------------------------------------------------------------------


def test_progress_is_shown_unless_it_is_switched_off(caplog, capsys):
    caplog.set_level("INFO", logger="torch_dpc.tuning")
    tuning.tune(objective(psi=TARGET), steps=3)  # no terminal here: the log
    assert [record.message.split(":")[0] for record in caplog.records] == [f"step {k} of 3" for k in (1, 2, 3)]
    assert "objective" in caplog.records[0].message and not capsys.readouterr().out
    caplog.clear()
    tuning.tune(objective(psi=TARGET), steps=2, progress=False)
    assert not caplog.records


def test_a_terminal_shows_a_bar(monkeypatch):
    pytest.importorskip("tqdm", reason="extra `scripts`")
    screen = io.StringIO()
    screen.isatty = lambda: True
    monkeypatch.setattr("sys.stderr", screen)
    tuning.tune(objective(psi=TARGET), steps=3)
    assert "3/3" in screen.getvalue() and "best=" in screen.getvalue()
