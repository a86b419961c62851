"""What the problem may have beyond the paper's: closed forms, limits, gradients."""

import pytest
import torch

import torch_dpc as dpc
from helpers import SMALL, Y_REF, central, masses_data, paper_layer, randn, relative, small_data, windows
from torch_dpc.problem.projected_kkt import optimality_map

#: A dense system of 200 unknowns, condition 1e6.
CLOSED_FORM = 1e-9
DIFFERENCES = 1e-6
EXACT = 1e-10

U_REF = torch.tensor([1.0, -0.5], dtype=torch.float64)
TERMS = {
    "identity": {"regularizer": "identity"},
    "spc": {"regularizer": "spc"},
    "gamma": {"regularizer": "gamma", "beta_2": 3.0},
    "affine, gamma, slack": {"affine": True, "regularizer": "gamma", "beta_2": 3.0, "lambda_u": 5.0},
    "affine, spc, rate cost": {"affine": True, "regularizer": "spc", "R_du": 2.0},
    "slack": {"lambda_u": 50.0},
    "rate cost": {"R_du": torch.tensor([[3.0, 1.0], [1.0, 2.0]], dtype=torch.float64)},
    "terminal": {"terminal_steps": 1},
    "two terminal steps": {"terminal_steps": 2},
    "identity, rate cost, terminal": {"regularizer": "identity", "R_du": 2.0, "terminal_steps": 1},
    "identity, slack, terminal": {"regularizer": "identity", "lambda_u": 5.0, "terminal_steps": 1},
    "affine": {"affine": True},
    "affine, identity, slack": {"affine": True, "regularizer": "identity", "lambda_u": 5.0},
    "affine, rate cost, terminal": {"affine": True, "R_du": 2.0, "terminal_steps": 1},
    "terminal weight": {"Q_terminal": torch.diag(torch.tensor([300.0, 200.0, 0.0, 5.0], dtype=torch.float64))},
}


def layer_of(name, noise=1e-2, **options):
    return dpc.DPCLayer(small_data(noise), **{**SMALL, **TERMS[name], **options})


def inputs(n=3):
    u_ini, y_ini = windows(n, 3, seed=1, scale=0.5)
    return 0.3 * u_ini, y_ini + 0.05 * randn(n, 3, 4, seed=2)


def by_hand(layer, options, u_ini, y_ini):
    """The unconstrained plan, built here from the data: minimise over g, with the equalities as they are."""
    data, h = layer.data, layer.data.horizon
    Up, Yp, Uf, Yf = data.matrices
    ones = torch.ones(1, data.n_g, dtype=torch.float64)
    W = torch.cat([Up, Yp, Uf, ones]) if "affine" in options else torch.cat([Up, Yp, Uf])
    eye = torch.eye(data.n_g, dtype=torch.float64)
    N = eye if options.get("regularizer") == "identity" else eye - torch.linalg.pinv(W) @ W
    rows, targets = [], []

    def charge(weight, block, target):
        rows.append(weight @ block)
        targets.append(weight @ target)

    charge(torch.eye(len(Uf)).double() * SMALL["R"] ** 0.5, Uf, U_REF.repeat(h))
    Q = torch.full((h, 4), SMALL["Q"], dtype=torch.float64)
    Q[-1] = options["Q_terminal"].diagonal() if "Q_terminal" in options else Q[-1]
    charge(torch.diag(Q.flatten().sqrt()), Yf, Y_REF.repeat(h))
    none = torch.zeros(data.n_g, dtype=torch.float64)
    if options.get("regularizer") != "spc":
        charge(eye * (2 * SMALL["lambda_g"]) ** 0.5, N, none)
    if "beta_2" in options:
        past = torch.cat([Up, Yp, ones]) if "affine" in options else torch.cat([Up, Yp])
        explained = torch.linalg.pinv(W) @ W - torch.linalg.pinv(past) @ past
        charge(eye * (2 * options["beta_2"]) ** 0.5, explained, none)
    charge(torch.eye(len(Yp)).double() * (2 * SMALL["lambda_s"]) ** 0.5, Yp, y_ini.flatten())
    if "R_du" in options:
        S = options["R_du"]
        S = S if isinstance(S, torch.Tensor) else S * torch.eye(2, dtype=torch.float64)
        root = torch.linalg.cholesky(S).T
        u = Uf.reshape(h, 2, -1)
        change = torch.cat([u[:1], u[1:] - u[:-1]])
        target = torch.zeros(h, 2, dtype=torch.float64)
        target[0] = u_ini[-1]
        charge(torch.block_diag(*[root] * h), change.reshape(2 * h, -1), target.flatten())
    held, values = ([ones], [ones[0, :1]]) if "affine" in options else ([], [])
    if "lambda_u" in options:
        charge(torch.eye(len(Up)).double() * (2 * options["lambda_u"]) ** 0.5, Up, u_ini.flatten())
    else:
        held.append(Up)
        values.append(u_ini.flatten())
    if options.get("regularizer") == "spc":
        held.append(torch.linalg.svd(W)[2][len(W) :])
        values.append(none[len(W) :])
    if steps := options.get("terminal_steps"):
        held.append(Yf[-4 * steps :])
        values.append(Y_REF.repeat(steps))
    E, e, start, Z = torch.cat(rows), torch.cat(targets), torch.zeros(data.n_g, dtype=torch.float64), eye
    if held:
        A = torch.cat(held)
        start, Z = torch.linalg.pinv(A) @ torch.cat(values), torch.linalg.svd(A)[2][len(A) :].T
    g = start + Z @ torch.linalg.lstsq(E @ Z, (e - E @ start)[:, None], driver="gelsd").solution[:, 0]
    return (Uf @ g).reshape(h, 2), (Yf @ g).reshape(h, 4), g


@pytest.mark.parametrize("name", TERMS)
def test_the_free_plan_is_that_of_the_cost_written_out(name):
    layer, (u_ini, y_ini) = layer_of(name), inputs()
    sol = layer(u_ini, y_ini, y_ref=Y_REF, u_ref=U_REF)
    plain = dpc.DPCLayer(small_data(), **SMALL)(u_ini, y_ini, y_ref=Y_REF, u_ref=U_REF)
    for i in range(3):
        for found, expected in zip(
            (sol.u[i], sol.y[i], sol.g[i]), by_hand(layer, TERMS[name], u_ini[i], y_ini[i]), strict=True
        ):
            assert relative(found, expected) < CLOSED_FORM
    assert relative(plain.u, sol.u) > 1e-3  # the term makes a difference


@pytest.mark.parametrize("name", TERMS)
@pytest.mark.parametrize("bounded", [False, True])
def test_the_papers_map_vanishes_on_the_compact_form(name, bounded):
    sets = {"u_set": dpc.Box(-0.4, 0.4)} if bounded and "terminal" not in name else {}
    layer, (u_ini, y_ini) = layer_of(name, **sets), inputs(1)
    refs = {"y_ref": Y_REF, "u_ref": U_REF}
    sol = layer(u_ini[0], y_ini[0], **refs)
    P, q, H, b = layer.compact_form(u_ini[0], y_ini[0], **refs)
    z = torch.cat([sol.u.flatten(), sol.y.flatten(), sol.g])
    n = 36
    lower, upper = (bound[:n] for bound in layer.bounds(torch.device("cpu")))
    lam = torch.zeros_like(z)
    lam[:n] = sol.lam[:n]
    w = torch.linalg.lstsq(H.T, -(P @ z + q + lam)[:, None], driver="gelsd").solution[:, 0]
    F = optimality_map(dpc.CompactForm(P, q, H, b), z, w, lower, upper)
    assert float(F.norm() / (1 + (P @ z).norm() + q.norm())) < 1e-10
    assert int(sol.info.n_active) > 0 if sets else True


@pytest.mark.parametrize("name", TERMS)
@pytest.mark.parametrize("which", ["u_ini", "y_ini", "y_ref", "u_ref", "weight"])
def test_gradients_are_those_of_differences(name, which):
    (u_ini, y_ini), h = inputs(), 6
    point = {"u_ini": u_ini, "y_ini": y_ini, "y_ref": Y_REF + 0.1 * randn(3, h, 4, seed=8), "u_ref": randn(3, h, 2)}
    weight = next((k for k in ("beta_2", "R_du", "lambda_u") if k in TERMS[name]), None)
    weight = weight or ("lambda_s" if "spc" in name else "lambda_g")
    start = torch.as_tensor(TERMS[name].get(weight, SMALL.get(weight)), dtype=torch.float64)
    value = start if which == "weight" else point[which]

    def scalar(x):
        sets = {} if "terminal" in name else {"u_set": dpc.Box(-0.4, 0.4)}
        learned = {} if which != "weight" else {weight: (x + x.mT) / 2 if x.ndim == 2 else x}
        sol = layer_of(name, **sets, **learned)(**{**point, **({} if which == "weight" else {which: x})})
        return (randn(3, h, 2, seed=5) * sol.u).sum() + (randn(3, h, 4, seed=6) * sol.y).sum()

    x = value.clone().requires_grad_()
    scalar(x).backward()
    assert relative(x.grad, central(scalar, value, 1e-6 * max(1.0, float(value.abs().max())))) < DIFFERENCES


def test_limits_on_changes_hold_from_the_last_input_on():
    u_ini, y_ini = inputs()
    for du_set, size in (
        (dpc.Box(-0.2, 0.2), lambda du: du.abs().amax()),
        (dpc.Ball(0.2), lambda du: du.norm(dim=-1).amax()),
    ):
        sol = dpc.DPCLayer(small_data(), **SMALL, du_set=du_set, u_set=dpc.Box(-0.5, 0.5))(u_ini, y_ini, y_ref=Y_REF)
        changes = torch.cat([u_ini[:, -1:], sol.u], dim=1).diff(dim=1)
        assert abs(float(size(changes)) - 0.2) < EXACT
        assert (sol.info.n_active > 0).all()
    free = dpc.DPCLayer(small_data(), **SMALL, u_set=dpc.Box(-0.5, 0.5))(u_ini, y_ini, y_ref=Y_REF)
    wide = dpc.DPCLayer(small_data(), **SMALL, du_set=dpc.Box(-9.0, 9.0), u_set=dpc.Box(-0.5, 0.5))
    assert relative(wide(u_ini, y_ini, y_ref=Y_REF).u, free.u) < EXACT


def test_a_large_price_on_the_slack_is_the_equality():
    u_ini, y_ini = inputs()
    exact = dpc.DPCLayer(small_data(), **SMALL)(u_ini, y_ini, y_ref=Y_REF).u
    errors = [relative(layer_of("slack", lambda_u=w)(u_ini, y_ini, y_ref=Y_REF).u, exact) for w in (1e4, 1e6, 1e8)]
    assert errors[0] > 50 * errors[1] > 2000 * errors[2]  # the error falls like 1 / lambda_u


def test_a_slack_takes_inputs_that_the_data_cannot_produce():
    source = torch.Generator().manual_seed(0)
    u, y = dpc.collect(dpc.systems.OscillatingMasses(), 150, generator=source, amplitude=torch.tensor([1.0, 0.0]))
    with pytest.warns(dpc.ExcitationWarning):
        data = dpc.HankelData.from_trajectories(u, y, t_ini=3, horizon=6)
    u_ini, y_ini = inputs()
    sets = {"on_failure": "nan"}
    assert (dpc.DPCLayer(data, **SMALL, **sets)(u_ini, y_ini).info.status == dpc.Status.INFEASIBLE).all()
    assert (dpc.DPCLayer(data, **SMALL, lambda_u=10.0, **sets)(u_ini, y_ini).info.status == dpc.Status.SOLVED).all()


@pytest.mark.parametrize("noise", [0.0, 1e-2])
def test_the_plan_ends_at_its_reference(noise):
    layer = paper_layer(noise, terminal_steps=1)
    u_ini, y_ini = windows(4, seed=3)
    sol = layer(u_ini, y_ini, y_ref=0.1 * Y_REF)
    assert float((sol.y[:, -1] - 0.1 * Y_REF).abs().max()) < 1e-9 and (sol.info.n_active > 0).any()


def test_the_last_steps_meet_the_last_rows_of_a_moving_reference():
    y_ref = torch.linspace(0.0, 0.2, 25, dtype=torch.float64)[:, None] * Y_REF
    sol = paper_layer(1e-2, terminal_steps=2)(*windows(2, seed=3, scale=0.1), y_ref=y_ref)
    assert float((sol.y[:, -2:] - y_ref[-2:]).abs().max()) < 1e-9


def test_terminal_outputs_outside_their_set_are_infeasible():
    layer = dpc.DPCLayer(masses_data(1e-2), **SMALL, y_set=dpc.Box(-0.5, 0.5), terminal_steps=1, on_failure="nan")
    u_ini, y_ini = windows(2, seed=3, scale=0.1)
    status = layer(u_ini, y_ini, y_ref=torch.stack([0.2 * Y_REF, Y_REF])[:, None]).info.status
    assert status.tolist() == [dpc.Status.SOLVED, dpc.Status.INFEASIBLE]


def test_rate_terms_add_rows_and_the_size_says_so():
    assert layer_of("rate cost").reduced_kkt_size == 6 * (2 + 4 + 2) == layer_of("rate cost").reduction.G.shape[-1]
    assert layer_of("slack").reduced_kkt_size == 36


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"regularizer": "ridge"}, "`regularizer` must be one of"),
        ({"regularizer": "l1"}, "1-norm of g is not invariant under rotations"),
        ({"regularizer": "1-norm"}, "slack_set=SoftBox"),
        ({"regularizer": "gamma"}, "needs `beta_2`"),
        ({"regularizer": "spc", "beta_2": 1.0}, "no other regularizer has it"),
        ({"regularizer": "gamma", "beta_2": -1.0}, "`beta_2` must not be negative"),
        ({"slack_set": 1.0}, "`slack_set` must be a ConvexSet"),
        ({"terminal_steps": 7}, "`terminal_steps` must be an integer from 0 to the horizon, 6"),
        ({"terminal_steps": 1.0}, "`terminal_steps` must be an integer"),
        ({"lambda_u": -1.0}, "`lambda_u` must not be negative"),
        ({"R_du": -torch.eye(2)}, "`R_du` must be positive semidefinite"),
        ({"lambda_u": 1.0, "R_du": 1.0}, "which `lambda_u` leaves open"),
        ({"du_set": 1.0}, "`du_set` must be a ConvexSet"),
    ],
)
def test_bad_terms_are_named(options, says):
    with pytest.raises(ValueError, match=says):
        dpc.DPCLayer(small_data(), **{**SMALL, **options})


def test_forms_that_do_not_know_a_term_say_so():
    u_ini, y_ini = inputs(1)
    with pytest.raises(ValueError, match="no rows for changes"):
        dpc.DPCLayer(small_data(), **SMALL, du_set=dpc.Box(-1.0, 1.0)).compact_form(u_ini[0], y_ini[0])
    with pytest.raises(ValueError, match="no rows for Yp g"):
        dpc.DPCLayer(small_data(), **SMALL, slack_set=dpc.Box(-1.0, 1.0)).compact_form(u_ini[0], y_ini[0])
    with pytest.raises(ValueError, match='backward="full" is the system of the paper'):
        dpc.DPCLayer(small_data(), **SMALL, lambda_u=1.0, backward="full")(u_ini[0], y_ini[0])
