"""The sensitivity bound: no attack and no active set exceeds it, and it is close to the worst of them."""

import pytest
import torch

import torch_dpc as dpc
from helpers import HOLDING, Y_REF, generator, paper_layer, small_layer, windows
from torch_dpc import attacks
from torch_dpc.attacks.certificate import Free, _confirm

TIGHT = 1.10  # the bound over the worst active set found


def norm(x):
    return torch.linalg.vector_norm(x, dim=(-2, -1))


def worst_of_random_active_sets(layer, sets, seed=0):
    """Return the largest |du / dp| over random sets of inputs held at bounds, from the plan's own matrices."""
    data, reduction, source = layer.data, layer.reduction, generator(seed)
    n_u, first = data.horizon * data.n_u, data.t_ini * data.n_u
    A, G = reduction.V[:n_u, first : first + data.t_ini * data.n_y], reduction.G[:n_u, :n_u]
    worst = 0.0
    for _ in range(sets):
        held = torch.rand(n_u, generator=source) < torch.rand(1, generator=source)
        change = A - G[:, held] @ torch.linalg.solve(G[held][:, held], A[held]) if held.any() else A
        worst = max(worst, float(torch.linalg.matrix_norm(change, 2)))
    return worst


@pytest.mark.parametrize("noise", [0.0, 1e-2])
def test_it_is_above_every_active_set_and_close_to_the_worst(noise):
    layer = paper_layer(noise)
    L = attacks.sensitivity_bound(layer)
    worst = worst_of_random_active_sets(layer, 1500)
    assert worst <= L <= TIGHT * worst


@pytest.mark.parametrize("scale", [0.05, 0.3, 1.0])
def test_no_attack_moves_the_plan_further(scale):
    layer, cost = small_layer(), attacks.TargetInput(torch.tensor([0.3, -0.4]))
    L, source = attacks.sensitivity_bound(layer), generator(1)
    u_ini, y_ini = windows(400, 3, seed=3, scale=scale)
    refs = {"y_ref": 0.2 * Y_REF, "u_ref": 0.2 * HOLDING}
    nominal = layer(u_ini, y_ini, **refs).u
    for budget in (attacks.RelativeBall(0.01), attacks.Ball(0.5), attacks.Box(0.3), attacks.SparseBall(1, 1.0)):
        for attack in (
            attacks.RandomAttack(budget),
            attacks.LinearizedAttack(layer, cost, budget),
            attacks.ProjectedGradientAttack(layer, cost, budget, 5),
            attacks.RandomSearchAttack(layer, cost, budget, queries=5),
        ):
            p = attack(u_ini, y_ini, **refs, generator=source)
            assert (norm(layer(u_ini, y_ini + p, **refs).u - nominal) <= L * norm(p) * (1 + 1e-9) + 1e-9).all()


def test_between_any_two_perturbations_too():
    layer = small_layer()
    L = attacks.sensitivity_bound(layer)
    u_ini, y_ini = windows(500, 3, seed=8, scale=0.5)
    p, q = (torch.randn(500, 3, 4, dtype=torch.float64, generator=generator(s)) for s in (1, 2))
    change = layer(u_ini, y_ini + p).u - layer(u_ini, y_ini + q).u
    assert (norm(change) <= L * norm(p - q) * (1 + 1e-9)).all()


def test_without_bounds_it_is_the_norm_of_the_map():
    layer = small_layer(u_set=None)
    u_ini, y_ini = (w[0] for w in windows(1, 3, seed=3))
    J = torch.func.jacrev(lambda y: layer(u_ini, y).u)(y_ini).reshape(12, 12)
    assert float(attacks.sensitivity_bound(layer)) == pytest.approx(float(torch.linalg.matrix_norm(J, 2)), rel=2e-6)


def test_entries_that_a_budget_cannot_touch_do_not_count():
    layer = small_layer()
    whole, one = (attacks.sensitivity_bound(layer, b) for b in (None, attacks.Box([0.1, 0.0, 0.0, 0.0])))
    assert one < whole
    u_ini, y_ini = windows(300, 3, seed=3, scale=0.3)
    p = attacks.Box([0.1, 0.0, 0.0, 0.0]).random(y_ini, generator())
    assert (norm(layer(u_ini, y_ini + p).u - layer(u_ini, y_ini).u) <= one * norm(p) * (1 + 1e-9)).all()


def test_bounds_of_outputs_count_when_asked():
    layer = small_layer(0.0, y_set=dpc.Box(-0.3, 0.3), u_set=dpc.Box(-5.0, 5.0), lambda_s=1e6)
    without, with_them = (attacks.sensitivity_bound(layer, outputs=outputs) for outputs in (False, True))
    assert with_them > without and repr(with_them).endswith("covers_outputs=True)")
    u_ini, y_ini = windows(400, 3, seed=3, scale=0.1)
    p = attacks.Ball(0.05).random(y_ini, generator())
    plans = [layer(u_ini, y, y_ref=0.2 * Y_REF, on_failure="nan") for y in (y_ini, y_ini + p)]
    solved = (plans[0].info.status == 0) & (plans[1].info.status == 0)
    held = solved & ((plans[0].lam[:, 12:] != 0) | (plans[1].lam[:, 12:] != 0)).any(-1)
    moved = norm(plans[1].u - plans[0].u)
    assert held.sum() > 20
    assert (moved <= with_them * norm(p) * (1 + 1e-9))[solved].all()
    assert (moved <= without * norm(p) * (1 + 1e-9))[solved & ~held].all()


def test_a_gamma_that_is_too_small_is_refused():
    A, G = torch.eye(3, dtype=torch.float64), torch.eye(3, dtype=torch.float64)
    _confirm(1.0 + 1e-6, torch.full((3,), 1.0, dtype=torch.float64), A, G, Free(A, G))
    with pytest.raises(dpc.SolveError, match="holds only to"):
        _confirm(0.9, torch.full((3,), 1.0, dtype=torch.float64), A, G, Free(A, G))


def test_other_sets_are_refused():
    with pytest.raises(ValueError, match="must have boxes"):
        attacks.sensitivity_bound(small_layer(u_set=dpc.Ball(0.5)))
