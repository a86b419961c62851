"""The compiled kernels against the operations of torch and an oracle; and the package without them."""

import os
import subprocess
import sys
import threading

import numpy as np
import pytest
import torch

import torch_dpc as dpc
from helpers import HOLDING, Y_REF, nearest_point, paper_layer, randn, relative, small_layer, windows
from torch_dpc.solve import active_set, kernels, newton

built = pytest.mark.skipif(kernels._kernels is None, reason="the extension is not built here (no compiler)")
SAME = 1e-10
ORACLE = 1e-9
#: Around the width of a vector, of a block of columns, and of two.
SIZES = [1, 2, 7, 8, 9, 15, 16, 17, 31, 32, 33, 63, 70, 130]


def problem(n, count=12, n_x=None, seed=0, shared=True, width=0.4):
    """G, Ct, v0, lower and upper of random problems that have a solution, some rows tight, some without a bound."""
    lead = () if shared else (count,)
    Ct = randn(*lead, n, n_x or n + 5, seed=seed) / (n_x or n + 5) ** 0.5
    centre = randn(*lead, n, seed=seed + 1)  # which x = 0 reaches
    v0 = centre + (Ct @ randn(count, Ct.shape[-1], 1, seed=seed + 2))[..., 0]
    lower, upper = (centre + sign * width * randn(*lead, n, seed=seed + 3 + sign).abs() for sign in (-1, 1))
    kind = torch.arange(n) % 7
    lower, upper = torch.where(kind == 1, -torch.inf, lower), torch.where(kind == 2, torch.inf, upper)
    if n_x is None:
        upper = torch.where(kind == 3, lower, upper)
    return Ct @ Ct.mT, Ct, v0, lower, upper


def conditions(G, v0, lower, upper, lam):
    """Return the largest violation of  v = v0 - G lam = Proj(v + lam)  relative to the size of v."""
    v = v0 - (lam[..., None, :] @ G)[..., 0, :] if G.ndim == 3 else v0 - lam @ G
    return float((v - torch.clamp(v + lam, lower, upper)).abs().max() / v0.abs().max())


def without_kernels(monkeypatch):
    monkeypatch.setattr(kernels, "_kernels", None)


# --- the solve for boxes ---------------------------------------------------------------------------------------------


@built
@pytest.mark.parametrize("shared", [True, False])
@pytest.mark.parametrize("n", SIZES)
def test_random_boxes_meet_their_conditions(n, shared):
    G, Ct, v0, lower, upper = problem(n, seed=n, shared=shared)
    found = newton.solve_newton(G, Ct, v0, lower, upper)
    assert found.converged.all() and (found.iterations >= 1).all()
    assert conditions(G, v0, lower, upper, found.lam) < SAME
    for i in range(3):
        rows, lo, up = (Ct, lower, upper) if shared else (Ct[i], lower[i], upper[i])
        x = nearest_point(rows, lo - v0[i], up - v0[i])
        assert relative(-rows.mT @ found.lam[i], x) < ORACLE


@built
@pytest.mark.parametrize("n", [9, 33, 70])
def test_the_kernel_is_the_iteration_of_torch(n):
    G, Ct, v0, lower, upper = problem(n, seed=n, width=2.0)
    found, together = newton.solve_newton(G, Ct, v0, lower, upper), newton._batched(G, Ct, v0, lower, upper)
    assert together.converged.sum() >= 6
    for i in together.converged.nonzero()[:, 0]:
        assert relative(found.lam[i], together.lam[i]) < SAME


@built
@pytest.mark.parametrize("pivots", [0, 1, 10])
@pytest.mark.parametrize("seed", range(6))
def test_more_rows_than_unknowns_are_solved_by_either_method(seed, pivots, monkeypatch):
    """Boxes that bite all at once, of which no more than n_x rows are independent: pivoting alone would cycle."""
    monkeypatch.setattr(kernels, "SETTINGS", kernels.KernelSettings(primal_dual_steps=pivots))
    G, Ct, v0, lower, upper = problem(40, count=50, n_x=6, seed=seed)
    lam, steps, converged = kernels.solve_boxes(*(x.numpy() for x in (G, v0, lower, upper)))
    assert converged.all() and steps.max() < 8 * 40
    assert conditions(G, v0, lower, upper, torch.from_numpy(lam)) < SAME
    assert ((lam != 0).sum(1) <= 6).all()
    for i in range(4):
        assert relative(-Ct.mT @ torch.from_numpy(lam[i]), nearest_point(Ct, lower - v0[i], upper - v0[i])) < ORACLE


@built
def test_what_has_no_solution_is_flagged():
    G, Ct, v0, lower, upper = problem(10, count=8, n_x=3)
    lower = lower + 100.0 * (torch.arange(10) == 4)  # the other rows do not let this one go there
    upper = torch.maximum(lower, upper)
    assert not newton.solve_newton(G, Ct, v0, lower, upper).converged.any()
    G, Ct, v0, lower, upper = problem(10, count=3)
    v0[1, 4] = torch.nan
    assert newton.solve_newton(G, Ct, v0, lower, upper).converged.tolist() == [True, False, True]
    G[2, 2] = torch.nan
    assert not newton.solve_newton(G, Ct, v0, lower, upper).converged[1]


@built
def test_a_row_that_nothing_moves():
    G, Ct, v0, lower, upper = problem(10, count=2)
    Ct[5] = 0.0
    G = Ct @ Ct.mT
    lower[5], upper[5] = -1.0, 1.0
    v0[:, 5] = torch.tensor([0.5, 1.5])
    found = newton.solve_newton(G, Ct, v0, lower, upper)
    assert found.converged.tolist() == [True, False] and found.lam[0, 5] == 0


@built
def test_a_sample_does_not_see_the_batch_the_threads_or_the_history():
    G, _, v0, lower, upper = (x.numpy() for x in problem(33, count=300))
    lam, steps, converged = kernels.solve_boxes(G, v0, lower, upper)
    assert converged.all()
    for threads in (2, 3, 16):
        again = kernels.solve_boxes(G, v0, lower, upper, threads)
        assert all(np.array_equal(a, b) for a, b in zip(again, (lam, steps, converged), strict=True))
    for i in (0, 17, 299):
        alone = kernels.solve_boxes(G, v0[i : i + 1], np.tile(lower, (1, 1)), np.tile(upper, (1, 1)))
        assert np.array_equal(alone[0][0], lam[i])
    active, v_bar = torch.from_numpy(lam != 0), randn(300, 33)
    results = []
    for threads in (1, 2):
        torch.set_num_threads(threads)
        results.append(kernels.adjoint(torch.from_numpy(G), active, v_bar, None)[0])
    torch.set_num_threads(1)
    assert torch.equal(*results)


@built
def test_python_threads_at_once():
    problems = [[x.numpy() for x in problem(n, count=200, seed=n)] for n in (9, 33, 40, 70)]
    expected = [kernels.solve_boxes(G, *rest)[0] for G, _, *rest in problems]
    wrong = []

    def work(k):
        for _ in range(20):
            G, _, *rest = problems[k]
            if not np.array_equal(kernels.solve_boxes(G, *rest, 2)[0], expected[k]):
                wrong.append(k)

    threads = [threading.Thread(target=work, args=(k,)) for k in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong


# --- the systems on the active rows ----------------------------------------------------------------------------------


@built
@pytest.mark.parametrize("shared", [True, False])
@pytest.mark.parametrize("n", SIZES)
def test_systems_on_the_active_rows(n, shared, monkeypatch):
    G, Ct, _, _, _ = problem(n, seed=n, shared=shared)
    active, rhs, bar = randn(12, n, seed=1) > 0, randn(12, n, seed=2), randn(12, n, seed=3)
    active[0], active[1] = False, True
    kernel = active_set.solve_active(G, Ct, active, rhs)[0], active_set.adjoint(G, Ct, active, bar, rhs)
    alone = active_set.adjoint(G, Ct, active, bar, None)
    without_kernels(monkeypatch)
    plain = active_set.solve_active(G, Ct, active, rhs)[0], active_set.adjoint(G, Ct, active, bar, rhs)
    for a, b in zip((*kernel, alone), (*plain, active_set.adjoint(G, Ct, active, bar, None)), strict=True):
        assert relative(a, b) < SAME
    for i in range(12):
        A, of_i = active[i], G if shared else G[i]
        if A.any():
            assert relative(kernel[0][i, A], torch.linalg.solve(of_i[A][:, A], rhs[i, A])) < SAME
        assert (kernel[0][i, ~A] == 0).all()


@built
def test_dependent_rows_are_left_to_the_qr(monkeypatch):
    G, Ct, _, _, _ = problem(12, n_x=20)
    Ct[7] = Ct[2] + Ct[3]
    G, active, rhs = Ct @ Ct.mT, torch.ones(3, 12, dtype=torch.bool), randn(3, 12)
    active[1, 7] = False
    found, independent = active_set.solve_active(G, Ct, active, rhs)
    assert independent.tolist() == [False, True, False] and (found[[0, 2], 7] == 0).all()
    bar = active_set.adjoint(G, Ct, active, rhs, None)
    without_kernels(monkeypatch)
    assert relative(found, active_set.solve_active(G, Ct, active, rhs)[0]) < SAME
    assert relative(bar, active_set.adjoint(G, Ct, active, rhs, None)) < SAME


@built
@pytest.mark.parametrize("n", [0, 5])
def test_nothing_to_do(n):
    G, Ct, none = torch.eye(n).double(), torch.eye(n).double(), torch.zeros(0, n).double()
    assert newton.solve_newton(G, Ct, none, none[:0].sum(0), none[:0].sum(0)).lam.shape == (0, n)
    assert active_set.solve_active(G, Ct, none > 0, none)[0].shape == (0, n)
    assert active_set.adjoint(G, Ct, none > 0, none, None).shape == (0, n)
    two = torch.zeros(2, n).double()
    assert torch.equal(active_set.adjoint(G, Ct, two > 0, two + 1, None), two + 1)


# --- what the kernels refuse -----------------------------------------------------------------------------------------


@built
@pytest.mark.parametrize(
    ("place", "wrong", "says"),
    [
        (0, np.eye(4), "`G` does not fit"),
        (0, np.stack([np.eye(3)] * 5), "`G` does not fit"),
        (0, np.eye(3, dtype=np.float32), "`G` must have items of type 'd', got 'f'"),
        (1, np.zeros(3), "`v0` does not fit"),
        (1, np.zeros((3, 2)).T, "contiguous"),
        (2, np.zeros(2), "`lower` does not fit"),
        (2, np.zeros((2, 3)), "`upper` does not fit"),
        (4, np.zeros((1, 3)), "`lam` does not fit"),
        (5, np.zeros(2), "`iterations` must have items of type 'q'"),
        (6, np.zeros(3, dtype=bool), "`converged` does not fit"),
        (6, np.zeros(2, dtype=np.int64), "`converged` must have items of type '?'"),
    ],
)
def test_arrays_that_do_not_fit_are_named(place, wrong, says):
    arguments = [
        np.eye(3),
        np.zeros((2, 3)),
        -np.ones(3),
        np.ones(3),
        np.zeros((2, 3)),
        np.zeros(2, int),
        np.zeros(2, bool),
    ]
    settings = (kernels.SETTINGS.compiled, 1)
    kernels._kernels.solve_boxes(*arguments, *settings)
    arguments[place] = wrong
    with pytest.raises(ValueError, match=says.replace("?", r"\?")):
        kernels._kernels.solve_boxes(*arguments, *settings)


@built
def test_other_bad_arguments():
    with pytest.raises(TypeError, match="expected 9 arguments, got 1"):
        kernels._kernels.solve_boxes(np.eye(3))
    frozen = np.zeros((2, 3))
    frozen.flags.writeable = False
    with pytest.raises(ValueError, match="read-only"):
        kernels._kernels.solve_active(
            np.eye(3), np.ones((2, 3), bool), np.ones((2, 3)), frozen, np.ones(2, bool), kernels.SETTINGS.compiled, 1
        )


# --- the package with and without them -------------------------------------------------------------------------------

LAYERS = {
    "inputs": lambda: small_layer(),
    "inputs and outputs": lambda: small_layer(0.0, u_set=dpc.Box(-0.7, 0.7), y_set=dpc.Box(-0.9, 0.9)),
    "outputs bite": lambda: small_layer(u_set=None, y_set=dpc.Box(-0.25, 0.25)),
    "paper": lambda: paper_layer(),
    "soft outputs": lambda: small_layer(y_set=dpc.SoftBox(-0.25, 0.25, weight=5.0)),
    "balls": lambda: small_layer(u_set=dpc.Ball(0.4), y_set=dpc.Box(-0.9, 0.9)),
    "one ball": lambda: small_layer(u_set=dpc.Ball(1.0, per="trajectory")),
    "cones": lambda: small_layer(u_set=dpc.SecondOrderCone(), y_set=dpc.SoftBox(-0.3, 0.3, weight=3.0)),
    "product and changes": lambda: small_layer(
        u_set=dpc.Product([(dpc.NonNegative(), 0), (dpc.Box(-0.3, 0.3), 1)]), du_set=dpc.Ball(1.4)
    ),
}
#: Of plans and gradients of the two; curved boundaries square the rounding of the multipliers.
ALIKE = 1e-8


@built
@pytest.mark.parametrize("count", [None, 1, 3, 20, 300])
@pytest.mark.parametrize("name", LAYERS)
def test_plans_and_gradients_without_the_kernels_are_the_same(name, count, monkeypatch):
    layer = LAYERS[name]()
    u_ini, y_ini = windows(count or 1, layer.data.t_ini, seed=4, scale=0.7)
    if count is None:
        u_ini, y_ini = u_ini[0], y_ini[0]
    found = []
    for _ in range(2):
        inputs = [x.clone().requires_grad_() for x in (u_ini, y_ini, Y_REF, HOLDING)]
        sol = layer(inputs[0], inputs[1], y_ref=inputs[2], u_ref=0.5 * inputs[3])
        gradients = torch.autograd.grad((sol.u**2).sum() + sol.y.sum() + 1e-3 * sol.lam.sum(), inputs)
        found.append((sol.u, sol.y, sol.info.status, sol.info.n_active, *gradients))
        without_kernels(monkeypatch)
    assert found[0][3].max() > 0 and (found[0][2] == 0).all()
    for a, b in zip(*found, strict=True):
        assert relative(a.double(), b.double()) < ALIKE


@pytest.mark.parametrize("solver", ["auto", "newton", "daqp"])
@pytest.mark.parametrize("batch", [(), (3,)], ids=str)
def test_gradcheck_without_the_kernels(batch, solver, monkeypatch):
    without_kernels(monkeypatch)
    layer = small_layer(u_set=dpc.Box(-0.4, 0.4), y_set=dpc.Box(-0.9, 0.9), solver=solver)
    u_ini, y_ini = windows(3, 3, seed=1, scale=0.5)
    u_ini, y_ini = (w if batch else w[0] for w in (u_ini, y_ini + 0.1 * randn(3, 3, 4, seed=2)))

    def plan(y_ini):
        sol = layer(u_ini, y_ini, y_ref=Y_REF + 0.1 * randn(6, 4, seed=3), u_ref=0.3 * randn(6, 2, seed=4))
        return sol.u, sol.y, sol.lam

    assert torch.autograd.gradcheck(plan, y_ini.requires_grad_(), check_forward_ad=True)


def test_the_environment_switches_them_off():
    program = "from torch_dpc.solve import kernels; import torch; assert not kernels.has_kernels(torch.ones(1))"
    environment = {**os.environ, "TORCH_DPC_NO_KERNELS": "1", "PYTHONPATH": os.pathsep.join(sys.path)}
    subprocess.run([sys.executable, "-c", program], check=True, env=environment)
