"""One step of the closed loop after another."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Protocol

import torch
from torch import Tensor

from ..checks import as_data
from ..systems.plant import Port
from .controller import DPCController
from .past import Past

#: (u_ini, y_ini, *, y_ref, u_ref, generator, step) -> p.
Attack = Callable[..., Tensor]


class Detector(Protocol):
    """What judges the windows that the controller plans from, such as a `torch_dpc.detection.ConsistencyDetector`."""

    def monitor(self) -> Callable[[Tensor, Tensor], Tensor]:
        """Begin a run; return (u_ini, y_ini) -> whether the window alarms, boolean, `(*batch,)`."""


class Loop:
    """The plant, the controller, the attack, and the last `t_ini` steps of every run.

    Args:
        port: the plant.
        controller: it has been reset.
        y_refs, u_refs: references, `(*batch, >= steps + horizon, n)`.
        attack: or None.
        generator: handed to the attack.
        detector: or None.

    Attributes:
        y: the present outputs, `(*batch, n_y)`.
        p: what was added to y_ini at the plan in force, `(*batch, t_ini, n_y)`.
        alarm: whether the window of the plan in force alarmed, `(*batch,)`.
    """

    def __init__(
        self,
        port: Port,
        controller: DPCController,
        y_refs: Tensor,
        u_refs: Tensor,
        attack: Attack | None,
        generator: Any,
        detector: Detector | None = None,
    ):
        self.port, self.controller, self.attack, self.generator = port, controller, attack, generator
        self.y_refs, self.u_refs = y_refs, u_refs
        self.data = controller.layer.data
        self.alarms_at = None if detector is None else detector.monitor()
        self.past = Past(self.data.t_ini)

    @property
    def batch(self) -> torch.Size:
        """Shape of the runs."""
        return self.y.shape[:-1]

    def warm_up(self, reset: bool | Mapping[str, Any], u: Tensor) -> None:
        """Start the plant and fill the windows at a constant input, `(*batch, n_u)`."""
        self.y = self.port.start(reset, u)
        if u.shape[:-1] not in (torch.Size(()), self.batch):
            raise ValueError(f"`u_warmup` has the runs {tuple(u.shape[:-1])} in front, the plant {tuple(self.batch)}.")
        u = u.expand(*self.batch, -1)
        for _ in range(self.data.t_ini):
            self.past.append(u, self.y)
            self.y = self.port.step(u)
        self.p = torch.zeros(*self.batch, self.data.t_ini, self.data.n_y, dtype=torch.float64)
        self.alarm = torch.zeros(self.batch, dtype=torch.bool)

    def advance(self, steps: Iterable[int], progress: Callable[[int], None] | None = None) -> tuple[Tensor, ...]:
        """Return u, y, p, status, replanned and alarm of some steps, with the time before their own dimensions."""
        us, ys, ps, statuses, replanned, alarms = [], [], [], [], [], []
        for k in steps:
            ys.append(self.y)
            replanned.append(torch.tensor(self.controller.replans_now).expand(self.batch))
            us.append(self._step(k))
            ps.append(self.p)
            statuses.append(torch.as_tensor(self.controller.status))
            alarms.append(self.alarm)
            if progress is not None:
                progress(1)
        per_step = ((us, -2), (ys, -2), (ps, -3), (statuses, -1), (replanned, -1), (alarms, -1))
        return tuple(torch.stack(values, dim) for values, dim in per_step)

    def _step(self, k: int) -> Tensor:
        """Make step k and return the inputs that were applied."""
        u_ini, y_ini = self.past.windows()
        ahead = slice(k, k + self.data.horizon)
        refs = {"y_ref": self.y_refs[..., ahead, :], "u_ref": self.u_refs[..., ahead, :]}
        if self.attack is not None and self.controller.replans_now:
            self.p = self._checked(self.attack(u_ini, y_ini, **refs, generator=self.generator, step=k), y_ini)
        if self.alarms_at is not None and self.controller.replans_now:
            self.alarm = self.alarms_at(u_ini.detach(), (y_ini + self.p).detach())
        u = self.controller.step(u_ini, y_ini + self.p, **refs, alarm=self.alarm)
        self.past.append(u, self.y)
        self.y = self.port.step(u)
        return u

    @staticmethod
    def _checked(p: Any, y_ini: Tensor) -> Tensor:
        """Return what an attack adds, which a callable of one's own may have wrong."""
        p = as_data("what `attack` returns", p)
        if p.shape != y_ini.shape:
            raise ValueError(f"`attack` must return the shape of y_ini, {tuple(y_ini.shape)}, got {tuple(p.shape)}.")
        return p


def side_by_side(attacks: Sequence[Attack]) -> Attack:
    """Return one attack on a batch that asks one attack a run."""

    def attack(u_ini: Tensor, y_ini: Tensor, *, y_ref: Tensor, u_ref: Tensor, generator: Any, step: int) -> Tensor:
        if y_ini.ndim != 3 or len(attacks) != len(y_ini):
            raise ValueError(
                f"`attack` must hold one attack a run, got {len(attacks)} for runs {tuple(y_ini.shape[:-2])}."
            )

        def of(i: int, values: Tensor) -> Tensor:
            return values[i] if values.ndim > 2 else values

        return torch.stack(
            [
                one(
                    u_ini[i], y_ini[i], y_ref=of(i, y_ref), u_ref=of(i, u_ref), step=step,
                    generator=generator[i] if isinstance(generator, Sequence) else generator,
                )
                for i, one in enumerate(attacks)
            ]
        )  # fmt: skip

    return attack
