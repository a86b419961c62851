"""What runs in closed loop leave."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from .. import plot
from ..autodiff import register_fields
from ..errors import Status

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False)
class ClosedLoopLog:
    """A run in closed loop, or a batch of runs; float64.

    Attributes:
        t: time [s], `(steps,)`; 0 is the first step under control.
        u: inputs applied, `(*batch, steps, n_u)`.
        y: true outputs, `(*batch, steps, n_y)`; y[k] is measured before u[k] is applied.
        y_ref: the reference, `(*batch, steps, n_y)`.
        p: what was added to y_ini at the plan in force, `(*batch, steps, t_ini, n_y)`.
        status: of the plan in force, a :class:`torch_dpc.Status`, `(*batch, steps)`.
        replanned: whether the plan in force was made at this step, boolean, `(*batch, steps)`.
        alarm: whether the detector alarmed at the window of the plan in force, boolean, `(*batch, steps)`.

    `log[i]` is one run of a batch.
    """

    t: Tensor
    u: Tensor
    y: Tensor
    y_ref: Tensor
    p: Tensor
    status: Tensor
    replanned: Tensor
    alarm: Tensor

    @property
    def batch(self) -> torch.Size:
        """Shape of the runs; empty for a single one."""
        return self.status.shape[:-1]

    @property
    def steps(self) -> int:
        """Steps of each run."""
        return len(self.t)

    def __len__(self) -> int:
        if not self.batch:
            raise TypeError("this log is a single run, which has no length; its number of steps is `log.steps`.")
        return self.batch[0]

    def __getitem__(self, index: Any) -> ClosedLoopLog:
        """Return some runs of a batch.

        Raises:
            IndexError: a single run, or an index beyond the batch.
        """
        if not self.batch:
            raise IndexError("this log is a single run; index its fields, log.y[k] for instance, for a step.")
        if isinstance(index, tuple) and len(index) > len(self.batch):
            raise IndexError(f"the runs have shape {tuple(self.batch)}, got an index of {len(index)} dimensions.")
        return self._with(lambda x: x[index])

    def detach(self) -> ClosedLoopLog:
        """Return the same log without graph."""
        return self._with(lambda x: x.detach())

    def to(self, *args: Any, **kwargs: Any) -> ClosedLoopLog:
        """Return the log on another device or in another precision, like :meth:`torch.Tensor.to`.

        The precision of `status` and `replanned` stays.
        """
        t = self.t.to(*args, **kwargs)
        moved = self._with(lambda x: x.to(t) if x.is_floating_point() else x.to(t.device))
        return replace(moved, t=t)

    def summary(self) -> RunSummary:
        """Return tracking errors, inputs, perturbations and failures in a few numbers a run."""
        error = (self.y - self.y_ref).detach().abs()
        return RunSummary(
            mean_error=error.mean(-2),
            largest_error=error.amax(-2),
            last_error=error[..., -1, :],
            u_min=self.u.detach().amin(-2),
            u_max=self.u.detach().amax(-2),
            largest_p=torch.linalg.vector_norm(self.p.detach().flatten(-2), dim=-1).amax(-1),
            unsolved=(self.status != Status.SOLVED).double().mean(-1),
        )

    def plot(self, axes: Any = None, **options: Any) -> Figure:
        """Draw the run, or the batch of runs, against time: :func:`torch_dpc.plot.log`."""
        return plot.log(self, axes, **options)

    def to_pandas(self) -> Any:
        """Return a table with one row a step, indexed by time, or by (run, time) for a batch.

        Columns: u0, u1, ..., y0, ..., y_ref0, ..., p (the Euclidean norm) and status.

        Raises:
            ImportError: pandas is missing.
        """
        try:
            import pandas
        except ImportError as error:
            raise ImportError("`to_pandas` needs pandas: pip install 'torch_dpc[pandas]'.") from error
        log = self.detach()
        columns = {
            f"{name}{i}": values[..., i].reshape(-1).numpy(force=True)
            for name, values in (("u", log.u), ("y", log.y), ("y_ref", log.y_ref))
            for i in range(values.shape[-1])
        }
        columns["p"] = torch.linalg.vector_norm(log.p.flatten(-2), dim=-1).reshape(-1).numpy(force=True)
        columns["status"] = log.status.reshape(-1).numpy(force=True)
        t = log.t.numpy(force=True)
        if not self.batch:
            return pandas.DataFrame(columns, index=pandas.Index(t, name="t"))
        runs = range(self.batch.numel())
        return pandas.DataFrame(columns, index=pandas.MultiIndex.from_product([runs, t], names=["run", "t"]))

    def _with(self, change: Any) -> ClosedLoopLog:
        """Return the log with every field but the time changed."""
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        return replace(self, **{n: change(x) for n, x in values.items() if n != "t" and isinstance(x, Tensor)})

    def __repr__(self) -> str:
        runs = f"{tuple(self.batch)} runs, " if self.batch else ""
        dt = float(self.t[1] - self.t[0]) if self.steps > 1 else float("nan")
        summary = self.summary()
        counts = {status: int((self.status == status).sum()) for status in Status}
        return (
            f"ClosedLoopLog({runs}{self.steps} steps of {dt:g} s, n_u={self.u.shape[-1]}, n_y={self.y.shape[-1]}; "
            f"mean |y - y_ref| {float(summary.mean_error.mean()):.3g}, "
            f"{100 * float(summary.unsolved.mean()):.3g} % of the steps without a plan of their own,\n    "
            f"u in {_range(self.u)}, y in {_range(self.y)}, largest |p| {float(summary.largest_p.max()):.3g}, "
            f"status: {', '.join(f'{counts[s]} {s.name}' for s in Status if counts[s])})"
        )


def _range(x: Tensor) -> str:
    return f"[{float(x.detach().min()):.4g}, {float(x.detach().max()):.4g}]"


register_fields(ClosedLoopLog)


@dataclass(frozen=True, eq=False)
class RunSummary:
    """A run in a few numbers, `(*batch, ...)`.

    Attributes:
        mean_error, largest_error, last_error: of |y - y_ref| over the run, `(*batch, n_y)`.
        u_min, u_max: inputs, `(*batch, n_u)`.
        largest_p: largest Euclidean norm of the perturbation of a window, `(*batch,)`.
        unsolved: share of the steps under a problem that had no solution, `(*batch,)`.
    """

    mean_error: Tensor
    largest_error: Tensor
    last_error: Tensor
    u_min: Tensor
    u_max: Tensor
    largest_p: Tensor
    unsolved: Tensor

    def __str__(self) -> str:
        """Return a table; of a batch the median and the worst run."""
        lines = [f"{'':16}{'median':>12}{'worst':>12}" if self.unsolved.ndim else f"{'':16}{'value':>12}"]
        for f in fields(self):
            values = getattr(self, f.name)
            per_channel = f.name not in ("largest_p", "unsolved")
            channels = values.reshape(-1, values.shape[-1]).unbind(-1) if per_channel else [values.reshape(-1)]
            for i, runs in enumerate(channels):
                label = f"{f.name}[{i}]" if per_channel else f.name
                worst = runs.min() if f.name == "u_min" else runs.max()
                cells = [runs.median(), worst] if self.unsolved.ndim else [runs[0]]
                lines.append(f"{label:16}" + "".join(f"{float(cell):12.4g}" for cell in cells))
        return "\n".join(lines)
