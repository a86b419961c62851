"""Sets."""

import torch

import torch_dpc as dpc

from .entry import INF, NAN, NO_NUMBER, Call, each, one

NOT_BOUNDS = (NAN, "a", None, {}, 1j, torch.full((2,), NAN), torch.ones(2, dtype=torch.complex128))
BOX = dpc.Box(-1.0, 1.0)


def calls() -> list[Call]:
    """Return the table."""
    return [
        *each("lower", "Box lower", NOT_BOUNDS, lambda b: dpc.Box(b, 1.0)),
        *each("upper", "Box upper", NOT_BOUNDS, lambda b: dpc.Box(-1.0, b)),
        *one("lower", "Box crossed", lambda: dpc.Box(1.0, -1.0)),
        *one("lower", "Box crossed in one channel", lambda: dpc.Box(torch.tensor([0.0, 2.0]), 1.0)),
        *one("lower", "Box at infinity", lambda: dpc.Box(INF, INF)),
        *one("upper", "Box at minus infinity", lambda: dpc.Box(-INF, -INF)),
        *one("lower", "Box shapes", lambda: dpc.Box(torch.zeros(2), torch.ones(3))),
        *each("per", "Box per", ("day", None, 3), lambda p: dpc.Box(-1.0, 1.0, per=p)),
        *each("radius", "Ball radius", (-1.0, NAN, INF, *NO_NUMBER, torch.tensor([1.0, -1.0])), dpc.Ball),
        *each("center", "Ball center", (NAN, INF, "a", {}, 1j), lambda c: dpc.Ball(1.0, c)),
        *each("per", "Ball per", ("day", None, 3), lambda p: dpc.Ball(1.0, per=p)),
        *each("per", "cone per", ("day", None, 3), lambda p: dpc.SecondOrderCone(per=p)),
        *each(
            "weight",
            "SoftBox weight",
            (-1.0, NAN, INF, *NO_NUMBER, torch.tensor([1.0, -1.0]), torch.tensor([1.0, INF])),
            lambda w: dpc.SoftBox(-1.0, 1.0, w),
        ),
        *each("lower", "SoftBox lower", NOT_BOUNDS[:5], lambda b: dpc.SoftBox(b, 1.0, 1.0)),
        *one("lower", "SoftBox crossed", lambda: dpc.SoftBox(1.0, -1.0, 1.0)),
        *each(
            "factors",
            "Product",
            (
                [],
                None,
                3,
                "a",
                BOX,
                [BOX],
                [(BOX,)],
                [(BOX, [0], [1])],
                [(3, [0])],
                [("a", [0])],
                [(dpc.Box, [0])],
                [(BOX, [])],
                [(BOX, "a")],
                [(BOX, [0.5])],
                [(BOX, [-1])],
                [(BOX, [True])],
                [(BOX, None)],
                [(BOX, [0, 0])],
                [(BOX, [0]), (BOX, [0])],
            ),
            dpc.Product,
        ),
    ]
