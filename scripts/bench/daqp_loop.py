"""The bar for forward: what a plain Python loop over DAQP needs, and nothing else."""

from __future__ import annotations

import daqp
import numpy as np
import torch
from torch import Tensor

import torch_dpc as dpc
from scripts.shared.rows import Array


class DaqpLoop:
    """A plain loop over DAQP with its set-up reused: the least-distance form, the bounds updated, no warm start.

    Args:
        layer: whose problem it is.
    """

    def __init__(self, layer: dpc.DPCLayer):
        reduction = layer.reduction
        self._V, self._Ct = reduction.V.numpy(), np.ascontiguousarray(reduction.Ct.numpy())
        self._lower, self._upper = (bound.numpy() for bound in layer.bounds(torch.device("cpu")))
        self._horizon = layer.data.horizon
        rows, n = self._Ct.shape
        self._model = daqp.Model()
        self._model.setup(np.eye(n), np.zeros(n), self._Ct, np.full(rows, 1e30), np.full(rows, -1e30))
        self._model.settings = {"primal_tol": 1e-10}  # the default, 1e-6, calls slightly infeasible problems solved

    def __call__(self, u_ini: Array, y_ini: Array, y_ref: Array, u_ref: Array) -> Array:
        """Return v = (u, y), `(*batch, N)`; the references with their batch dimensions and horizon."""
        parts = [x.reshape(*x.shape[:-2], -1) for x in (u_ini, y_ini, u_ref, y_ref)]
        v0 = np.concatenate(parts, axis=-1) @ self._V.T
        x = np.empty((*v0.shape[:-1], self._Ct.shape[1]))
        model, sense = self._model, np.zeros(len(self._lower), dtype=np.int32)
        bounds = self._upper - v0, self._lower - v0
        for i in np.ndindex(v0.shape[:-1]):
            rejected = model.update(bupper=bounds[0][i], blower=bounds[1][i], sense=sense)
            x[i], _, flag, _ = model.solve()
            if rejected < 0 or flag != 1:
                raise RuntimeError(f"DAQP: update {rejected}, exit flag {flag}")
        return v0 + x @ self._Ct.T

    def prepare(self, inputs: dict[str, Tensor]) -> dict[str, Array]:
        """Return the inputs as arrays with all their dimensions; not timed."""
        u_ini, y_ini = inputs["u_ini"], inputs["y_ini"]
        out = {"u_ini": u_ini, "y_ini": y_ini}
        for name, like in (("u_ref", u_ini), ("y_ref", y_ini)):
            shape = (*like.shape[:-2], self._horizon, like.shape[-1])
            out[name] = inputs.get(name, like.new_zeros(())).expand(shape)
        return {name: np.ascontiguousarray(value.numpy()) for name, value in out.items()}
