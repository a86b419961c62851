"""Bad input is named; a sample without a solution is marked, and harms no other."""

import pytest
import torch

import torch_dpc as dpc
from helpers import (
    HOLDING,
    PAPER,
    SMALL,
    Y_REF,
    delayed_layer,
    delayed_windows,
    masses_data,
    randn,
    relative,
    small_data,
    small_layer,
    windows,
)

#: The samples that remain are those of the batch without the failed one, to this.
UNTOUCHED = 1e-12
#: The full system amplifies the rounding of its right-hand side by its condition, 1e4 here.
UNTOUCHED_FULL = 1e-10


def idle_layer(**options):
    """The second actuator never moves in the data."""
    u = torch.cat([randn(100, 1, seed=1), torch.zeros(100, 1, dtype=torch.float64)], dim=1)
    y = torch.zeros(100, 1, dtype=torch.float64)
    for k in range(99):
        y[k + 1] = 0.9 * y[k] + u[k, 0]
    with pytest.warns(dpc.ExcitationWarning):
        data = dpc.HankelData.from_trajectories(u, y, t_ini=2, horizon=5)
    return dpc.DPCLayer(data, **SMALL, u_set=dpc.Box(-1.0, 1.0), **options)


# --- no solution ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("solver", ["auto", "newton", "daqp"])
@pytest.mark.parametrize("size", [1e-6, 1e-3, 1.0, 1e3])
def test_a_u_ini_the_data_cannot_produce_is_infeasible(solver, size):
    layer = idle_layer(solver=solver)
    u_ini, y_ini = torch.zeros(3, 2, 2, dtype=torch.float64), randn(3, 2, 1, seed=2)
    u_ini[..., 0] = 0.5
    u_ini[1, 0, 1] = size
    with pytest.raises(dpc.InfeasibleError, match="index 1:.*data cannot produce") as caught:
        layer(u_ini, y_ini)
    assert caught.value.indices == [(1,)]
    sol = layer(u_ini, y_ini, on_failure="nan")
    assert sol.info.status.tolist() == [dpc.Status.SOLVED, dpc.Status.INFEASIBLE, dpc.Status.SOLVED]
    with pytest.raises(dpc.InfeasibleError, match="the problem:"):
        layer(u_ini[1], y_ini[1])


@pytest.mark.parametrize("solver", ["auto", "newton", "daqp"])
def test_output_bounds_that_exclude_every_plan_name_the_batch_indices(solver):
    layer = delayed_layer(solver=solver)
    u_ini, y_ini = delayed_windows(6, impossible=(1, 4))
    with pytest.raises(dpc.InfeasibleError, match=r"batch indices 1, 4:") as caught:
        layer(u_ini, y_ini)
    assert caught.value.indices == [(1,), (4,)] and isinstance(caught.value, dpc.SolveError)
    with pytest.raises(dpc.InfeasibleError, match=r"batch indices \(0, 1\), \(1, 1\):") as caught:
        layer(u_ini.reshape(2, 3, 3, 1), y_ini.reshape(2, 3, 3, 2))
    assert caught.value.indices == [(0, 1), (1, 1)]


@pytest.mark.parametrize("solver", ["auto", "newton", "daqp"])
def test_masses_that_cannot_stay_that_far_out(solver):
    """Between 6 and 9 m the springs pull back with 6 N, the inputs hold with 1 N: out again after 1.8 of 2.4 s."""
    sets = {"u_set": dpc.Box(-1.0, 1.0), "y_set": dpc.Box(torch.tensor([6.0, 6.0, -9.0, -9.0]), 9.0)}
    layer = dpc.DPCLayer(masses_data(), **PAPER, **sets, solver=solver)
    u_ini, y_ini = windows(2, seed=1)
    with pytest.raises(dpc.InfeasibleError, match="batch indices 0, 1"):
        layer(u_ini, y_ini, y_ref=Y_REF, u_ref=HOLDING)


@pytest.mark.parametrize("beyond", [1e-6, 1e-4, 0.1])
def test_slightly_infeasible_is_not_solved(beyond):
    layer = delayed_layer()
    u_ini, y_ini = delayed_windows(2)
    u_ini[1, -1] = 0.5 + beyond
    assert layer(u_ini, y_ini, on_failure="nan").info.status.tolist() == [0, dpc.Status.INFEASIBLE]
    u_ini[1, -1] = 0.5 - beyond
    assert layer(u_ini, y_ini).info.status.tolist() == [0, 0]


@pytest.mark.parametrize("backward", ["reduced", "full"])
@pytest.mark.parametrize("solver", ["auto", "newton", "daqp"])
@pytest.mark.parametrize("count", [1, 2, 3, 4, 16, 17, 40])
def test_a_failed_sample_changes_nothing_for_the_others(count, solver, backward):
    layer = delayed_layer(on_failure="nan", solver=solver, backward=backward)
    bad = count // 2
    u_all, y_all = delayed_windows(count + 1, impossible=(bad,))
    others = [i for i in range(count + 1) if i != bad]
    sol, grads = plan_and_gradients(layer, u_all, y_all)
    without, grads_without = plan_and_gradients(layer, u_all[others], y_all[others])
    assert sol.info.status.tolist() == [int(i == bad) for i in range(count + 1)]
    for name in ("u", "y", "g"):
        found = getattr(sol, name)
        assert found[bad].isnan().all()
        assert relative(found[others], getattr(without, name)) < UNTOUCHED, name
    assert sol.info.n_active[bad] == 0 and sol.info.n_weakly_active[bad] == 0
    tolerance = UNTOUCHED if backward == "reduced" else UNTOUCHED_FULL
    for found, expected in zip(grads[:2], grads_without[:2], strict=True):
        assert expected.abs().max() > 1e-2 and not found[bad].any()
        assert relative(found[others], expected) < tolerance
    for found, expected in zip(grads[2:], grads_without[2:], strict=True):
        assert expected.abs().max() > 1e-2 and relative(found, expected) < tolerance


def plan_and_gradients(layer, u_ini, y_ini):
    refs = 0.1 * torch.ones(2, dtype=torch.float64), 0.1 * torch.ones(1, dtype=torch.float64)
    inputs = [x.clone().requires_grad_() for x in (u_ini, y_ini, *refs)]
    sol = layer(*inputs[:2], y_ref=inputs[2], u_ref=inputs[3])
    (sol.u.square().sum() + sol.y.sum() + sol.g.square().sum()).backward()
    return sol, [x.grad for x in inputs]


def test_a_failed_sample_adds_nothing_to_the_weights():
    u_all, y_all = delayed_windows(5, impossible=(2,))
    keep = [0, 1, 3, 4]
    grads = []
    for u_ini, y_ini in ((u_all, y_all), (u_all[keep], y_all[keep])):
        numbers = {"Q": 1.0, "R": 0.1, "lambda_g": 1.0, "lambda_s": 1e3}
        weights = {name: torch.nn.Parameter(torch.tensor(w).double()) for name, w in numbers.items()}
        layer = delayed_layer(**weights, on_failure="nan")
        sol = layer(u_ini, y_ini, y_ref=0.1 * torch.ones(2))
        assert sol.info.status.count_nonzero() == len(u_ini) - 4
        sol.u.square().sum().backward()
        grads.append(torch.stack([w.grad for w in weights.values()]))
    assert grads[1][:2].abs().min() > 1e-3 and relative(*grads) < UNTOUCHED


def test_forward_mode_skips_failed_samples():
    layer = delayed_layer(on_failure="nan")
    u_ini, y_ini = delayed_windows(3, impossible=(1,))
    _, tangent = torch.func.jvp(lambda y: layer(u_ini, y).u, (y_ini,), (torch.ones_like(y_ini),))
    alone = torch.func.jvp(lambda y: layer(u_ini[2], y).u, (y_ini[2],), (torch.ones_like(y_ini[2]),))[1]
    assert relative(tangent[2], alone) < UNTOUCHED


def test_a_failure_under_vmap_is_named():
    layer = delayed_layer()
    u_ini, y_ini = delayed_windows(3, impossible=(1,))
    with pytest.raises(dpc.InfeasibleError, match="index 1"):
        torch.func.vmap(lambda u, y: layer(u, y).u)(u_ini, y_ini)
    found = torch.func.vmap(lambda u, y: layer(u, y, on_failure="nan").u)(u_ini, y_ini)
    assert found[1].isnan().all() and not found[[0, 2]].isnan().any()


def test_weights_with_a_batch_dimension_and_a_failure():
    lambda_s = torch.tensor([1e2, 1e3, 1e4], dtype=torch.float64)
    u_ini, y_ini = delayed_windows(3, impossible=(1,))
    sol = delayed_layer(lambda_s=lambda_s)(u_ini, y_ini, on_failure="nan")
    assert sol.info.status.tolist() == [0, dpc.Status.INFEASIBLE, 0]
    for i in (0, 2):
        assert relative(sol.u[i], delayed_layer(lambda_s=float(lambda_s[i]))(u_ini[i], y_ini[i]).u) < 1e-10


# --- bad input --------------------------------------------------------------------------------------------------------

u_ini, y_ini = (w[0] for w in windows(1, 3))
NAN, INF = y_ini.clone(), u_ini.clone()
NAN[1, 2], INF[0, 0] = torch.nan, torch.inf


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"y_ini": y_ini.T}, r"`y_ini` must have shape \(\*batch, t_ini, n_y\) = \(\*, 3, 4\), got \(4, 3\)"),
        ({"y_ini": y_ini[0]}, r"`y_ini` must have shape .* got \(4,\)"),
        ({"u_ini": u_ini[None, :2]}, r"`u_ini` must have shape .* = \(\*, 3, 2\), got \(1, 2, 2\)"),
        ({"u_ini": torch.zeros(())}, r"`u_ini` must have shape .* got \(\)"),
        ({"u_ini": u_ini.long()}, "`u_ini` must hold floating-point numbers, got torch.int64"),
        ({"y_ini": y_ini > 0}, "`y_ini` must hold floating-point numbers, got torch.bool"),
        ({"y_ini": y_ini + 0j}, "`y_ini` must hold floating-point numbers, got torch.complex128"),
        ({"y_ini": [[0, 0, 0, 0]] * 3}, "`y_ini` must hold floating-point numbers, got int64"),
        ({"u_ini": None}, "`u_ini` must hold floating-point numbers"),
        ({"y_ini": NAN}, "`y_ini` must be finite, got 1 NaN or infinite of 12 values"),
        ({"u_ini": INF}, "`u_ini` must be finite"),
        ({"y_ini": torch.stack([y_ini] * 30 + [NAN])}, "`y_ini` must be finite"),
        ({"y_ref": torch.full((4,), torch.nan)}, "`y_ref` must be finite"),
        ({"u_ref": torch.full((6, 2), -torch.inf)}, "`u_ref` must be finite"),
        ({"y_ref": torch.ones(5, 4)}, r"`y_ref` .*broadcast to \(\*batch, horizon, n_y\) = \(\*, 6, 4\), got \(5, 4\)"),
        ({"y_ref": torch.ones(3)}, r"`y_ref` must broadcast .* got \(3,\)"),
        ({"u_ref": torch.ones(6, 2).int()}, "`u_ref` must hold floating-point numbers, got torch.int32"),
        ({"u_ini": u_ini.expand(2, 3, 2), "y_ini": y_ini.expand(5, 3, 4)}, r"broadcast.*u_ini \(2,\), y_ini \(5,\)"),
        ({"on_failure": "ignore"}, "`on_failure` must be one of 'raise', 'nan', got 'ignore'"),
    ],
    ids=lambda v: v[:40] if isinstance(v, str) else "",
)
def test_bad_calls_are_named(change, says):
    in_one_of_many = says == "`y_ini` must be finite" and len(change["y_ini"]) == 31  # "nan" marks that sample
    for failures in ("raise",) if in_one_of_many else ("raise", "nan"):
        with pytest.raises(ValueError, match=says):
            small_layer(on_failure=failures)(**{"u_ini": u_ini, "y_ini": y_ini, **change})


SKEW = torch.eye(4) + torch.triu(torch.ones(4, 4), 1)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"Q": SKEW}, "`Q` must be symmetric"),
        ({"Q": -torch.eye(4)}, "`Q` must be positive semidefinite, got an eigenvalue of -1"),
        ({"Q": torch.eye(3)}, r"`Q` must .*\(4, 4\).*\(24, 24\).*got \(3, 3\)"),
        ({"Q": torch.ones(4)}, r"`Q` must .* got \(4,\)"),
        ({"Q": torch.eye(4).long()}, "`Q` must hold floating-point numbers, got torch.int64"),
        ({"R": torch.nan}, "`R` must be finite"),
        ({"R": "big"}, "`R` must be a number or a tensor"),
        ({"R": True}, "`R` must be a number or a tensor, got True"),
        ({"R": None}, "`R` must be a number or a tensor"),
        ({"lambda_g": -1.0}, "`lambda_g` must not be negative, got -1"),
        ({"lambda_s": torch.inf}, "`lambda_s` must be finite"),
        ({"lambda_s": torch.tensor(3)}, "`lambda_s` must hold floating-point numbers"),
        ({"u_set": (-1.0, 1.0)}, "`u_set` must be a ConvexSet or None, got tuple"),
        ({"y_set": dpc.Box(torch.zeros(3), 1.0)}, r"bounds of `y_set` .*got \(3,\)"),
        ({"solver": "osqp"}, "`solver` must be one of .* got 'osqp'"),
        ({"backward": "none"}, "`backward` must be one of 'reduced', 'full', got 'none'"),
        ({"on_failure": None}, "`on_failure` must be one of"),
        ({"R": [True, False]}, "`R` must be a number or a tensor, got .True, False."),
        ({"lambda_g": torch.ones(0)}, r"`lambda_g` must hold .* got shape \(0,\)"),
        ({"Q": torch.ones(0, 4, 4)}, r"`Q` must hold .* got shape \(0, 4, 4\)"),
        ({"y_set": dpc.SoftBox(-1.0, 1.0, torch.ones(3))}, "`y_set` does not fit 4 channels over 6 steps"),
        ({"data": 3}, "`data` must be a HankelData or a HankelBatch, got int"),
    ],
    ids=lambda v: v[:40] if isinstance(v, str) else "",
)
def test_bad_layers_are_named(change, says):
    with pytest.raises(ValueError, match=says):
        dpc.DPCLayer(**{"data": small_data(), **SMALL, **change})


def test_bounds_crossed_later_are_told_at_the_next_call():
    box = dpc.Box(torch.tensor([-0.5, -0.5]), torch.tensor([0.5, 0.5]))
    layer = small_layer(u_set=box)
    layer(u_ini, y_ini)
    box.upper[1] = -0.6
    with pytest.raises(ValueError, match="`lower` must be at most `upper`"):
        layer(u_ini, y_ini)


def test_weights_spoilt_later_are_told_at_the_next_call():
    layer = small_layer(R=torch.nn.Parameter(torch.eye(2)))
    layer(u_ini, y_ini)
    layer.R.data[0, 0] = torch.nan
    for grad in (True, False):
        with torch.set_grad_enabled(grad), pytest.raises(ValueError, match="`R` must be finite"):
            layer(u_ini, y_ini)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"on_failure": "foo"}, "`on_failure` must be one of 'raise', 'nan', got 'foo'"),
        ({"solver": "foo"}, "`solver` must be one of"),
        ({"backward": "foo"}, "`backward` must be one of 'reduced', 'full', got 'foo'"),
        ({"regularizer": "ridge"}, "`regularizer` must be one of"),
        ({"terminal_steps": 7}, "`terminal_steps` must be an integer from 0 to the horizon, 6, got 7"),
        ({"terminal_steps": 1.0}, "`terminal_steps` must be an integer from 0 to the horizon, got 1.0"),
        ({"lambda_u": 1.0, "R_du": 1.0}, "which `lambda_u` leaves open"),
        ({"lambda_u": -1.0}, "`lambda_u` must not be negative"),
        ({"lambda_s": None}, "`lambda_s` must be a number or a tensor, got None"),
        ({"u_set": (-1.0, 1.0)}, "`u_set` must be a ConvexSet or None, got tuple"),
        ({"u_set": dpc.Box(torch.zeros(3), 1.0)}, r"bounds of `u_set` .*got \(3,\)"),
        ({"solver": "daqp", "u_set": dpc.Ball(1.0)}, "is for sets that are boxes"),
        ({"u_set": dpc.Ball(1.0), "solver": "daqp"}, "is for sets that are boxes"),
        ({"backward": "full", "du_set": dpc.Ball(1.0)}, 'backward="full" is the system of the paper'),
        ({"backward": "full", "lambda_u": 1.0}, 'backward="full" is the system of the paper'),
        ({"data": 3}, "`data` must be a HankelData or a HankelBatch, got int"),
        ({"Q": torch.eye(4), "data": delayed_layer().data}, "`u_ini` must have shape .* got"),
        (
            {"u_set": dpc.Box(-torch.ones(6, 2), 1.0), "data": masses_data(1e-2, steps=150, t_ini=3, horizon=8)},
            r"bounds of `u_set` .* \(8, 2\) .*got \(6, 2\)",
        ),
    ],
    ids=lambda v: v[:40] if isinstance(v, str) else "",
)
def test_settings_spoilt_later_are_told_at_the_next_call_at_the_latest(changes, says):
    layer = small_layer()
    layer(u_ini, y_ini)
    with pytest.raises(ValueError, match=says):
        for name, value in changes.items():
            setattr(layer, name, value)
        layer(u_ini, y_ini)
    repr(layer)


def test_parameters_of_sets_spoilt_later_are_told_at_the_next_call():
    layer = small_layer()
    layer(u_ini, y_ini)
    layer.u_set.lower = torch.full((3,), -1.0)
    with pytest.raises(ValueError, match=r"bounds of `u_set` .*got \(3,\)"):
        layer(u_ini, y_ini)
    layer = small_layer(u_set=dpc.Ball(1.0))
    layer.u_set.radius = torch.ones(5)
    with pytest.raises(ValueError, match="`u_set` does not fit 2 channels over 6 steps"):
        layer(u_ini, y_ini)


def test_a_setting_that_does_not_fit_may_be_on_the_way_to_one_that_does():
    layer = small_layer(backward="full", solver="daqp")
    layer.u_set = dpc.Ball(0.3)
    layer.backward, layer.solver = "reduced", "auto"
    assert float(layer(u_ini, y_ini, y_ref=Y_REF).u.norm(dim=-1).amax()) == pytest.approx(0.3, abs=1e-9)


@pytest.mark.parametrize("sets", [{}, {"u_set": dpc.Ball(0.3)}], ids=["boxes", "ball"])
@pytest.mark.parametrize("spoilt", [torch.nan, torch.inf])
def test_a_value_that_is_not_finite_marks_its_sample(sets, spoilt):
    layer = small_layer(**sets, on_failure="nan")
    u, y = windows(4, 3, seed=1, scale=0.5)
    with_nan = y.clone()
    with_nan[2, 1, 3] = spoilt
    plans, bars = [], []
    for measured in (y, with_nan):
        x = measured.clone().requires_grad_()
        plan = layer(u, x, y_ref=Y_REF)
        plan.u[[0, 1, 3]].square().sum().backward()
        plans.append(plan)
        bars.append(x.grad)
    whole, marked = plans
    assert marked.info.status.tolist() == [0, 0, 2, 0] and marked.u[2].isnan().all() and marked.g[2].isnan().all()
    assert torch.equal(marked.u[[0, 1, 3]], whole.u[[0, 1, 3]]) and not marked.lam[2].any()
    assert relative(bars[1][[0, 1, 3]], bars[0][[0, 1, 3]]) < 1e-12 and not bars[1][2].any()
    with pytest.raises(ValueError, match="`y_ini` must be finite, got 1 NaN or infinite"):
        layer(u, with_nan, on_failure="raise")
