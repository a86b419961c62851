"""The data-driven predictive control problem as a torch module."""

from __future__ import annotations

import os
from typing import Any

import torch
from torch import Tensor

from .checks import one_batch
from .configured import ConfiguredModule
from .data.hankel import HankelData
from .data.hankel_batch import HankelBatch
from .factors import Factored, problem_of
from .problem.compact_form import CompactForm, compact_form
from .problem.reduction import Reduction
from .saving import load_layer, save_layer
from .sets import ConvexSet, Reals
from .sets.bounds import Bounds
from .settings import check_choice
from .solution import DPCSolution, solution_of
from .solve.derivative import plan
from .solve.direct import Windows, addresses_of
from .solve.engines import Sets
from .solve.recovery import Recovery
from .tracing import batches_of, described, flat_parameters, planned_by_operator

ARGUMENTS = (  # of the constructor, by the names under which the layer keeps them
    *("Q", "R", "lambda_g", "lambda_s", "u_set", "y_set", "du_set", "R_du", "lambda_u", "regularizer", "beta_2"),
    *("slack_set", "terminal_steps", "affine", "Q_terminal", "solver", "on_failure"),
)


class DPCLayer(ConfiguredModule):
    """Plan a trajectory of the recorded system by one quadratic program, differentiably.

        minimise over u, y, g   1/2 |y - y_ref|_Q^2 + 1/2 |u - u_ref|_R^2 + lambda_g |M g|^2 + lambda_s |Yp g - y_ini|^2
        subject to              Up g = u_ini,  u = Uf g,  y = Yf g,  u in U,  y in Y,

    M = I - W^+ W, W = [Up; Yp; Uf] (Yu, Zhao, Chinchali, Topcu). The data are factored once, when they and the weights
    are first used; a call then costs a matrix product and small solves, whatever the number of recorded windows.

    Beyond the paper, each exact in the reduction and differentiable:

        regularizer="identity"   lambda_g |g|^2 in place of lambda_g |M g|^2
        regularizer="spc"        M g = 0, subspace predictive control: the limit of a large lambda_g
        regularizer="gamma"      + beta_2 |gamma_2|^2, gamma_2 the part of g that the future input adds to the past
        slack_set                Yp g - y_ini in a set, or at a price: SoftBox(0.0, 0.0, w) adds w |Yp g - y_ini|_1
        lambda_u                 lambda_u |Up g - u_ini|^2 in place of Up g = u_ini
        R_du, du_set             + 1/2 |du|_R_du^2 and du in DU, du_t = u_t - u_(t-1), from the last of u_ini on
        terminal_steps           the last outputs of the plan equal their reference
        affine                   1'g = 1, for affine systems and operating points away from zero
        Q_terminal               the weight of the last output of the plan, in place of Q

    Args:
        data: the recorded trajectories.
        Q: output weight, positive semidefinite: a number, `(n_y, n_y)`, or `(horizon n_y, horizon n_y)`.
        R: input weight, likewise.
        lambda_g: regularisation of the part of g that the past and the future input do not explain; without effect
            with `regularizer="spc"`.
        lambda_s: penalty on the mismatch of the initial output.
        u_set, y_set: constraints on every step's input and output, any :class:`ConvexSet`; `None` for none.
        du_set: constraint on every step's change of the input.
        R_du: weight of the changes of the input, given like R; `None` for none.
        lambda_u: penalty on the mismatch of the initial input; `None` where that is to be exact.
        regularizer: "projection", the paper's |M g|^2; "identity", |g|^2; "spc", where outputs are those of the
            least-squares predictor of (u_ini, Yp g, u) (Favoreel, De Moor, Gevers, "SPC: subspace predictive control",
            IFAC 1999); or "gamma" (Breschi, Chiuso, Formentin, "Data-driven predictive control in a stochastic setting:
            a unified framework", Automatica 2023), with lambda_g the weight of gamma_3, for |M g| = |gamma_3|.
        beta_2: weight of |gamma_2|^2; with `regularizer="gamma"` alone.
        slack_set: constraint or penalty on the mismatch Yp g - y_ini, beside lambda_s, for every step of the past, any
            :class:`ConvexSet`; the 1-norm is that of Coulson, Lygeros, Doerfler, "Data-enabled predictive control: in
            the shallows of the DeePC" (2019).
        terminal_steps: so many last outputs equal y_ref.
        affine: combine the recorded windows with 1'g = 1 (Berberich, Koehler, Mueller, Allgoewer, "Linear tracking MPC
            for nonlinear systems - part II: the data-driven case", 2022): the data need not be centred, and predictions
            are those of the affine system, x+ = A x + B u + c.
        Q_terminal: weight of the last output, positive semidefinite: a number or `(n_y, n_y)`; `None` for that of Q.
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
        beta_2: Any = None,
        slack_set: ConvexSet | None = None,
        terminal_steps: int = 0,
        affine: bool = False,
        Q_terminal: Any = None,
        backward: str = "reduced",
        solver: str = "auto",
        on_failure: str = "raise",
    ):
        super().__init__()
        self.data = data
        self.Q, self.R, self.lambda_g, self.lambda_s = Q, R, lambda_g, lambda_s
        self.lambda_u, self.R_du, self.Q_terminal, self.beta_2 = lambda_u, R_du, Q_terminal, beta_2
        self.u_set = Reals() if u_set is None else u_set
        self.y_set = Reals() if y_set is None else y_set
        self.du_set, self.slack_set = du_set, slack_set
        self.regularizer = regularizer
        self.terminal_steps = terminal_steps
        self.affine = affine
        self.backward_system = backward
        self.solver = solver
        self.on_failure = on_failure
        cpu = torch.device("cpu")  # bad weights and sets are reported now, not at the first call
        problem = problem_of(self._setup, self._given, cpu)
        self._factors.sets(self._setup, cpu)
        one_batch([*problem.batches, *self.feasible_set.batches(cpu)])

    def factored(self, device: torch.device) -> Factored:
        """Return the reduced problem of the present weights and its solver."""
        return self._factors.factored(self._setup, self._given, device)

    @property
    def reduction(self) -> Reduction:
        """The reduced problem of the present weights; see :mod:`torch_dpc.problem.reduction`."""
        return self.factored(self.data.device).reduction

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
        if torch.compiler.is_compiling():
            return self._traced(u_ini, y_ini, y_ref, u_ref, on_failure)
        if (sol := self._planned_directly((u_ini, y_ini, u_ref, y_ref), on_failure)) is not None:
            return sol
        theta, dtype = self.flatten(u_ini, y_ini, y_ref, u_ref)
        return self._plan(theta, self.present_sets(theta.device), dtype, on_failure)

    def _planned_directly(self, windows: Windows, on_failure: str | None) -> DPCSolution | None:
        """Plan one sample from its windows; None if the direct way does not serve it."""
        setup = self._setup
        addresses = addresses_of(windows, setup.windows)
        ways = None if addresses is None else self._factors.direct(setup, self.__dict__, self._factored_and_sets)
        if ways is None or addresses is None:
            return None
        factored, direct = ways
        on_failure = self.on_failure if on_failure is None else check_choice("on_failure", on_failure)
        theta, planned = direct.plan(windows, addresses, on_failure)
        of = direct.solver, direct.sets, torch.float64, theta, planned
        return solution_of(Recovery(setup.data, factored.reduction, *of))

    def _factored_and_sets(self) -> tuple[Factored, Sets]:
        cpu = torch.device("cpu")
        factored, sets = self.factored(cpu), self.present_sets(cpu)
        sets.batches(cpu)  # names a parameter that does not fit
        return factored, sets

    def _traced(self, u_ini: Any, y_ini: Any, y_ref: Any, u_ref: Any, on_failure: str | None) -> DPCSolution:
        """Plan by an operator, while torch compiles or exports."""
        text, tensors = described(self) if torch.compiler.is_exporting() else ("", self.own_tensors())
        data = self.data
        batches = batches_of(data, self._given)
        theta, dtype = flat_parameters(data, u_ini, y_ini, y_ref, u_ref, batches, affine=self.affine)
        sizes = [data.horizon, data.n_u, data.n_y, self.sizes.more]
        on_failure = self.on_failure if on_failure is None else on_failure
        return planned_by_operator(theta, tensors, self._handle, text, on_failure, sizes, dtype)

    def present_sets(self, device: torch.device) -> Sets:
        """Return the sets with their present parameters, as a solve takes them."""
        return self._factors.sets(self._setup, device)

    def plan(
        self,
        theta: Tensor,
        lower: Tensor,
        upper: Tensor,
        *,
        dtype: torch.dtype = torch.float64,
        on_failure: str | None = None,
    ) -> DPCSolution:
        """Plan for flattened parameters and bounds of one's own, if the sets of the layer are boxes.

        Args:
            theta: (u_ini, y_ini, u_ref, y_ref) flattened, `(*batch, n_theta)`, float64.
            lower, upper: bounds of (u, y, du, slack) flattened, `(N,)` or one a sample, float64.
            dtype: of the plan.
            on_failure: in place of the layer's own.
        """
        return self._plan(theta, Bounds(lower, upper), dtype, on_failure)

    def _plan(self, theta: Tensor, sets: Sets, dtype: torch.dtype, on_failure: str | None) -> DPCSolution:
        factored = self.factored(theta.device)
        batches = sets.batches(theta.device)
        if batches or factored.reduction.V.ndim > 2:
            one_batch([("the samples", theta.shape[:-1]), *factored.problem.batches, *batches])
        on_failure = self.on_failure if on_failure is None else check_choice("on_failure", on_failure)
        planned = plan(factored.solver, theta, factored.reduction, sets, on_failure)
        return solution_of(Recovery(self._setup.data, factored.reduction, factored.solver, sets, dtype, theta, planned))

    @property
    def has_bounds(self) -> bool:
        """Whether every set is a box, so that the layer has :meth:`bounds`."""
        return isinstance(self._factors.sets(self._setup, self.data.device), Bounds)

    def bounds(self, device: torch.device) -> tuple[Tensor, Tensor]:
        """Return the bounds of (u, y, du, slack) flattened, `(N,)` or `(*batch, N)` each, float64, with their graph.

        Raises:
            ValueError: a set is no box.
        """
        sets = self._factors.sets(self._setup, device)
        if not isinstance(sets, Bounds):
            raise ValueError("the sets of this layer are not all boxes: they have no bounds.")
        return sets.tensors

    def compact_form(self, u_ini: Any, y_ini: Any, *, y_ref: Any = None, u_ref: Any = None) -> CompactForm:
        """Return the problem as the paper writes it, minimise 1/2 z'Pz + q'z subject to H z = b, z in D.

        The arguments are those of the call. P is `(n, n)`, q `(*batch, n)`, H `(m, n)`, b `(*batch, m)`, float64.
        """
        theta, _ = self.flatten(u_ini, y_ini, y_ref, u_ref)
        weights = problem_of(self._setup, self._given, theta.device).weights
        data = self._setup.data
        if weights.are_batched or isinstance(data, HankelBatch):
            raise ValueError("`compact_form` takes one problem; the weights or the data have a batch dimension.")
        for name, rows in (("du_set", "changes of the input"), ("slack_set", "Yp g - y_ini")):
            if getattr(self, name) is not None:
                raise ValueError(f"`compact_form` has no rows for {rows}; leave out `{name}`.")
        return compact_form(data, weights, theta, self.terms)

    def config(self) -> dict[str, Any]:
        """Return the arguments of the constructor beyond the data, as they are now."""
        return {name: getattr(self, name) for name in ARGUMENTS} | {"backward": self.backward_system}

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
        return load_layer(cls, path)
