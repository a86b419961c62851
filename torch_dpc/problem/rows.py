"""The rows of the problem in the coordinates of the data's own row space, where n_g is gone.

With g = B a (:mod:`torch_dpc.data.row_space`) the problem reads

    minimise over a   1/2 |v - v_ref|_W^2 + lambda_g |N a|^2 + sum over other rows of lambda |S a - s|^2
    subject to        Eq a = e,   v = C a in the product of the sets,

with v = (u, y), and after them the changes of the input and the slack Yp g - y_ini where the problem speaks of those.
v_ref, s and e are entries of theta = (u_ini, y_ini, u_ref, y_ref). What each of the problem's terms adds is told here,
and only here.

A slack of which the sets speak has coordinates of its own, the first ones of a, and is held at Yp g - y_ini by
equalities: so v = C a, without a part that depends on theta.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from ..autodiff import carries_derivative
from ..batching import times
from ..data.hankel import HankelData
from .data_derivative import in_row_space
from .regularizers import charged_by, in_row_space_of_W, second_block
from .terms import Terms

#: How far u_ini may be from what the data can produce, relative to its norm, each channel in its own unit.
REACHABLE = 1e-8


@dataclass(frozen=True)
class Tracking:
    """A part of v that is charged 1/2 |v - v_ref|^2 in a weight of its own.

    Attributes:
        weight: the name of the weight.
        rows: the part of v.
        reference: where in theta its reference begins; None for zero.
        channels: entries of a step.
    """

    weight: str
    rows: slice
    reference: int | None
    channels: int


@dataclass(frozen=True, eq=False)
class Fit:
    """Rows that are charged weight |S a - s|^2.

    Attributes:
        weight: the name of the weight.
        rows: S, `(k, r)`.
        measured: where in theta s begins; None for zero.
    """

    weight: str
    rows: Tensor
    measured: int | None


@dataclass(frozen=True, eq=False)
class DataRows:
    """The rows of a problem; leading dimensions, if any, are one data set each.

    Attributes:
        Up, Yp, Uf, Yf: the data, `(rows, r)`.
        C: the rows of v, `(N, r)`.
        Eq: the equality rows, `(n_eq, r)`.
        Eq_theta: which entries of theta they equal, `(n_eq,)`.
        Eq_pinv: the pseudo-inverse of Eq, `(r, n_eq)`.
        Z: orthonormal basis of the kernel of Eq, `(r, n_x)`.
        Eq_range: orthonormal basis of the range of Eq, or None where it is everything.
        charged: which entries of a lambda_g charges, `(r,)` of ones and zeros: all, or those that W does not reach.
        is_identity: whether that is all by choice.
        scale, theta_scale: the units of the entries of v, `(N,)`, and of theta, `(n_theta,)`: powers of two near the
            root mean square of each entry's channel in the recording.
        tracking, fits: the terms of the cost.
        n_theta: entries of theta.
        tolerance: the data's own rank tolerance.
    """

    Up: Tensor
    Yp: Tensor
    Uf: Tensor
    Yf: Tensor
    C: Tensor
    Eq: Tensor
    Eq_theta: Tensor
    Eq_pinv: Tensor
    Z: Tensor
    Eq_range: Tensor | None
    charged: Tensor
    scale: Tensor
    theta_scale: Tensor
    is_identity: bool
    tracking: tuple[Tracking, ...]
    fits: tuple[Fit, ...]
    n_theta: int
    tolerance: float

    def unreachable(self, theta: Tensor) -> Tensor:
        """Return which samples `(B,)` ask for a u_ini, or a terminal output, that no combination of the data makes."""
        if self.Eq_range is None:
            return torch.zeros(theta.shape[:-1], dtype=torch.bool, device=theta.device)
        wanted = (theta / self.theta_scale)[..., self.Eq_theta]
        missed = wanted - times(self.Eq_range, times(self.Eq_range.mT, wanted))
        norm = torch.linalg.vector_norm
        return norm(missed, dim=-1) > REACHABLE * norm(wanted, dim=-1)

    def map(self, change: Callable[[Tensor, int], Tensor]) -> DataRows:
        """Return the rows with `change(tensor, own dimensions)` in place of each tensor that depends on the data."""
        there = {name: x for name in _OF_DATA if (x := getattr(self, name)) is not None}
        changed: dict[str, Any] = {name: change(x, 1 if name in _VECTORS else 2) for name, x in there.items()}
        fits = tuple(replace(fit, rows=change(fit.rows, 2)) for fit in self.fits)
        return replace(self, **changed, fits=fits)

    @staticmethod
    def stack(many: Sequence[DataRows]) -> DataRows:
        """Return the rows of several data sets as one, a leading dimension; shorter row spaces are padded.

        A padded coordinate meets no row and is charged by lambda_g, so it is zero at every solution.

        Raises:
            ValueError: the equalities have different ranks.
        """
        r = max(rows.C.shape[-1] for rows in many)
        if len({rows.Z.shape[0] - rows.Z.shape[1] for rows in many}) > 1:
            raise ValueError("the data sets of a batch must have one rank of Up: one has an idle input.")
        padded = [_padded(rows, r - rows.C.shape[-1]) for rows in many]
        first = padded[0]
        changed: dict[str, Any] = {
            name: torch.stack([getattr(rows, name) for rows in padded])
            for name in _OF_DATA
            if getattr(first, name) is not None
        }
        fits = tuple(
            replace(fit, rows=torch.stack([rows.fits[i].rows for rows in padded])) for i, fit in enumerate(first.fits)
        )
        return replace(first, **changed, fits=fits, tolerance=max(rows.tolerance for rows in many))

    @staticmethod
    def of(data: HankelData, device: torch.device, terms: Terms = Terms()) -> DataRows:  # noqa: B008
        """Return the rows of the data; a graph behind the data matrices reaches through."""
        space = data.row_space
        theta_scale, charged = space.units.to(device), charged_by(terms.regularizer, space.rank, space.rank_W, device)
        rows, fits = _in_coordinates(data, terms, device)
        n_slack = len(data.Yp) if terms.mismatch else 0
        rows, charged = (torch.nn.functional.pad(x, (n_slack, 0)) for x in (rows, charged))
        Up, Yp, Uf, Yf = rows.split([len(m) for m in data.matrices])
        u_ref = len(Up) + len(Yp)
        y_ref = u_ref + len(Uf)
        n_theta, n_v = y_ref + len(Yf), len(Uf) + len(Yf)
        tracking = [
            Tracking("R", slice(0, len(Uf)), u_ref, data.n_u),
            Tracking("Q", slice(len(Uf), n_v), y_ref, data.n_y),
        ]
        fits = [replace(fit, rows=torch.nn.functional.pad(fit.rows, (n_slack, 0))) for fit in fits]
        fits.append(Fit("lambda_s", Yp, len(Up)))
        parts = [Uf, Yf]
        if terms.rates:
            # The input before the plan is (Up a)'s last step, which the equality rows hold at the measured one.
            parts.append(Uf - torch.cat([Up, Uf])[len(Up) - data.n_u : -data.n_u])
            tracking.append(Tracking("R_du", slice(n_v, n_v + len(Uf)), None, data.n_u))
        if terms.slack:
            fits.append(Fit("lambda_u", Up[int(terms.affine) :], int(terms.affine)))
        scale = [theta_scale[u_ref:], *[theta_scale[u_ref:y_ref]] * terms.rates]
        if terms.mismatch:
            parts.append(torch.eye(n_slack, rows.shape[1], dtype=rows.dtype, device=device))
            scale.append(theta_scale[len(Up) : u_ref])
        Eq, Eq_theta = _equalities(rows, data, terms)
        eliminated = _eliminate(Eq.detach(), theta_scale[Eq_theta], data.rank_tolerance)
        return DataRows(
            *(Up, Yp, Uf, Yf, torch.cat(parts), Eq, Eq_theta, *eliminated),
            charged=charged,
            scale=torch.cat(scale),
            theta_scale=theta_scale,
            is_identity=terms.regularizer == "identity",
            tracking=tuple(tracking),
            fits=tuple(fits),
            n_theta=n_theta,
            tolerance=data.rank_tolerance,
        )


def _in_coordinates(data: HankelData, terms: Terms, device: torch.device) -> tuple[Tensor, list[Fit]]:
    """Return [Up; Yp; Uf; Yf] B, `(rows, r)`, and what is charged of g besides lambda_g; a graph reaches through.

    Raises:
        ValueError: data with a graph whose rank is not clear.
    """
    space = data.row_space
    has_graph = carries_derivative(data.matrices)
    if not space.clear and has_graph:
        raise ValueError(
            "the data carry a graph, but their rank is not clear, and derivatives hold at constant rank: the "
            f"singular values around the decision are {space.last_kept:.1e} (kept) and {space.first_dropped:.1e} "
            "(dropped), relative to the largest."
        )
    basis, stacked = space.basis.to(device), data.stacked.to(device)
    rows = in_row_space(stacked, basis) if has_graph else stacked @ basis
    if terms.regularizer not in ("spc", "gamma"):
        return rows, []
    in_units = rows / space.units.to(device)[:, None]
    W = in_units[: len(rows) - len(data.Yf)]
    if terms.regularizer == "spc":
        return in_row_space_of_W(rows, W, space.rank_W, data.rank_tolerance), []
    cutoff = data.rank_tolerance * torch.linalg.matrix_norm(in_units.detach(), ord=2)
    n_past = len(data.Up) + len(data.Yp)
    return rows, [Fit("beta_2", second_block(W, n_past, space.rank_W, cutoff, data.rank_tolerance), None)]


def _equalities(rows: Tensor, data: HankelData, terms: Terms) -> tuple[Tensor, Tensor]:
    """Return the equality rows and the entries of theta that they equal.

    Args:
        rows: [Up; Yp; Uf; Yf] in the coordinates of the problem, `(rows, r)`.
        data, terms: of the problem.
    """
    Up, Yp, _, Yf = rows.split([len(m) for m in data.matrices])
    # 1'g = 1 has no slack
    exact = int(terms.affine) if terms.slack else len(Up)
    equal, places = [Up[:exact]], [torch.arange(exact)]
    if terms.mismatch:
        equal.append(Yp - torch.eye(*Yp.shape, dtype=rows.dtype, device=rows.device))
        places.append(torch.arange(len(Up), len(Up) + len(Yp)))
    if terms.terminal_steps:
        last = terms.terminal_steps * data.n_y
        equal.append(Yf[-last:])
        places.append(torch.arange(len(rows) - last, len(rows)))
    return torch.cat(equal), torch.cat(places).to(rows.device)


#: The fields that depend on the data, and those of them that are vectors.
_OF_DATA = ("Up", "Yp", "Uf", "Yf", "C", "Eq", "Eq_pinv", "Z", "Eq_range", "charged", "scale", "theta_scale")
_VECTORS = ("charged", "scale", "theta_scale")


def _padded(rows: DataRows, more: int) -> DataRows:
    """Return the rows with `more` coordinates that meet none of them."""
    pad = torch.nn.functional.pad
    wide: dict[str, Any] = {name: pad(getattr(rows, name), (0, more)) for name in ("Up", "Yp", "Uf", "Yf", "C", "Eq")}
    return replace(
        rows,
        **wide,
        Eq_pinv=pad(rows.Eq_pinv, (0, 0, 0, more)),
        Z=torch.block_diag(rows.Z, torch.eye(more, dtype=rows.Z.dtype, device=rows.Z.device)),
        charged=pad(rows.charged, (0, more), value=1.0),
        fits=tuple(replace(fit, rows=pad(fit.rows, (0, more))) for fit in rows.fits),
    )


def _eliminate(Eq: Tensor, units: Tensor, tolerance: float) -> tuple[Tensor, Tensor, Tensor | None]:
    """Return Eq^+, a basis of the kernel of Eq, and one of the range of Eq in its units where that is not everything.

    The pseudo-inverse is that of the rows in their own units: a row that is small in the caller's units counts as much
    as any other.
    """
    if len(Eq) == 0:
        return Eq.mT, torch.eye(Eq.shape[1], dtype=Eq.dtype, device=Eq.device), None
    with torch.no_grad():
        left, singular, right_h = torch.linalg.svd(Eq / units[:, None], full_matrices=True)
        rank = int((singular > tolerance * singular.amax()).sum()) if singular.numel() else 0
        pinv = (right_h[:rank].T / singular[:rank]) @ left[:, :rank].T / units
        reached = None if rank == len(Eq) else left[:, :rank].contiguous()
        return pinv, right_h[rank:].T.contiguous(), reached
