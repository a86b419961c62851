"""The data-driven predictive control problem as a torch module."""

from __future__ import annotations

import contextlib
import functools
import os
from typing import Any

import torch
from torch import Tensor, nn

from .autodiff import carries_derivative, untransformed
from .batching import times
from .checks import one_batch, reference, window, with_one_batch
from .data.hankel import HankelData
from .data.hankel_batch import HankelBatch
from .errors import Status
from .function import solve_reduced
from .problem.compact_form import CompactForm, compact_form
from .problem.projected_kkt import FullSystem
from .problem.reduction import Reduction, reduce
from .problem.rows import DataRows
from .problem.terms import Sizes, Terms
from .problem.weights import Weights, penalty, weight_matrix
from .saving import load_layer, save_layer
from .sets import ConvexSet
from .sets.feasible import FeasibleSet
from .settings import DOORS, Setup, check_choice, settings_of
from .solution import DPCSolution, SolveInfo
from .solve.convex_solve import ConvexSolver
from .solve.solver import Planned, Solver


class DPCLayer(nn.Module):
    """Plan a trajectory of the recorded system by one quadratic program, differentiably.

        minimise over u, y, g   1/2 |y - y_ref|_Q^2 + 1/2 |u - u_ref|_R^2 + lambda_g |M g|^2 + lambda_s |Yp g - y_ini|^2
        subject to              Up g = u_ini,  u = Uf g,  y = Yf g,  u in U,  y in Y,

    M = I - W^+ W, W = [Up; Yp; Uf] (Yu, Zhao, Chinchali, Topcu). The data are factored once, when they and the weights
    are first used; a call then costs a matrix product and small solves, whatever the number of recorded windows.

    Beyond the paper, each exact in the reduction and differentiable:

        regularizer="identity"   lambda_g |g|^2 in place of lambda_g |M g|^2
        lambda_u                 lambda_u |Up g - u_ini|^2 in place of Up g = u_ini
        R_du, du_set             + 1/2 |du|_R_du^2 and du in DU, du_t = u_t - u_(t-1), from the last of u_ini on
        terminal_steps           the last outputs of the plan equal their reference

    Args:
        data: the recorded trajectories.
        Q: output weight, positive semidefinite: a number, `(n_y, n_y)`, or `(horizon n_y, horizon n_y)`.
        R: input weight, likewise.
        lambda_g: regularisation of the part of g that the past and the future input do not explain.
        lambda_s: penalty on the mismatch of the initial output.
        u_set, y_set: constraints on every step's input and output, any :class:`ConvexSet`; `None` for none.
        du_set: constraint on every step's change of the input.
        R_du: weight of the changes of the input, given like R; `None` for none.
        lambda_u: penalty on the mismatch of the initial input; `None` where that is to be exact.
        regularizer: "projection", the paper's |M g|^2, or "identity", |g|^2.
        terminal_steps: so many last outputs equal y_ref.
        backward: "reduced", the exact reduced system, or "full", the paper's projected KKT system.
        solver: the forward engine: "newton" (batched), "daqp" (one by one), or "auto".
        on_failure: "raise", or "nan" to mark samples that have no solution and return the others.

    Weights may be numbers, tensors or parameters. An `nn.Parameter` is registered and learns; a tensor that carries a
    graph keeps it.

    Raises:
        ValueError: bad input, named.

    Example:
        >>> from torch_dpc import Box, HankelData
        >>> u = torch.rand(60, 1, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) - 0.5
        >>> data = HankelData.from_trajectories(u, u.cumsum(0) - u, t_ini=2, horizon=5)   # an integrator
        >>> layer = DPCLayer(data, Q=1.0, R=0.1, lambda_g=1.0, lambda_s=1e3, u_set=Box(-0.3, 0.3))
        >>> sol = layer(torch.zeros(2, 1), torch.zeros(2, 1), y_ref=torch.ones(1))
        >>> sol.u.shape, int(sol.info.status), int(sol.info.n_active)
        (torch.Size([5, 1]), 0, 3)
    """

    def __init__(
        self,
        data: HankelData | HankelBatch,
        Q: Any,
        R: Any,
        lambda_g: Any,
        lambda_s: Any,
        u_set: ConvexSet | None = None,
        y_set: ConvexSet | None = None,
        *,
        du_set: ConvexSet | None = None,
        R_du: Any = None,
        lambda_u: Any = None,
        regularizer: str = "projection",
        terminal_steps: int = 0,
        backward: str = "reduced",
        solver: str = "auto",
        on_failure: str = "raise",
    ):
        super().__init__()
        self._setup_cache: tuple[tuple[Any, ...], Setup] | None = None
        self._cache: dict[tuple[str, torch.device], tuple[tuple[Any, ...], Any]] = {}
        self.data = data
        self.Q, self.R, self.lambda_g, self.lambda_s = Q, R, lambda_g, lambda_s
        self.lambda_u, self.R_du = lambda_u, R_du
        self.u_set: ConvexSet = u_set  # type: ignore[assignment]
        self.y_set: ConvexSet = y_set  # type: ignore[assignment]
        self.du_set: ConvexSet | None = du_set
        self.regularizer = regularizer
        self.terminal_steps = terminal_steps
        self.backward_system = backward
        self.solver = solver
        self.on_failure = on_failure
        cpu = torch.device("cpu")
        weights = self._weights(cpu)  # bad weights and bounds are told now, not at the first call
        if self._setup.is_box:
            self.bounds(cpu)
        one_batch([*self._batches_of(weights), *self.feasible_set.batches(cpu)])

    def __setattr__(self, name: str, value: Any) -> None:
        """Assign; a setting is checked first, as the constructor checks it."""
        door = DOORS.get(name)
        super().__setattr__(name, value if door is None else door(name, value))

    @property
    def _setup(self) -> Setup:
        """What follows from the settings, made anew when one of them has changed."""
        now = settings_of(self.__dict__)
        kept = self._setup_cache
        if kept is None or kept[0] != now:
            kept = self._setup_cache = (now, Setup.of(self))
        return kept[1]

    @property
    def backward(self) -> str:
        """The system that the backward solves, "reduced" or "full"; may be assigned."""
        return self.backward_system

    @backward.setter
    def backward(self, value: str) -> None:
        self.backward_system = value

    @property
    def terms(self) -> Terms:
        """Which terms the problem has beyond the paper's."""
        return self._setup.terms

    @property
    def sizes(self) -> Sizes:
        """The sizes of the parts of theta and of v."""
        return self._setup.sizes

    @property
    def reduction(self) -> Reduction:
        """The reduced problem of the present weights; see :mod:`torch_dpc.problem.reduction`."""
        return self._factors(self.data.device)[0]

    @property
    def feasible_set(self) -> FeasibleSet:
        """All sets of the problem as one."""
        return self._setup.sets

    @property
    def reduced_kkt_size(self) -> int:
        """Unknowns of the reduced system: horizon (n_u + n_y), horizon n_u more where changes of the input count."""
        return self.sizes.v

    @property
    def full_kkt_size(self) -> int:
        """Unknowns of the paper's system: 2 horizon (n_u + n_y) + t_ini n_u + n_g.

        Raises:
            ValueError: the data sets of a batch have different n_g.
        """
        data = self.data
        return 2 * data.horizon * (data.n_u + data.n_y) + data.t_ini * data.n_u + data.n_g

    def forward(
        self, u_ini: Any, y_ini: Any, *, y_ref: Any = None, u_ref: Any = None, on_failure: str | None = None
    ) -> DPCSolution:
        """Plan from the last `t_ini` inputs and outputs.

        Args:
            u_ini: past inputs, `(*batch, t_ini, n_u)`.
            y_ini: past outputs, `(*batch, t_ini, n_y)`.
            y_ref, u_ref: references, broadcast to `(*batch, horizon, n)`; zero by default.
            on_failure: in place of the layer's own, for this call.

        Returns:
            The plan, in the dtype and on the device of the measurements.

        Raises:
            ValueError: shapes that do not fit, or values that are not finite.
            InfeasibleError: a sample has no solution, provably (with `on_failure="raise"`).
            SolveError: a sample could not be solved (likewise).
        """
        if torch.compiler.is_compiling():  # a compiled model breaks its graph here
            return _uncompiled()(self, u_ini, y_ini, y_ref, u_ref, on_failure)
        return self._call(u_ini, y_ini, y_ref, u_ref, on_failure)

    def _call(self, u_ini: Any, y_ini: Any, y_ref: Any, u_ref: Any, on_failure: str | None) -> DPCSolution:
        theta, dtype = self.flatten(u_ini, y_ini, y_ref, u_ref)
        if self._setup.is_box:
            return self.plan(theta, *self.bounds(theta.device), dtype=dtype, on_failure=on_failure)
        reduction, solver = self._factors(theta.device)
        batches = [("the samples", theta.shape[:-1]), *self._batches_of(reduction.weights)]
        one_batch([*batches, *self.feasible_set.batches(theta.device)])
        planned = _with_failures(solver, on_failure).plan(theta, reduction)
        return self._solution(planned, theta, reduction, solver, dtype)

    def plan(
        self,
        theta: Tensor,
        lower: Tensor,
        upper: Tensor,
        *,
        dtype: torch.dtype = torch.float64,
        on_failure: str | None = None,
    ) -> DPCSolution:
        """Plan for flattened parameters and bounds of one's own; what a call does after its checks.

        Args:
            theta: (u_ini, y_ini, u_ref, y_ref) flattened, `(*batch, n_theta)`, float64.
            lower, upper: bounds of (u, y, du) flattened, `(N,)` or one a sample, float64.
            dtype: of the plan.
            on_failure: in place of the layer's own.
        """
        reduction, solver = self._factors(theta.device)
        if lower.ndim > 1 or upper.ndim > 1 or reduction.V.ndim > 2:
            bounds = [("lower", lower.shape[:-1]), ("upper", upper.shape[:-1])]
            one_batch([("the samples", theta.shape[:-1]), *self._batches_of(reduction.weights), *bounds])
        planned = solve_reduced(_with_failures(solver, on_failure), theta, reduction, lower, upper)
        return self._solution(planned, theta, reduction, solver, dtype)

    def _solution(
        self, planned: Planned, theta: Tensor, reduction: Reduction, solver: Any, dtype: torch.dtype
    ) -> DPCSolution:
        u, y, lam, _, info = planned
        data = self.data  # g is made later, and is of these
        return DPCSolution(
            u=u if dtype == torch.float64 else u.to(dtype),
            y=y if dtype == torch.float64 else y.to(dtype),
            info=SolveInfo(info, reduction.is_selection, lambda: _nonsingular(data, solver, theta, planned)),
            lam=lam,
            _make_g=lambda: _g(data, reduction, theta, lam, info).to(dtype),
        )

    def compact_form(self, u_ini: Any, y_ini: Any, *, y_ref: Any = None, u_ref: Any = None) -> CompactForm:
        """Return the problem as the paper writes it, minimise 1/2 z'Pz + q'z subject to H z = b, z in D.

        The arguments are those of the call. P is `(n, n)`, q `(*batch, n)`, H `(m, n)`, b `(*batch, m)`, float64.
        """
        theta, _ = self.flatten(u_ini, y_ini, y_ref, u_ref)
        weights = self._weights(theta.device)
        if weights.are_batched or isinstance(self.data, HankelBatch):
            raise ValueError("`compact_form` takes one problem; the weights or the data have a batch dimension.")
        if self.du_set is not None:
            raise ValueError("`compact_form` has no rows for changes of the input; leave out `du_set`.")
        return compact_form(self.data, weights, theta, self.terms)

    def config(self) -> dict[str, Any]:
        """Return the arguments of the constructor beyond the data, as they are now."""
        return {
            "Q": self.Q,
            "R": self.R,
            "lambda_g": self.lambda_g,
            "lambda_s": self.lambda_s,
            "u_set": self.u_set,
            "y_set": self.y_set,
            "du_set": self.du_set,
            "R_du": self.R_du,
            "lambda_u": self.lambda_u,
            "regularizer": self.regularizer,
            "terminal_steps": self.terminal_steps,
            "backward": self.backward_system,
            "solver": self.solver,
            "on_failure": self.on_failure,
        }

    def save(self, path: str | os.PathLike[str], *, data: bool = False) -> None:
        """Write the layer to a safetensors file: weights, sets, settings and the data, without pickle.

        Parameters, tensors and numbers come back as what they are; of a tensor that a graph made, its value is kept.
        So it is with what `torch.nn.utils.parametrize` makes: the present value comes back, a plain tensor, without
        its parametrisation.

        Args:
            path: of the file, which is replaced.
            data: write the recorded windows, for `sol.g`. Otherwise the data are written compact: the file is small
                whatever the number of windows, plans are the same, and `sol.g` raises.

        Raises:
            ValueError: a set that is not known (:func:`torch_dpc.register_set`); windows asked of compact data;
                settings that do not go together.
            OSError: the file cannot be written.
            ImportError: safetensors is missing.
        """
        save_layer(self, path, data=data)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> DPCLayer:
        """Return the layer that :meth:`save` wrote, on the CPU.

        Raises:
            ValueError: a damaged file, another version of the format, or a set that is not known.
            ImportError: safetensors is missing.
        """
        layer: DPCLayer = load_layer(cls, path)
        return layer

    def extra_repr(self) -> str:
        """Describe the data and the sizes of the systems that are solved."""
        sizes = ""
        for name in ("reduced_kkt_size", "full_kkt_size"):
            # Settings under change may not fit, and the data sets of a batch may differ: neither has a size to show.
            with contextlib.suppress(ValueError):
                sizes += f", {name}={getattr(self, name)}"
        return (
            f"{self.data!r}{sizes}, "
            f"backward={self.backward_system!r}, solver={self.solver!r}, on_failure={self.on_failure!r}"
        )

    def flatten(self, u_ini: Any, y_ini: Any, y_ref: Any, u_ref: Any) -> tuple[Tensor, torch.dtype]:
        """Return (u_ini, y_ini, u_ref, y_ref) flattened, `(*batch, n_theta)` in float64, and the caller's dtype."""
        data = self.data
        u_ini = window("u_ini", u_ini, data.t_ini, data.n_u, "n_u")
        y_ini = window("y_ini", y_ini, data.t_ini, data.n_y, "n_y")
        parts = [
            u_ini,
            y_ini,
            reference("u_ref", u_ref, data.horizon, data.n_u, "n_u", u_ini),
            reference("y_ref", y_ref, data.horizon, data.n_y, "n_y", y_ini),
        ]
        dtype = u_ini.dtype if u_ini.dtype == y_ini.dtype else torch.promote_types(u_ini.dtype, y_ini.dtype)
        if all(part.ndim == 2 for part in parts):
            theta = torch.cat([part.reshape(-1) for part in parts])
        else:
            theta = torch.cat([part.flatten(-2) for part in with_one_batch(parts)], dim=-1)
        return (theta if theta.dtype == torch.float64 else theta.double()), dtype

    def _weights(self, device: torch.device) -> Weights:
        """Return the weights as float64 tensors of the whole horizon, with their graph."""
        data = self.data
        weights = Weights(
            Q=weight_matrix("Q", self.Q, data.n_y, data.horizon).to(device),
            R=weight_matrix("R", self.R, data.n_u, data.horizon).to(device),
            lambda_g=penalty("lambda_g", self.lambda_g).to(device),
            lambda_s=penalty("lambda_s", self.lambda_s).to(device),
            lambda_u=None if self.lambda_u is None else penalty("lambda_u", self.lambda_u).to(device),
            R_du=None if self.R_du is None else weight_matrix("R_du", self.R_du, data.n_u, data.horizon).to(device),
        )
        one_batch(self._batches_of(weights))
        return weights

    def _batches_of(self, weights: Weights) -> list[tuple[str, torch.Size]]:
        """Return the batch dimensions of the weights and of the data, by name."""
        batches = [(name, x.shape[: x.ndim - weights.TAILS[name]]) for name, x in weights.tensors.items()]
        if isinstance(self.data, HankelBatch):
            batches.append(("data", torch.Size([len(self.data.members)])))
        return batches

    def _factors(self, device: torch.device) -> tuple[Reduction, Any]:
        """Return the reduced problem and its solver; with a graph, which must not outlive the call, made each time."""
        weights = (self.Q, self.R, self.lambda_g, self.lambda_s, self.lambda_u, self.R_du)
        if carries_derivative((*weights, *self.data.matrices)):
            return self._factor(device)
        # The matrices of the data are constants of a frozen object: the object stands for them.
        return self._cached(("factors", device), (*weights, self._setup.of_factors), self._factor, device)

    def bounds(self, device: torch.device) -> tuple[Tensor, Tensor]:
        """Return the bounds of (u, y, du) flattened, `(N,)` or `(*batch, N)` each, float64, with their graph.

        Raises:
            ValueError: a set is no box.
        """
        setup = self._setup
        sets = setup.sets
        if not setup.is_box:
            raise ValueError("the sets of this layer are not all boxes: they have no bounds.")
        sources = tuple(bound for owner, _ in sets.parts for bound in (owner.lower, owner.upper))
        if carries_derivative(sources):
            return sets.bounds(device)
        return self._cached(("bounds", device), (*sources, sets), sets.bounds, device)

    def _cached(self, key: tuple[str, torch.device], sources: tuple[Any, ...], make: Any, *args: Any) -> Any:
        """Return what `make` makes of the sources, made anew when their values have changed."""
        entry = self._cache.get(key)
        if entry is None or not all(map(_is_same, entry[0], sources)):
            with torch.inference_mode(False), torch.no_grad(), untransformed():  # later calls may differentiate
                kept = tuple(s.detach().clone() if isinstance(s, Tensor) else s for s in sources)
                entry = self._cache[key] = (kept, make(*args))
        return entry[1]

    def _rows(self, device: torch.device) -> DataRows:
        """Return the rows of the data; weights that learn leave them alone."""
        if carries_derivative(self.data.matrices):
            return _rows_of(self.data, device, self.terms)
        terms = self.terms
        return self._cached(("rows", device), (self.data, terms), _rows_of, self.data, device, terms)

    def _factor(self, device: torch.device) -> tuple[Reduction, Solver | ConvexSolver]:
        reduction = reduce(self._rows(device), self._weights(device))
        detached, setup = reduction.detach(), self._setup
        if not setup.is_box:
            return reduction, ConvexSolver(detached, setup.sizes, setup.sets, self.on_failure)
        full = None
        if self.backward_system == "full":
            if carries_derivative((reduction.V,)) or reduction.V.ndim > 2:
                raise ValueError(
                    'backward="full" differentiates with respect to measurements and references of one problem; '
                    'use backward="reduced" for weights or data that learn, or have a batch dimension.'
                )
            if setup.terms != Terms():
                raise ValueError('backward="full" is the system of the paper\'s problem; use backward="reduced".')
            assert isinstance(self.data, HankelData)  # batches were refused with the batched reductions
            full = FullSystem(self.data, detached.weights)
        return reduction, Solver(detached, setup.sizes, self.solver, self.on_failure, full)

    def __getstate__(self) -> dict[str, Any]:
        """Leave the factors out of copies and pickles: they are made again when needed."""
        return {**self.__dict__, "_cache": {}, "_setup_cache": None}


def _nonsingular(data: HankelData | HankelBatch, solver: Any, theta: Tensor, planned: Planned) -> Tensor:
    reduction = solver.reduction
    # The part of g that the data do not see is fixed by lambda_g alone.
    fixed = (reduction.weights.lambda_g > 0) | data.spans_all.to(theta.device)
    decided = reduction.rows.Eq_range is None and not reduction.is_selection
    with torch.no_grad():
        return solver.independent(theta.detach(), planned) & fixed & decided


def _g(data: HankelData | HankelBatch, reduction: Reduction, theta: Tensor, lam: Tensor, info: Tensor) -> Tensor:
    data.require_windows()
    a = times(reduction.A_theta, theta) - times(reduction.A_lam, lam)
    g = times(basis := data.basis.to(a.device), a)
    if carries_derivative((reduction.rows.C,)):  # g = D^+ (D g), so that the data behind D are differentiated too
        D = data.stacked.to(a.device)
        g = times(torch.linalg.pinv(D, rtol=1e-10), times(D @ basis, a))
    return torch.where(info[..., :1] == Status.SOLVED, g, torch.nan)


def _rows_of(data: HankelData | HankelBatch, device: torch.device, terms: Terms) -> DataRows:
    if isinstance(data, HankelData):
        return DataRows.of(data, device, terms)
    return DataRows.stack([DataRows.of(one, device, terms) for one in data.members])


@functools.cache
def _uncompiled() -> Any:
    """`DPCLayer._call` out of the compiler's reach; made when it is there, because importing it takes a second."""
    return torch.compiler.disable(DPCLayer._call)


def _with_failures(solver: Any, on_failure: str | None) -> Any:
    if on_failure is None or on_failure == solver.on_failure:
        return solver
    check_choice("on_failure", on_failure)
    return solver.with_failures(on_failure)


def _is_same(kept: Any, now: Any) -> bool:
    """Compare values: version counters would be cheaper, but miss edits through `.data`."""
    if kept is now:  # no tensor: those are kept as copies
        return True
    if isinstance(kept, Tensor) and isinstance(now, Tensor):
        if kept.device != now.device:
            kept = kept.to(now.device)
        return kept.dtype == now.dtype and torch.equal(kept, now)
    plain = (int, float, str, tuple, Terms)
    return isinstance(kept, plain) and isinstance(now, plain) and kept == now
