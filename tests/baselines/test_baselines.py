"""The peers against the layer on problems where they must agree, and the sizes of the paper's Table I."""

import re
import sys
from pathlib import Path

import pytest
import torch

import baselines
import torch_dpc as dpc
from baselines import PEERS, CvxpyLayersDPC, ForwardOnlyDPC, FullKKT, QPLayerDPC, QpthDPC
from helpers import HOLDING, Y_REF, paper_layer, randn, relative, small_layer, windows

# diffcp copies tensors into NumPy arrays in a way that NumPy 2 warns of.
pytestmark = pytest.mark.filterwarnings("ignore:__array__ implementation:DeprecationWarning")

ROOT = Path(__file__).resolve().parents[2]
T_INI, HORIZON = 3, 6

# What each peer reaches at the settings of PEERS on `gentle_layer`, solution and gradient, as the largest difference
# from the layer relative to the largest entry, and about ten times that for other machines. The layer itself is right
# to 1e-12 there. The wide ones are the peers' own: stopping tolerances of 1e-8 on a cost, or lsqr's on a gradient.
EXACT = (1e-9, 1e-9)
REACHED = {
    "full KKT, rows scaled (paper)": EXACT,
    "full KKT, as printed (paper)": EXACT,
    "cvxpylayers DIFFCP Clarabel lsqr (paper)": (1e-3, 3e-2),
    "cvxpylayers DIFFCP Clarabel lsmr (paper)": (1e-3, 3e-4),
    "cvxpylayers DIFFCP Clarabel dense (paper)": (1e-3, 3e-4),
    "cvxpylayers DIFFCP ECOS lsqr (paper)": (2e-3, 3e-2),
    "cvxpylayers DIFFCP ECOS lsmr (paper)": (2e-3, 2e-3),
    "cvxpylayers DIFFCP ECOS dense (paper)": (2e-3, 2e-3),
    "cvxpylayers DIFFCP SCS lsqr (paper)": (3e-3, 3e-2),
    "cvxpylayers DIFFCP SCS lsmr (paper)": (3e-3, 1e-2),
    "cvxpylayers DIFFCP SCS dense (paper)": (3e-3, 3e-2),
    "cvxpylayers MOREAU (paper)": (1e-5, 1e-5),
    "QPLayer (paper)": (1e-8, 1e-4),
    "QPLayer, tight backward (paper)": (1e-8, 1e-8),
    "daqp (paper)": (1e-7, None),
    "clarabel (paper)": (1e-4, None),
    "ecos (paper)": (1e-3, None),
    "osqp (paper)": (1e-8, None),
    "piqp (paper)": (1e-5, None),
    "cvxpylayers DIFFCP Clarabel lsqr (reduced)": (1e-4, 3e-5),
    "cvxpylayers DIFFCP Clarabel lsmr (reduced)": (1e-4, 3e-5),
    "cvxpylayers DIFFCP Clarabel dense (reduced)": (1e-4, 3e-5),
    "cvxpylayers DIFFCP ECOS lsqr (reduced)": (3e-5, 1e-5),
    "cvxpylayers DIFFCP ECOS lsmr (reduced)": (3e-5, 1e-5),
    "cvxpylayers DIFFCP ECOS dense (reduced)": (3e-5, 3e-5),  # as Clarabel dense: the coordinates are pivoted
    "cvxpylayers DIFFCP SCS lsqr (reduced)": (3e-5, 3e-5),
    "cvxpylayers DIFFCP SCS lsmr (reduced)": (3e-5, 3e-5),
    "cvxpylayers DIFFCP SCS dense (reduced)": (3e-5, 1e-3),
    "cvxpylayers MOREAU (reduced)": EXACT,
    "qpth (reduced)": (1e-9, 1e-5),  # its backward keeps slacks and multipliers above 1e-8
    "QPLayer (reduced)": (1e-8, 1e-5),
    "QPLayer, tight backward (reduced)": (1e-8, 1e-8),
    "daqp (reduced)": (1e-9, None),
    "clarabel (reduced)": (1e-6, None),
    "ecos (reduced)": (1e-5, None),
    "osqp (reduced)": (1e-9, None),
    "piqp (reduced)": (1e-5, None),
}
REFUSES = {"qpth (paper)": "Q is not SPD"}  # the cost on g has a kernel
PEER_PACKAGES = {"cvxpylayers": "cvxpylayers", "qpth": "qpth", "QPLayer": "proxsuite"}

TABLE_1 = {
    ("masses", 25): (1799, 812, 150),
    ("masses", 50): (2549, 1112, 300),
    ("masses", 100): (4049, 1712, 600),
    ("quadrotor", 25): (2192, 968, 225),
    ("quadrotor", 50): (3317, 1418, 450),
    ("quadrotor", 100): (5567, 2318, 900),
}


@pytest.fixture(autouse=True)
def one_thread():
    """Small matrices: more threads only wait for one another."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def gentle_layer():
    """Noisy data and a moderate lambda_s: every matrix of the problem is well conditioned."""
    return small_layer(5e-2, lambda_s=10.0)


def require(name):
    """Skip where the peer is not installed."""
    first = re.split(r"[ ,]", name)[0]
    pytest.importorskip(PEER_PACKAGES.get(first, "torch" if first == "full" else first))
    for package in ("ecos", "moreau", "clarabel", "scs"):
        if package in name.lower():
            pytest.importorskip(package)


def inputs(batch=3):
    u_ini, y_ini = windows(batch, T_INI, noise=5e-2)
    return [u_ini, y_ini, Y_REF.clone(), 0.3 * HOLDING]


def plan_and_gradient(solve, values):
    """Return u and y side by side, and the gradient of a fixed combination of them."""
    u_ini, y_ini, y_ref, u_ref = (value.clone().requires_grad_() for value in values)
    sol = solve(u_ini, y_ini, y_ref=y_ref, u_ref=u_ref)
    out = torch.cat([sol.u, sol.y], dim=-1)
    if not out.requires_grad:
        return sol, out, None
    gradient = torch.autograd.grad((out * randn(*out.shape, seed=5)).sum(), [u_ini, y_ini, y_ref, u_ref])
    return sol, out.detach(), gradient


# --- agreement --------------------------------------------------------------------------------------------------------


def test_every_peer_is_compared():
    assert set(PEERS) == set(REACHED) | set(REFUSES)
    assert all(peer.name == name and peer.formulation in name for name, peer in PEERS.items())


@pytest.mark.parametrize("name", REACHED)
def test_peer_agrees_with_layer(name, gentle_layer):
    """The references are shared by the batch: their gradient is the sum over it."""
    require(name)
    peer = PEERS[name].make(gentle_layer)
    expected, plan, gradient = plan_and_gradient(gentle_layer, inputs())
    sol, found, found_gradient = plan_and_gradient(peer, inputs())
    near, near_gradient = REACHED[name]
    assert expected.info.n_active.max() > 0
    assert sol.u.shape == expected.u.shape and sol.info.status.tolist() == [dpc.Status.SOLVED] * 3
    assert relative(found, plan) < near
    assert relative(sol.g, expected.g) < near
    assert relative(sol.lam, expected.lam) < 10 * near
    assert float(sol.info.residual.max()) < near
    if near_gradient is None:
        assert found_gradient is None and PEERS[name].kind == "forward-only" and peer.kkt_size == 0
        return
    assert PEERS[name].kind == "differentiable" and peer.kkt_size > 0
    for mine, right in zip(found_gradient, gradient, strict=True):
        assert relative(mine, right) < near_gradient


@pytest.mark.parametrize(("name", "words"), REFUSES.items())
def test_a_refusal_is_told_in_the_peers_own_words(name, words, gentle_layer):
    require(name)
    with pytest.raises(dpc.SolveError, match=words) as caught:
        PEERS[name].make(gentle_layer)(*inputs()[:2])
    assert caught.value.indices == [(0,), (1,), (2,)]


@pytest.mark.parametrize(
    "name", ["cvxpylayers MOREAU (reduced)", "qpth (reduced)", "QPLayer, tight backward (reduced)"]
)
def test_g_carries_the_gradient(name, gentle_layer):
    require(name)
    u_ini, y_ini, y_ref, u_ref = inputs()
    gradients = []
    for solve in (PEERS[name].make(gentle_layer), gentle_layer):
        y = y_ini.clone().requires_grad_()
        g = solve(u_ini, y, y_ref=y_ref, u_ref=u_ref).g
        gradients.append(torch.autograd.grad((g * randn(*g.shape, seed=6)).sum(), y)[0])
    assert relative(*gradients) < 1e-5


def test_qpth_averages_where_the_adapter_sums(gentle_layer):
    """qpth itself: z = -p for each of three samples that share p, and the gradient of sum z comes out as -1, not -3."""
    QPFunction = pytest.importorskip("qpth.qp").QPFunction
    p = torch.zeros(2, dtype=torch.float64, requires_grad=True)
    eye, none = torch.eye(2, dtype=torch.float64), torch.empty(0, dtype=torch.float64)
    far = torch.full((3, 2), 10.0, dtype=torch.float64)
    z = QPFunction()(eye, p, eye, far, none, none)
    (averaged,) = torch.autograd.grad(z.sum(), p)
    assert relative(averaged, torch.full((2,), -1.0, dtype=torch.float64)) < 1e-6

    u_ini, y_ini, y_ref, _ = inputs()
    shared = y_ref.clone().requires_grad_()
    peer = QpthDPC(gentle_layer)
    (together,) = torch.autograd.grad(peer(u_ini, y_ini, y_ref=shared).u.sum(), shared)
    alone = [
        torch.autograd.grad(peer(u, y, y_ref=shared).u.sum(), shared)[0] for u, y in zip(u_ini, y_ini, strict=True)
    ]
    assert relative(together, sum(alone)) < 1e-6


def test_qpth_with_more_threads():
    """PyTorch issue 142815: on several threads batched LU of 150 rows and more goes wrong; here there are 300."""
    pytest.importorskip("qpth")
    layer = paper_layer()
    u_ini, y_ini = windows(2)
    torch.set_num_threads(2)
    sol, expected = (solve(u_ini, y_ini, y_ref=Y_REF, u_ref=HOLDING) for solve in (QpthDPC(layer), layer))
    assert torch.get_num_threads() == 2
    assert relative(sol.u, expected.u) < 1e-2  # 9e-4: on this problem its interior point stops early


def test_row_scaling_is_what_the_full_system_needs():
    """The paper's masses: the condition of J is 1e14, and the least squares of the printed J throws the answer away."""
    layer = paper_layer()
    u_ini, y_ini = windows(1)
    errors = []
    for solve in (layer, FullKKT(layer), FullKKT(layer, scaled=False)):
        y = y_ini[0].clone().requires_grad_()
        sol = solve(u_ini[0], y, y_ref=Y_REF, u_ref=HOLDING)
        errors.append(torch.autograd.grad(sol.u.sum(), y)[0])
    exact, scaled, printed = errors
    assert relative(scaled, exact) < 1e-6
    assert relative(printed, exact) > 1e-2


# --- the call ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["full KKT, rows scaled (paper)", "cvxpylayers MOREAU (reduced)", "qpth (reduced)"])
def test_shapes_and_dtypes_are_those_of_the_layer(name, gentle_layer):
    require(name)
    peer = PEERS[name].make(gentle_layer)
    u_ini, y_ini, y_ref, _ = inputs()
    for window in ((u_ini[0], y_ini[0]), (u_ini[:1], y_ini[:1]), (u_ini[:0], y_ini[:0])):
        sol, expected = (solve(*window, y_ref=y_ref) for solve in (peer, gentle_layer))
        for field in ("u", "y", "g", "lam"):
            assert getattr(sol, field).shape == getattr(expected, field).shape
        assert sol.info.residual.shape == sol.info.status.shape == expected.info.status.shape
    single = peer(u_ini.float(), y_ini.float())
    assert single.u.dtype == single.g.dtype == torch.float32
    with torch.no_grad():
        assert not peer(u_ini, y_ini.clone().requires_grad_()).u.requires_grad
    with pytest.raises(ValueError, match="`y_ini` must have shape"):
        peer(u_ini, y_ini[..., :3])
    with pytest.raises(ValueError, match="finite"):
        peer(u_ini, y_ini * torch.nan)


def test_one_sided_and_missing_bounds(gentle_layer):
    upper = torch.tensor([0.2, torch.inf], dtype=torch.float64)
    layer = small_layer(5e-2, lambda_s=10.0, u_set=dpc.Box(-torch.inf, upper))
    expected, plan, gradient = plan_and_gradient(layer, inputs())
    assert expected.info.n_active.max() > 0
    for name in (
        "full KKT, rows scaled (paper)",
        "cvxpylayers MOREAU (reduced)",
        "cvxpylayers DIFFCP Clarabel dense (reduced)",
        "qpth (reduced)",
        "QPLayer, tight backward (reduced)",
        *(f"{solver} (reduced)" for solver in ("daqp", "clarabel", "ecos", "osqp", "piqp")),
    ):
        require(name)
        sol, found, found_gradient = plan_and_gradient(PEERS[name].make(layer), inputs())
        assert relative(found, plan) < 1e-4, name
        assert relative(sol.lam, expected.lam) < 1e-3, name
        if found_gradient is not None:
            assert relative(found_gradient[1], gradient[1]) < 1e-4, name
    with pytest.raises(ValueError, match="no finite bound"):
        FullKKT(small_layer(u_set=None))


def test_an_infeasible_problem_is_told():
    """Both positions within 0.1 m for 0.6 s, at 1 m/s and more: data without noise know that this cannot be."""
    low, high = torch.tensor([3.0, 3.0, 1.0, 1.0]), torch.tensor([3.1, 3.1, 2.0, 2.0])
    layer = small_layer(0.0, lambda_s=10.0, y_set=dpc.Box(low.double(), high.double()))
    u_ini, y_ini = windows(2, T_INI)
    with pytest.raises(dpc.InfeasibleError):
        layer(u_ini, y_ini)
    for solver in ("daqp", "clarabel"):
        pytest.importorskip(solver)
        with pytest.raises(dpc.InfeasibleError, match=solver):
            ForwardOnlyDPC(layer, solver)(u_ini, y_ini)
    pytest.importorskip("proxsuite")
    with pytest.raises(dpc.SolveError, match="PROXQP"):
        QPLayerDPC(layer)(u_ini, y_ini)


def test_an_unconverged_answer_is_marked(gentle_layer):
    pytest.importorskip("proxsuite")
    u_ini, y_ini, _, _ = inputs()
    hasty = {"maxIter": 0}
    with pytest.raises(dpc.SolveError, match="PROXQP_MAX_ITER_REACHED"):
        QPLayerDPC(gentle_layer, solver_args=hasty)(u_ini, y_ini)
    sol = QPLayerDPC(gentle_layer, solver_args=hasty, accept_unconverged=True)(u_ini, y_ini)
    assert "PROXQP_MAX_ITER_REACHED" in sol.info.message


def test_qplayer_keeps_the_default_dtype(gentle_layer):
    pytest.importorskip("proxsuite")
    assert torch.get_default_dtype() == torch.float32
    _, _, gradient = plan_and_gradient(QPLayerDPC(gentle_layer), inputs())
    assert torch.get_default_dtype() == torch.float32
    assert relative(gradient[1].float().double(), gradient[1]) > 1e-12  # digits beyond single precision


@pytest.mark.parametrize(
    ("make", "module"),
    [
        (CvxpyLayersDPC, "cvxpylayers.torch"),
        (QpthDPC, "qpth.qp"),
        (QPLayerDPC, "proxsuite.torch.qplayer"),
        (ForwardOnlyDPC, "daqp"),
    ],
)
def test_a_missing_package_says_how_to_get_it(make, module, monkeypatch, gentle_layer):
    if make is CvxpyLayersDPC:
        pytest.importorskip("cvxpy")
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(ImportError, match=r"pip install 'torch_dpc\[baselines\]'") as caught:
        make(gentle_layer)
    assert ("--no-deps" in str(caught.value)) == (make is QpthDPC)


def test_bad_choices_are_named(gentle_layer):
    with pytest.raises(ValueError, match="`formulation`"):
        baselines.QPLayerDPC(gentle_layer, formulation="dual")
    with pytest.raises(ValueError, match="`solver`"):
        CvxpyLayersDPC(gentle_layer, "GUROBI")
    with pytest.raises(ValueError, match="`solver`"):
        ForwardOnlyDPC(gentle_layer, "gurobi")


def test_the_package_does_not_import_its_baselines():
    for source in (ROOT / "torch_dpc").rglob("*.py"):
        assert not re.search(r"^\s*(from|import) baselines", source.read_text(), re.MULTILINE), source


# --- Table I ----------------------------------------------------------------------------------------------------------


def table1_script():
    pytest.importorskip("tqdm", reason="the scripts show their progress with tqdm")
    from scripts import table1_sizes

    return table1_sizes


def test_1799_term_by_term():
    """CVXPYlayers on the masses at horizon 25: n variables, m cone rows, and one more for the embedding."""
    pytest.importorskip("cvxpylayers")
    u, y, g = 25 * 2, 25 * 4, 500
    u_ini, y_ini = 6 * 2, 6 * 4
    # 1. Variables: u, y, g, and for each of the four quadratic terms a bound t with t >= |.|^2 to be minimised.
    terms = {"|u - u_ref|_R^2": u, "|y - y_ref|_Q^2": y, "|M g|^2": g, "|Yp g - y_ini|^2": y_ini}
    n = u + y + g + len(terms)
    # 2. Zero cone: Up g = u_ini, u = Uf g, y = Yf g.
    equalities = u_ini + u + y
    # 3. Non-negative cone: a lower and an upper bound on each of u and y.
    bounds = 2 * (u + y)
    # 4. Second-order cones: t >= |r|^2 is |(2 r, 1 - t)| <= 1 + t, two rows more than the term has entries.
    cones = [size + 2 for size in terms.values()]
    m = equalities + bounds + sum(cones)
    assert (n, equalities, bounds, sum(cones), n + m + 1) == (654, 162, 300, 682, 1799)

    peer = CvxpyLayersDPC(table1_script().masses_layer(25))
    context = peer.layer_of_peer.ctx.solver_ctx
    assert context.A_shape == (m, n + 1)  # the last column is the right-hand side
    assert (context.dims.zero, context.dims.nonneg, sorted(context.dims.soc)) == (equalities, bounds, sorted(cones))
    assert peer.kkt_size == 1799


@pytest.mark.slow
@pytest.mark.parametrize(("plant", "horizon"), TABLE_1)
def test_table_1(plant, horizon):
    pytest.importorskip("cvxpylayers")
    assert tuple(table1_script().sizes(plant, horizon).values()) == TABLE_1[plant, horizon]


def test_own_sizes(gentle_layer):
    """What the layer says of itself is the order of the matrices that are built."""
    assert FullKKT(gentle_layer).kkt_size == gentle_layer.full_kkt_size
    assert gentle_layer.reduction.G.shape[-1] == gentle_layer.reduced_kkt_size == HORIZON * 6
