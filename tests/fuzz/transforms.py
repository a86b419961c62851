"""Cases in other units, with channels in another order, with other sets."""

from dataclasses import replace
from typing import Any

import numpy as np

from tests.oracles.extended import Array
from tests.oracles.problem import Sample

from .problems import Case, Spec


def in_units(case: Case, unit_u: Array, unit_y: float) -> Case:
    """Return the case with inputs in units of their own and outputs in one: lambda_s has one unit for all outputs."""
    weights = dict(case.weights)
    per = {"Q": np.full(case.n_y, 1 / unit_y), "R": 1 / unit_u, "R_du": 1 / unit_u}
    for name, scale in per.items():
        if name in weights:
            full = np.tile(scale, len(weights[name]) // len(scale))
            weights[name] = weights[name] * np.outer(full, full)
    weights["lambda_s"] = weights["lambda_s"] / unit_y**2
    sets = {name: _in_units(spec, np.full(case.n_y, unit_y) if name == "y_set" else unit_u)
            for name, spec in case.sets.items()}  # fmt: skip
    samples = [Sample(s.u_ini * unit_u, s.y_ini * unit_y, s.u_ref * unit_u, s.y_ref * unit_y) for s in case.samples]
    recordings = [(u * unit_u, y * unit_y) for u, y in case.recordings]
    return replace(case, recordings=recordings, weights=weights, sets=sets, samples=samples)


def _in_units(spec: Spec, unit: Array) -> Spec:
    kind = spec[0]
    if kind == "product":
        return (kind, [(_in_units(part, unit[channels]), channels) for part, channels in spec[1]])
    if kind in ("box", "soft"):
        return (kind, spec[1] * unit, spec[2] * unit, *(price / unit for price in spec[3:]))
    if kind == "ball":
        return (kind, spec[1] * unit[0], spec[2] * unit, spec[3])
    return spec


def mixes_channels(spec: Spec | None) -> bool:
    """Return whether a set holds several channels together, so that they share a unit."""
    if spec is None:
        return False
    return spec[0] in ("ball", "cone") or spec[0] == "product" and any(mixes_channels(part) for part, _ in spec[1])


def permuted(case: Case, order_u: Array, order_y: Array) -> Case:
    """Return the case with channel order[i] of the old one as its channel i."""
    order = {"Q": order_y, "R": order_u, "R_du": order_u}
    weights: dict[str, Any] = dict(case.weights)
    for name, by in order.items():
        if name in weights:
            steps = len(weights[name]) // len(by)
            full = (np.arange(steps)[:, None] * len(by) + by).ravel()
            weights[name] = weights[name][np.ix_(full, full)]
    sets = {name: _permuted(spec, order_y if name == "y_set" else order_u) for name, spec in case.sets.items()}
    samples = [Sample(s.u_ini[:, order_u], s.y_ini[:, order_y], s.u_ref[:, order_u], s.y_ref[:, order_y])
               for s in case.samples]  # fmt: skip
    recordings = [(u[:, order_u], y[:, order_y]) for u, y in case.recordings]
    return replace(case, recordings=recordings, weights=weights, sets=sets, samples=samples)


def _permuted(spec: Spec, order: Array) -> Spec:
    kind = spec[0]
    if kind == "product":
        place = np.argsort(order)
        return (kind, [(part, [int(place[c]) for c in channels]) for part, channels in spec[1]])
    if kind in ("box", "soft"):
        return (kind, *(end[..., order] for end in spec[1:]))
    if kind == "ball" and np.ndim(spec[2]):
        return (kind, spec[1], spec[2][order], spec[3])
    return spec


def boxed(case: Case, half_u: float, half_du: float) -> Case:
    """Return the case with boxes of so many times the recorded size on u and du, and no other sets."""
    size = np.abs(np.concatenate([u for u, _ in case.recordings])).max(0)
    sets = {"u_set": ("box", -half_u * size, half_u * size), "du_set": ("box", -half_du * size, half_du * size)}
    weights = {name: value for name, value in case.weights.items() if name not in ("lambda_u", "terminal_steps")}
    return replace(case, sets=sets, weights=weights)


def of_the_paper(case: Case) -> Case:
    """Return the case with the paper's terms alone, and boxes of once and twice the recorded size on u and y."""
    u, y = (np.abs(np.concatenate(part)).max(0) for part in zip(*case.recordings, strict=True))
    sets = {"u_set": ("box", -u, u), "y_set": ("box", -2 * y, 2 * y)}
    return replace(case, sets=sets, weights={k: case.weights[k] for k in ("Q", "R", "lambda_g", "lambda_s")})
