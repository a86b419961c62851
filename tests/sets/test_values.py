"""Sets as plain numbers describe the same proximal map."""

import pytest
import torch

import torch_dpc as dpc
from helpers import randn
from torch_dpc.sets.feasible import FeasibleSet
from torch_dpc.sets.values import BALL, CONE, SetValues, values_of

STEPS = 5
CPU = torch.device("cpu")


def random(*shape, seed=0):
    return 0.5 + torch.rand(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


CASES = {
    "boxes": (dpc.Box(-1.0, random(2)), dpc.Box(-random(STEPS, 3), 1.0)),
    "soft": (dpc.Box(-1.0, 1.0), dpc.SoftBox(-0.3, random(3), weight=random(STEPS, 3))),
    "balls": (dpc.Ball(random(STEPS), center=random(2)), dpc.Ball(0.7, per="trajectory")),
    "one center a step": (dpc.Ball(0.5, center=random(STEPS, 2)), dpc.Ball(0.4, 0.3, per="trajectory")),
    "cones": (dpc.SecondOrderCone(), dpc.SecondOrderCone(per="trajectory")),
    "products": (
        dpc.Product([(dpc.NonNegative(), 1), (dpc.Box(-0.2, 0.1), 0)]),
        dpc.Product([(dpc.Ball(random(STEPS)), [2, 0]), (dpc.SoftBox(-0.1, 0.1, weight=0.5), 1)]),
    ),
    "a batch": (dpc.Ball(random(4, STEPS)), dpc.Box(-1.0, random(4, STEPS, 3))),
}


def prox(values: SetValues, x, gamma):
    """The proximal map by the definition of the numbers, sample by sample and row by row."""
    out = x.clone()
    for b in range(len(x)):
        of = {
            name: value[b] if value.ndim == 2 else value
            for name in ("lower", "upper", "center", "radius")
            if (value := getattr(values, name)) is not None
        }
        beyond = x[b] - torch.clamp(x[b], of["lower"], of["upper"])
        price = torch.tensor(torch.inf) if values.price is None else values.price
        price = price[b] if price.ndim == 2 else price
        out[b] = x[b] - torch.clamp(beyond, -gamma * price, gamma * price)
        for k, kind in enumerate(values.kind.tolist()):
            place = slice(int(values.start[k]), int(values.start[k + 1]))
            rows = values.rows[place]
            if kind == BALL:
                away = x[b, rows] - of["center"][place]
                out[b, rows] = of["center"][place] + away * min(1.0, float(of["radius"][k] / away.norm()))
            else:
                assert kind == CONE
                out[b, rows] = dpc.SecondOrderCone().project(x[b, rows])
    return out


@pytest.mark.parametrize("case", CASES)
def test_the_numbers_describe_the_same_proximal_map(case):
    u_set, y_set = CASES[case]
    n_u, n_y = 2, 3
    sets = FeasibleSet.of([("u_set", u_set, STEPS, n_u), ("y_set", y_set, STEPS, n_y)])
    x = randn(4, STEPS * (n_u + n_y), seed=3)
    values = values_of(sets, x.shape[:-1], CPU)
    assert values is not None and (values.price is not None) == (case in ("soft", "products"))
    expected = sets.prox(x[..., sets.order], 0.7)[..., sets.inverse]
    assert torch.equal(expected, x) is False
    assert float((prox(values, x, 0.7) - expected).abs().max()) < 1e-14


def test_a_set_of_ones_own_has_no_numbers():
    class Narrow(dpc.Box):
        def project(self, x):
            return super().project(x) / 2

    sets = FeasibleSet.of([("u_set", Narrow(-1.0, 1.0), STEPS, 2)])
    assert values_of(sets, torch.Size([1]), CPU) is None


def test_a_block_that_is_not_finite_stops_no_batch():
    sets = FeasibleSet.of([("u_set", dpc.Ball(1.0), STEPS, 2)])
    D = torch.full((2, STEPS, 2, 2), torch.nan, dtype=torch.float64)
    D[1] = torch.diag(torch.tensor([0.0, 0.5], dtype=torch.float64))
    values, vectors = sets.spectral([D])
    assert torch.equal(values[0], torch.ones(2 * STEPS)) and vectors[0].isfinite().all()
    assert torch.equal(values[1], torch.tensor([0.0, 0.5]).repeat(STEPS))
