"""What every baseline shares: the layer's call, its result, and failures in the peer's own words."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from torch_dpc import DPCLayer, DPCSolution, InfeasibleError, SolveError, SolveInfo, Status
from torch_dpc.solve.recovery import Thunks

from ._layer import Judge, theta_of
from ._problem import QP, Call

#: A peer's row touches its bound within this distance, relative to 1 + |v|: interior-point answers stop short of it.
TOUCHING = 1e-6


@dataclass
class PeerResult:
    """What a peer found for a batch.

    Attributes:
        z: the solution, `(B, n)`, with the peer's graph.
        multipliers: of the rows of C, positive at the upper bound, `(B, k)`, without a graph; None where untold.
        iterations: `(B,)`, or None where untold.
        message: the peer's own words where it solved with reservations; empty otherwise.
    """

    z: Tensor
    multipliers: Tensor | None = None
    iterations: Tensor | None = None
    message: str = ""


class PeerInfo(SolveInfo):
    """How a peer's solve went; computed when looked at, so that it does not count in a timing.

    Attributes:
        is_selection: always False: a peer's choice among several optima is its own.
        message: the peer's own words where it solved with reservations ("Solved/Inaccurate."); empty otherwise.

    `residual` is that of the reduced optimality conditions at the peer's own (u, y) and multipliers, relative, and NaN
    where the peer does not tell its multipliers; `iterations` is -1 where untold.
    """

    def __init__(self, make_table: Callable[[], Tensor], message: str = ""):
        self._make_table, self.message, self.is_selection = make_table, message, False

    @cached_property
    def table(self) -> Tensor:  # type: ignore[override]
        """The five numbers of each sample, `(*batch, 5)`."""
        return self._make_table()


class Baseline:
    """A peer with the layer's own call and result.

    Args:
        layer: the layer whose problem is solved. Its data, weights and bounds are read now, as constants.
        formulation: "paper" or "reduced", see :mod:`baselines._problem`.

    A baseline differentiates with respect to u_ini, y_ini, y_ref and u_ref. `sol.lam` carries no graph. One object is
    for one thread.
    """

    #: As messages and tables call the peer.
    name = ""
    #: The peer computes on the CPU whatever the device of the measurements.
    cpu_only = True
    #: The peer has a gradient.
    is_differentiable = True

    def __init__(self, layer: DPCLayer, formulation: str = "reduced"):
        self.layer, self.formulation = layer, formulation
        self.qp = QP.of(layer, formulation)
        self._on_device = {torch.device("cpu"): self.qp}
        self._judge = Judge(layer, TOUCHING)

    @property
    def kkt_size(self) -> int:
        """Unknowns of the system that the peer solves to differentiate, read from the peer's own problem."""
        raise NotImplementedError

    def __call__(self, u_ini: Any, y_ini: Any, *, y_ref: Any = None, u_ref: Any = None) -> DPCSolution:
        """Plan as the layer does; see :meth:`torch_dpc.DPCLayer.forward`.

        Raises:
            ValueError: as the layer.
            SolveError: the peer failed; the message is its own. `InfeasibleError` where it says that.
        """
        theta, dtype = theta_of(self.layer, u_ini, y_ini, y_ref, u_ref)
        device, batch = theta.device, theta.shape[:-1]
        flat = theta.reshape(-1, theta.shape[-1])
        if self.cpu_only:
            flat = flat.cpu()
        if not self.is_differentiable:
            flat = flat.detach()
        qp = self._program(flat.device)
        result = self._solve(Call(qp, flat)) if len(flat) else PeerResult(flat.new_zeros(0, len(qp.P)))
        v = qp.v(flat, result.z)
        lam = _lam(qp, result, v)

        def shaped(x: Tensor) -> Tensor:
            return x.reshape(*batch, *x.shape[1:]).to(device)

        n_u, horizon = self.layer.data.n_u, self.layer.data.horizon
        u, y = (part.unflatten(-1, (horizon, -1)) for part in v.tensor_split([horizon * n_u], dim=-1))
        return DPCSolution(
            u=shaped(u).to(dtype),
            y=shaped(y).to(dtype),
            info=PeerInfo(lambda: shaped(_table(self._judge, flat, v, lam, result)), result.message),
            lam=shaped(lam),
            _later=Thunks({"g": lambda: shaped(qp.g(flat, result.z)).to(dtype)}),
        )

    def _solve(self, call: Call) -> PeerResult:
        """Solve a batch of at least one, or raise `SolveError`."""
        raise NotImplementedError

    def _program(self, device: torch.device) -> QP:
        if device not in self._on_device:
            self._on_device[device] = self.qp.to(device)
        return self._on_device[device]


def require(module: str, name: str, *, no_deps: bool = False) -> Any:
    """Import a peer, or say how to get it.

    Args:
        module: what to import.
        name: what users call it.
        no_deps: it must be installed without its dependencies.

    Raises:
        ImportError: it is not installed.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        how = "pip install 'torch_dpc[baselines]'"
        if no_deps:
            how += " and then pip install --no-deps qpth (it declares numpy<2, but works with numpy 2)"
        raise ImportError(f"the {name} baseline needs {module}, which cannot be imported ({error}): {how}") from error


def raise_failures(peer: str, messages: Sequence[str | None], infeasible: Sequence[bool] | None = None) -> None:
    """Raise for the samples that have a message.

    Args:
        peer: its name.
        messages: the peer's own words for every sample, None where it is content.
        infeasible: where those words mean that there is no solution.

    Raises:
        InfeasibleError: all of them are.
        SolveError: otherwise.
    """
    failed = [i for i, message in enumerate(messages) if message is not None]
    if not failed:
        return
    kind = InfeasibleError if infeasible is not None and all(infeasible[i] for i in failed) else SolveError
    raise kind(
        f"{peer} failed on {len(failed)} of {len(messages)} problems, the first {failed[0]}: {messages[failed[0]]}",
        [(i,) for i in failed],
    )


def _lam(qp: QP, result: PeerResult, v: Tensor) -> Tensor:
    if result.multipliers is None:
        return torch.full_like(v, torch.nan, requires_grad=False)
    lam = torch.zeros_like(v, requires_grad=False)
    lam[:, qp.rows] = result.multipliers.detach()
    return lam


@torch.no_grad()
def _table(judge: Judge, theta: Tensor, v: Tensor, lam: Tensor, result: PeerResult) -> Tensor:
    """Return status, iterations, residual, n_active, n_weakly_active, `(B, 5)`."""
    theta, v, lam = theta.cpu(), v.cpu(), lam.cpu()
    residual = judge.residual(theta, v, lam)
    held = [rows.sum(-1).double() for rows in judge.active(v, lam)]
    status = torch.full_like(residual, Status.SOLVED)
    iterations = torch.full_like(residual, -1) if result.iterations is None else result.iterations.to(residual)
    return torch.stack([status, iterations, residual, *held], dim=-1)
