"""The layer inside torch models: parametrisations, compilation, autocast, optimisers, Proposition 1."""

import pytest
import torch
from torch import nn
from torch.nn.utils import parametrize

import torch_dpc as dpc
from helpers import SMALL, Y_REF, randn, relative, small_data, small_layer, windows
from torch_dpc.problem.projected_kkt import jacobian

EXACT = 1e-10


def inputs(n=3):
    u_ini, y_ini = windows(n, 3, seed=1, scale=0.5)
    return 0.3 * u_ini, y_ini + 0.05 * randn(n, 3, 4, seed=2)


class Positive(nn.Module):
    """A positive weight by its logarithm."""

    def forward(self, log):
        return log.exp()

    def right_inverse(self, weight):
        return weight.log()


class Semidefinite(nn.Module):
    """A positive semidefinite weight by a factor: Q = F F'."""

    def forward(self, factor):
        return factor @ factor.mT

    def right_inverse(self, weight):
        values, vectors = torch.linalg.eigh(weight)
        return vectors * values.clamp_min(0.0).sqrt()


def parametrized_layer():
    layer = small_layer(
        Q=nn.Parameter(10 * torch.eye(4, dtype=torch.float64)),
        lambda_g=nn.Parameter(torch.tensor(1.0, dtype=torch.float64)),
        u_set=dpc.Ball(nn.Parameter(torch.tensor(0.6, dtype=torch.float64))),
    )
    parametrize.register_parametrization(layer, "Q", Semidefinite())
    parametrize.register_parametrization(layer, "lambda_g", Positive())
    parametrize.register_parametrization(layer.u_set, "radius", Positive())
    return layer


def test_parametrized_weights_stay_admissible_and_learn():
    layer, (u_ini, y_ini) = parametrized_layer(), inputs()
    plain = small_layer(u_set=dpc.Ball(0.6))
    assert relative(layer(u_ini, y_ini, y_ref=Y_REF).u, plain(u_ini, y_ini, y_ref=Y_REF).u) < EXACT
    target = small_layer(Q=3.0, lambda_g=0.1, u_set=dpc.Ball(0.4))(u_ini, y_ini, y_ref=Y_REF).u
    optimiser = torch.optim.Adam(layer.parameters(), lr=0.05)
    losses = []
    for _ in range(60):
        optimiser.zero_grad()
        loss = (layer(u_ini, y_ini, y_ref=Y_REF).u - target).square().sum()
        loss.backward()
        optimiser.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < 0.1 * losses[0]
    assert float(torch.linalg.eigvalsh(layer.Q.detach()).min()) >= 0 and float(layer.lambda_g.detach()) > 0


class Controlled(nn.Module):
    """A network that chooses the reference, and the plan that follows."""

    def __init__(self, layer):
        super().__init__()
        self.network = nn.Sequential(nn.Linear(12, 16), nn.Tanh(), nn.Linear(16, 4)).double()
        self.layer = layer

    def forward(self, u_ini, y_ini):
        y_ref = self.network(y_ini.flatten(-2))[..., None, :]
        return self.layer(u_ini, y_ini, y_ref=y_ref).u.tanh()


@pytest.mark.parametrize("batch", [1, 3, 40])
@pytest.mark.parametrize("sets", [{}, {"u_set": dpc.Ball(0.5)}], ids=["box", "ball"])
@pytest.mark.filterwarnings("ignore")
def test_a_compiled_model_gives_the_same_values_and_gradients(sets, batch):
    torch.manual_seed(0)
    model, (u_ini, y_ini) = Controlled(small_layer(**sets)), inputs(batch)
    expected = model(u_ini, y_ini)
    expected.sum().backward()
    gradients = [p.grad.clone() for p in model.parameters()]
    model.zero_grad()
    compiled = torch.compile(model, backend="aot_eager")  # the default backend wants a C++ compiler
    found = compiled(u_ini, y_ini)
    found.sum().backward()
    assert relative(found, expected) < EXACT
    for p, gradient in zip(model.parameters(), gradients, strict=True):
        assert relative(p.grad, gradient) < EXACT


@pytest.mark.parametrize("sets", [{}, {"u_set": dpc.Ball(0.5)}], ids=["box", "ball"])
def test_autocast_does_not_reach_inside(sets):
    layer, (u_ini, y_ini) = small_layer(**sets), inputs()
    expected = layer(u_ini, y_ini, y_ref=Y_REF)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        found = layer(u_ini, y_ini, y_ref=Y_REF)
    assert found.u.dtype == torch.float64 and relative(found.u, expected.u) < EXACT


def test_functional_call_replaces_the_parameters_of_a_set():
    layer = small_layer(u_set=dpc.Ball(nn.Parameter(torch.tensor(0.6, dtype=torch.float64))))
    u_ini, y_ini = inputs()

    def size(radius):
        sol = torch.func.functional_call(layer, {"u_set.radius": radius}, (u_ini, y_ini), {"y_ref": Y_REF})
        return sol.u.norm(dim=-1).max()

    small = torch.tensor(0.2, dtype=torch.float64)
    assert abs(float(size(small)) - 0.2) < EXACT
    assert abs(float(torch.func.grad(size)(small)) - 1.0) < 1e-6


def duplicated_data():
    """Two outputs that are one and the same: the rows of their bounds depend on each other."""
    data = small_data(0.0)
    u, y = dpc.collect(dpc.systems.OscillatingMasses(), 150, generator=torch.Generator().manual_seed(0))
    return dpc.HankelData.from_trajectories(u, y[:, [0, 0]], t_ini=data.t_ini, horizon=data.horizon)


def test_info_says_whether_the_papers_system_is_nonsingular():
    u_ini, y_ini = inputs()
    twice = dpc.DPCLayer(duplicated_data(), Q=1.0, R=1.0, lambda_g=1.0, lambda_s=1e3, y_set=dpc.Box(-0.2, 0.2))
    cases = {
        "noisy": (small_layer(), y_ini, True),
        "no lambda_g": (small_layer(lambda_g=0.0), y_ini, False),
        "one output twice: one of the two is held": (twice, y_ini[..., [0, 0]], True),
    }
    for name, (layer, y, expected) in cases.items():
        sol = layer(u_ini, y, on_failure="nan")
        P, _, H, _ = layer.compact_form(u_ini[0], y[0])
        for i in range(3):
            free = torch.ones(len(P), dtype=torch.float64)
            free[: sol.lam.shape[-1]] = (sol.lam[i] == 0).double()
            singular = torch.linalg.svdvals(jacobian(P, H, free))
            nonsingular = bool(singular[-1] > 1e-13 * singular[0])
            assert bool(sol.info.nonsingular[i]) == nonsingular, (name, i, singular[-1] / singular[0])
        assert bool(sol.info.nonsingular.all()) == expected, name
    assert bool(sol.sample(0).info.nonsingular) == bool(sol.info.nonsingular[0])
    curved = dpc.DPCLayer(small_data(), **SMALL, u_set=dpc.Ball(0.3))(u_ini, y_ini, y_ref=Y_REF)
    assert curved.info.nonsingular.all() and curved.info.n_active.any()
