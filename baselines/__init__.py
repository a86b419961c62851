"""Peers of the layer behind the layer's own call: what others need, how long they take and how right they are.

Nothing in torch_dpc imports this package, and a peer is imported when its adapter is made. `PEERS` lists every
configuration that the comparisons use.

Example:
    >>> [name for name, peer in PEERS.items() if peer.kind == "differentiable" and peer.formulation == "reduced"][-3:]
    ['qpth (reduced)', 'QPLayer (reduced)', 'QPLayer, tight backward (reduced)']
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from torch_dpc import DPCLayer

from ._adapter import Baseline, PeerInfo
from ._problem import FORMULATIONS
from .cvxpylayers import CvxpyLayersDPC
from .forward_only import ENGINES, ForwardOnlyDPC
from .full_kkt import FullKKT
from .qplayer import QPLayerDPC
from .qpth import QpthDPC
from .robust import RobustDPC

__all__ = [
    "FORMULATIONS",
    "PEERS",
    "Baseline",
    "CvxpyLayersDPC",
    "ForwardOnlyDPC",
    "FullKKT",
    "Peer",
    "PeerInfo",
    "QPLayerDPC",
    "QpthDPC",
    "RobustDPC",
]


@dataclass(frozen=True)
class Peer:
    """One configuration of a peer.

    Attributes:
        name: as the tables print it.
        kind: "differentiable" or "forward-only".
        formulation: "paper" or "reduced".
        make: layer -> the baseline; raises ImportError where the peer is not installed.
    """

    name: str
    kind: str
    formulation: str
    make: Callable[[DPCLayer], Baseline]


#: QPLayer's backward is itself iterative and stops at 1e-4 by default; with these it is as exact as it can be.
QPLAYER_TIGHT = {"eps_backward": 1e-10, "rho_backward": 1e-10, "mu_backward": 1e-10}
#: The conic solvers of diffcp with each of its derivative modes.
DIFFCP_SETTINGS = tuple((method, mode) for method in ("Clarabel", "ECOS", "SCS") for mode in ("lsqr", "lsmr", "dense"))
#: PIQP's defaults stop at 1e-8 and leave 1e-4 in the solution.
FORWARD_ONLY_SETTINGS = {"piqp": {"eps_abs": 1e-12, "eps_rel": 1e-12}}


def _peers() -> dict[str, Peer]:
    found: dict[str, tuple[str, Callable[..., Baseline]]] = {
        "full KKT, rows scaled (paper)": ("differentiable", FullKKT),
        "full KKT, as printed (paper)": ("differentiable", partial(FullKKT, scaled=False)),
    }
    for form in FORMULATIONS:
        adapters: dict[str, Callable[..., Baseline]] = {
            f"cvxpylayers DIFFCP {method} {mode}": partial(
                CvxpyLayersDPC, solver_args={"solve_method": method, "mode": mode}
            )
            for method, mode in DIFFCP_SETTINGS
        }
        adapters |= {
            "cvxpylayers MOREAU": partial(CvxpyLayersDPC, solver="MOREAU"),
            "qpth": partial(QpthDPC, accept_unconverged=True),
            "QPLayer": partial(QPLayerDPC, accept_unconverged=True),
            "QPLayer, tight backward": partial(QPLayerDPC, accept_unconverged=True, solver_args=QPLAYER_TIGHT),
        }
        engines = {
            name: partial(ForwardOnlyDPC, solver=name, solver_args=FORWARD_ONLY_SETTINGS.get(name)) for name in ENGINES
        }
        for kind, group in (("differentiable", adapters), ("forward-only", engines)):
            found |= {f"{name} ({form})": (kind, partial(make, formulation=form)) for name, make in group.items()}
    # Every name ends in its formulation in brackets.
    return {name: Peer(name, kind, name.split("(")[-1].rstrip(")"), make) for name, (kind, make) in found.items()}


#: Every configuration by its name.
PEERS: dict[str, Peer] = _peers()
