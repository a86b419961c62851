"""What a layer computes from its settings and weights, each remembered until its sources change.

    rows        the rows of the data in their own row space; weights that learn leave them alone
    sets        the sets as a solve takes them
    factored    the reduced problem of the present weights, and its solver

What carries a graph is made anew at every call, because a graph must not outlive the call it belongs to.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from .autodiff import carries_derivative, only_backward, untransformed
from .checks import one_batch
from .problem.problem import Problem, rows_of
from .problem.reduction import Reduction, reduce
from .problem.rows import DataRows
from .problem.terms import Terms
from .problem.weights import Weights, output_weight, penalty, weight_matrix
from .settings import GivenWeights, Setup, watch_of
from .solve.direct import Direct
from .solve.engines import Sets
from .solve.solver import Solver
from .watch import Watch


@dataclass(frozen=True, eq=False)
class Factored:
    """A problem with present weights, reduced.

    Attributes:
        problem: data, weights, sets and terms.
        reduction: the reduced problem, with its graph.
        solver: of the same numbers, without a graph.
    """

    problem: Problem
    reduction: Reduction
    solver: Solver


@dataclass(frozen=True, eq=False)
class Ready:
    """The direct way of a layer, with what it was made from.

    Attributes:
        setup: the settings behind it.
        watch: their parameters; None if they cannot be watched.
        ways: the factored problem and single plans of it; None if they are not made yet, or there is no direct way.
        is_made: whether somebody has tried to make them.
    """

    setup: Setup
    watch: Watch | None
    ways: tuple[Factored, Direct] | None = None
    is_made: bool = False

    @property
    def is_current(self) -> bool:
        """Whether the parameters are what they were."""
        return self.watch is None or self.watch.is_unchanged()


class Factors:
    """The memory of one layer."""

    def __init__(self) -> None:
        self._kept: dict[tuple[str, torch.device], tuple[tuple[Any, ...], Any]] = {}
        self._ready: Ready | None = None

    def direct(
        self, setup: Setup, held: dict[str, Any], make: Callable[[], tuple[Factored, Sets]]
    ) -> tuple[Factored, Direct] | None:
        """Return the factored problem and single plans of it; None if there is no direct way for the present values.

        Args:
            setup: what follows from the settings.
            held: the dictionary of the layer.
            make: makes the factored problem and the sets on the CPU.
        """
        if not only_backward():
            return None
        kept = self._ready
        if kept is None or kept.setup is not setup or not kept.is_current:
            kept = self._ready = Ready(setup, watch_of(held, setup))
        if kept.watch is None or kept.watch.requires_grad():
            return None
        if not kept.is_made:
            factored, sets = make()
            direct = Direct.of(factored.solver, sets, setup.windows)
            kept = Ready(setup, kept.watch, None if direct is None else (factored, direct), is_made=True)
            self._ready = kept
        return kept.ways

    def __len__(self) -> int:
        """Return how many results are remembered."""
        return len(self._kept)

    def factored(self, setup: Setup, given: GivenWeights, device: torch.device) -> Factored:
        """Return the reduced problem and its solver.

        Raises:
            ValueError: bad weights, or settings that do not go together.
        """
        if carries_derivative((*given, *setup.data.matrices)):
            return self._factor(setup, given, device)
        # The matrices of the data are constants of a frozen object: the object stands for them.
        sources = (*given, setup.of_factors)
        kept: Factored | None = self._recall("factored", device, sources)
        if kept is None:
            with torch.inference_mode(False), torch.no_grad(), untransformed():  # later calls may differentiate
                kept = self._keep("factored", device, sources, self._factor(setup, given, device))
        return kept

    def sets(self, setup: Setup, device: torch.device) -> Sets:
        """Return the sets with their present parameters.

        Raises:
            ValueError: parameters that do not describe a set, or do not fit.
        """
        parameters = setup.sets.sources
        if parameters is None or carries_derivative(parameters):
            return setup.sets.for_solve(device)
        sources = (*parameters, setup.sets)
        kept: Sets | None = self._recall("sets", device, sources)
        if kept is None:
            with torch.inference_mode(False), torch.no_grad(), untransformed():
                kept = self._keep("sets", device, sources, setup.sets.for_solve(device))
        return kept

    def _rows(self, setup: Setup, device: torch.device) -> DataRows:
        if carries_derivative(setup.data.matrices):
            return rows_of(setup.data, device, setup.terms)
        sources = (setup.data, setup.terms)
        kept: DataRows | None = self._recall("rows", device, sources)
        if kept is None:
            with torch.inference_mode(False), torch.no_grad(), untransformed():
                kept = self._keep("rows", device, sources, rows_of(setup.data, device, setup.terms))
        return kept

    def _factor(self, setup: Setup, given: GivenWeights, device: torch.device) -> Factored:
        problem = problem_of(setup, given, device)
        reduction = reduce(self._rows(setup, device), problem.weights)
        detached = reduction.detach()
        full = problem.full_system(reduction, detached.weights) if setup.backward == "full" else None
        solver = Solver(detached, setup.sizes, setup.sets.structure_key, setup.solver, full)
        return Factored(problem, reduction, solver)

    def _recall(self, name: str, device: torch.device, sources: tuple[Any, ...]) -> Any:
        """Return what was kept for these sources; None if there is nothing or a value among them has changed."""
        entry = self._kept.get((name, device))
        return entry[1] if entry is not None and all(map(_is_same, entry[0], sources)) else None

    def _keep(self, name: str, device: torch.device, sources: tuple[Any, ...], result: Any) -> Any:
        """Keep a result with copies of its sources, and return it."""
        copies = tuple(s.detach().clone() if isinstance(s, Tensor) else s for s in sources)
        self._kept[name, device] = (copies, result)
        return result


def problem_of(setup: Setup, given: GivenWeights, device: torch.device) -> Problem:
    """Return the problem with the weights as float64 tensors of the whole horizon, with their graph.

    Raises:
        ValueError: bad weights, named.
    """
    data = setup.data
    weights = Weights(
        Q=output_weight(given.Q, given.Q_terminal, data.n_y, data.horizon).to(device),
        R=weight_matrix("R", given.R, data.n_u, data.horizon).to(device),
        # Subspace predictive control has no lambda_g; coordinates that pad a batch are charged.
        lambda_g=penalty("lambda_g", 1.0 if setup.terms.regularizer == "spc" else given.lambda_g).to(device),
        lambda_s=penalty("lambda_s", given.lambda_s).to(device),
        lambda_u=None if given.lambda_u is None else penalty("lambda_u", given.lambda_u).to(device),
        R_du=None if given.R_du is None else weight_matrix("R_du", given.R_du, data.n_u, data.horizon).to(device),
        beta_2=None if given.beta_2 is None else penalty("beta_2", given.beta_2).to(device),
    )
    problem = Problem(data, weights, setup.sets, setup.terms)
    one_batch(problem.batches)
    return problem


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
