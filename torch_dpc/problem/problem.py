"""The DPC problem of a layer, whole: data, weights, sets and terms.

minimise over u, y, g   1/2 |y - y_ref|_Q^2 + 1/2 |u - u_ref|_R^2 + lambda_g |M g|^2 + lambda_s |Yp g - y_ini|^2
subject to              Up g = u_ini,  u = Uf g,  y = Yf g,  u in U,  y in Y
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from ..autodiff import carries_derivative
from ..data.hankel import HankelData
from ..data.hankel_batch import HankelBatch
from ..sets.feasible import FeasibleSet
from .projected_kkt import FullSystem
from .reduction import Reduction
from .rows import DataRows
from .terms import Sizes, Terms
from .weights import Weights


@dataclass(frozen=True, eq=False)
class Problem:
    """The problem for any measurements and references.

    Attributes:
        data: the recorded trajectories, or a batch of them.
        weights: of the whole horizon, with their graph.
        sets: all sets of the problem as one.
        terms: what the problem has beyond the paper's terms.
    """

    data: HankelData | HankelBatch
    weights: Weights
    sets: FeasibleSet
    terms: Terms

    @property
    def sizes(self) -> Sizes:
        """The sizes of the parts of theta and of v."""
        return Sizes.of(self.data, self.terms)

    @property
    def batches(self) -> list[tuple[str, torch.Size]]:
        """The batch dimensions of the weights and of the data, by name."""
        weights = self.weights
        found = [(name, x.shape[: x.ndim - weights.TAILS[name]]) for name, x in weights.tensors.items()]
        if isinstance(self.data, HankelBatch):
            found.append(("data", torch.Size([len(self.data.members)])))
        return found

    def full_system(self, reduction: Reduction, weights: Weights) -> FullSystem:
        """Return the paper's projected KKT system.

        Args:
            reduction: of this problem, with its graph.
            weights: of this problem, without a graph.

        Raises:
            ValueError: weights or data that learn or have a batch dimension, or terms that the paper does not have.
        """
        if carries_derivative((reduction.V,)) or reduction.V.ndim > 2:
            raise ValueError(
                'backward="full" differentiates with respect to measurements and references of one problem; '
                'use backward="reduced" for weights or data that learn, or have a batch dimension.'
            )
        if self.terms != Terms():
            raise ValueError('backward="full" is the system of the paper\'s problem; use backward="reduced".')
        assert isinstance(self.data, HankelData)  # batches were refused with the batched reductions
        return FullSystem(self.data, weights, self.sets.structure_key is None)


def rows_of(data: HankelData | HankelBatch, device: torch.device, terms: Terms) -> DataRows:
    """Return the rows of one data set, or of each of a batch; a graph behind the data is kept."""
    if isinstance(data, HankelData):
        return DataRows.of(data, device, terms)
    return DataRows.stack([DataRows.of(one, device, terms) for one in data.members])
