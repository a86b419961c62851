"""What an attack minimises, psi(u*(p)), with its gradient through the layer."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from ..checks import as_data, check_type, last_rows, to_horizon
from ..errors import Status
from ..layer import DPCLayer
from ..solution import DPCSolution
from ..solve.info import SolveInfo
from ..solve.recovery import NAMES, Thunks
from .base import Planner
from .costs import bound


class Objective:
    """psi(u*(p)) of one call of an attack, sample by sample, in float64.

    The layer may be a surrogate: references are cut to its horizon or their last row held, and it may look at fewer
    past steps than the windows have (the older rows then have a zero gradient).

    Args:
        layer: what the attacker believes the controller solves.
        cost: psi, a callable DPCSolution -> `(*batch,)`, with or without `at` and `given`.
        u_ini, y_ini: the true windows, `(*batch, t_ini, n)`.
        y_ref, u_ref: references, as the layer takes them.
        step: of the run.
        keeps_graph: whether gradients carry the graph of the windows, of p and of the layer's weights.

    Raises:
        ValueError: shapes that do not fit.
    """

    def __init__(
        self,
        layer: Planner,
        cost: Any,
        u_ini: Any,
        y_ini: Any,
        y_ref: Any,
        u_ref: Any,
        step: int,
        *,
        keeps_graph: bool = False,
    ):
        u_ini, y_ini = as_data("u_ini", u_ini).double(), as_data("y_ini", y_ini).double()
        if not keeps_graph:
            with torch.inference_mode(False):  # what inference mode made cannot enter a graph
                u_ini, y_ini = u_ini.detach().clone(), y_ini.detach().clone()
        if y_ini.ndim < 2:
            raise ValueError(f"`y_ini` must have shape (*batch, t_ini, n_y), got {tuple(y_ini.shape)}.")
        self.layer: Callable[..., Any] = layer
        self.y_ini, self.batch, self.keeps_graph = y_ini, y_ini.shape[:-2], keeps_graph
        self.u_ini = _of_batch("u_ini", u_ini, self.batch)
        data = getattr(layer, "data", None)
        horizon = None if data is None else data.horizon
        self.refs = {
            "y_ref": _reference("y_ref", y_ref, horizon, self.batch),
            "u_ref": _reference("u_ref", u_ref, horizon, self.batch),
        }
        self.t_ini = y_ini.shape[-2] if data is None else data.t_ini
        self.cost = bound(cost, step, self.u_ini, y_ini, **self.refs)
        self._last: DPCSolution | None = None

    def psi(self, p: Tensor, of: Tensor | None = None) -> Tensor:
        """Return psi at p, `(*batch,)`, with the graph of p; infinity where there is no plan.

        Args:
            p: the perturbation, `(*batch, t_ini, n_y)`, float64.
            of: the samples that are asked for, `(*batch,)`, boolean; the others' values are those of the last call.
        """
        if is_everyone(of):
            of = None
        u_ini, y_ini = (last_rows(self._of(of, w), self.t_ini) for w in (self.u_ini, self.y_ini + p))
        solution = self.layer(u_ini, y_ini, **self._refs_of(of), on_failure="nan")
        if of is not None:
            solution = self._among_the_last(solution, of)
        self._last = solution.detach()
        return torch.where(solution.info.status == Status.SOLVED, self._judged(solution), torch.inf)

    def gradient(self, p: Tensor, of: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return psi and its gradient in p, zero where there is no plan and for samples not asked for."""
        with torch.inference_mode(False), torch.enable_grad():
            if not (self.keeps_graph and p.requires_grad):
                p = p.detach().clone().requires_grad_()
            psi = self.psi(p, of)
            total = torch.where(psi.isfinite(), psi, 0.0).sum()
            gradient = torch.zeros_like(p)
            if total.requires_grad:
                (gradient,) = torch.autograd.grad(total, p, create_graph=self.keeps_graph)
        psi = psi.detach()
        return psi, torch.where(psi.isfinite()[..., None, None], gradient, 0.0)

    def _judged(self, plan: Any) -> Tensor:
        psi = self.cost(plan)
        check_type("cost", psi, Tensor)
        if psi.shape != self.batch:
            raise ValueError(f"`cost` must return one number a sample, {tuple(self.batch)}, got {tuple(psi.shape)}.")
        return psi

    def _refs_of(self, of: Tensor | None) -> dict[str, Tensor | None]:
        """Return the references of some samples; one that the batch shares is everyone's."""
        return {n: r if r is None or r.ndim <= 2 else self._of(of, r) for n, r in self.refs.items()}

    @staticmethod
    def _of(of: Tensor | None, values: Tensor) -> Tensor:
        return values if of is None else values[of]

    def _among_the_last(self, part: DPCSolution, of: Tensor) -> DPCSolution:
        """Put the plans of some samples among the last plans of all: a cost may know the batch it was made for."""
        last = self._last
        assert last is not None, "the first call asks for every sample"

        def placed(new: Tensor, old: Tensor) -> Tensor:
            return old.index_put((of,), new)

        def nonsingular() -> Tensor:
            return placed(part.info.nonsingular, last.info.nonsingular)

        info = SolveInfo(placed(part.info.table, last.info.table), part.info.is_selection, nonsingular)
        whole = {name: placed(getattr(part, name), getattr(last, name)) for name in ("u", "y", "lam")}

        def result(name: str) -> Callable[[], Tensor]:
            return lambda: placed(getattr(part, name), getattr(last, name))

        later = Thunks({name: result(name) for name in NAMES})
        return replace(part, info=info, _later=later, **whole)


def is_everyone(of: Tensor | None) -> bool:
    """Return whether a choice of samples contains every sample."""
    return of is None or bool(of.all())


def psi_and_gradient(
    layer: DPCLayer, cost: Any, u_ini: Any, y_ini: Tensor, p: Tensor, y_ref: Any, u_ref: Any, step: int
) -> tuple[Tensor, Tensor]:
    """Return psi(u*(p)), `(*batch,)`, and its gradient in p; infinity and 0 where there is no plan."""
    return Objective(layer, cost, u_ini, y_ini, y_ref, u_ref, step).gradient(p.double())


def _of_batch(name: str, value: Tensor, batch: torch.Size) -> Tensor:
    try:
        return value.expand(*batch, *value.shape[-2:])
    except RuntimeError as error:
        raise ValueError(
            f"`{name}` must have the batch shape of y_ini, {tuple(batch)}, or broadcast to it, got shape "
            f"{tuple(value.shape)}. Expand y_ini to attack several cases of one window."
        ) from error


def _reference(name: str, value: Any, horizon: int | None, batch: torch.Size) -> Tensor | None:
    """Return a reference that the layer takes: None, shared by the batch, or one a sample."""
    if value is None:
        return None
    tensor = as_data(name, value, integers=True)
    tensor = tensor if horizon is None else to_horizon(tensor, horizon)
    return tensor if tensor.ndim <= 2 else _of_batch(name, tensor, batch)
