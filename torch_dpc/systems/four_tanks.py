"""The quadruple-tank process: two pumps, four tanks, and an operating point far from zero."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ..checks import as_data, check_number
from .ode import Ode

GRAVITY = 981.0  # [cm/s^2]
AREA = (28.0, 32.0, 28.0, 32.0)  # cross-sections of the tanks, A_i [cm^2]
OUTLET = (0.071, 0.057, 0.071, 0.057)  # cross-sections of the outlets, a_i [cm^2]


@dataclass(frozen=True)
class OperatingPoint:
    """The two settings of Johansson (2000), Table II, on either side of the zero that the valves move.

    Attributes:
        voltages: of the pumps, v_i [V].
        gains: of the pumps, k_i [cm^3/(V s)].
        splits: share of each pump's flow that goes to the lower tank, gamma_i.
    """

    voltages: tuple[float, float]
    gains: tuple[float, float]
    splits: tuple[float, float]


OPERATING_POINTS = {
    "minimum": OperatingPoint(voltages=(3.00, 3.00), gains=(3.33, 3.35), splits=(0.70, 0.60)),
    "nonminimum": OperatingPoint(voltages=(3.15, 3.15), gains=(3.14, 3.29), splits=(0.43, 0.34)),
}


class FourTanks(Ode):
    """The quadruple-tank process with the parameters of its paper.

    Pump 1 fills tanks 1 (lower left) and 4 (upper right), pump 2 tanks 2 and 3; the upper tanks 3 and 4 drain into the
    lower ones 1 and 2. By Torricelli's law and Bernoulli's,

        A_1 dh_1/dt = -a_1 sqrt(2 g h_1) + a_3 sqrt(2 g h_3) + gamma_1 k_1 v_1
        A_2 dh_2/dt = -a_2 sqrt(2 g h_2) + a_4 sqrt(2 g h_4) + gamma_2 k_2 v_2
        A_3 dh_3/dt = -a_3 sqrt(2 g h_3) + (1 - gamma_2) k_2 v_2
        A_4 dh_4/dt = -a_4 sqrt(2 g h_4) + (1 - gamma_1) k_1 v_1.

    The inputs are the voltages v_1, v_2 [V] and the outputs the levels of the lower tanks h_1, h_2 [cm]. A pump does
    not run backwards: a negative voltage counts as zero. After a reset the plant is at rest at the voltages of the
    operating point. Tanks do not overflow.

    Record around the operating point, `collect(plant, ..., offset=plant.voltages, amplitude=0.5)`: around 0 V the tanks
    run empty.

    Source: K. H. Johansson, "The quadruple-tank process: a multivariable laboratory process with an adjustable zero",
    IEEE Transactions on Control Systems Technology 8(3), 2000, 456-465.

    Args:
        phase: "minimum" or "nonminimum", the operating point P- or P+ of the paper: with the second the response of the
            levels to the voltages starts in the wrong direction.
        dt: sampling time [s].
        all_levels: measure all four levels instead of the lower two.
        measurement_noise: standard deviation of the noise on the levels [cm].
        generator: the source of the noise; a list holds one a run.

    Attributes:
        voltages: of the operating point, `(2,)` [V].
        x0: the levels at rest there, `(4,)` [cm].

    Example:
        >>> plant = FourTanks()
        >>> plant.reset()
        tensor([12.2629, 12.7832], dtype=torch.float64)
        >>> plant.step(plant.voltages)
        tensor([12.2629, 12.7832], dtype=torch.float64)
    """

    def __init__(
        self,
        phase: str = "minimum",
        *,
        dt: float = 5.0,
        all_levels: bool = False,
        measurement_noise: Any = 0.0,
        generator: torch.Generator | Sequence[torch.Generator] | None = None,
    ):
        if phase not in OPERATING_POINTS:
            raise ValueError(f"`phase` must be one of {', '.join(OPERATING_POINTS)}, got {phase!r}.")
        check_number("dt", dt, positive=True, kind="a positive sampling time [s]")
        point = OPERATING_POINTS[phase]
        self.phase = phase
        self._area, self._outlet = torch.tensor(AREA).double(), torch.tensor(OUTLET, dtype=torch.float64)
        self.voltages = torch.tensor(point.voltages, dtype=torch.float64)
        (k1, k2), (s1, s2) = point.gains, point.splits
        # [cm^3/s] a volt of each pump pours into each tank
        self._inflow = torch.tensor(
            [[s1 * k1, 0.0], [0.0, s2 * k2], [0.0, (1 - s2) * k2], [(1 - s1) * k1, 0.0]], dtype=torch.float64
        )
        super().__init__(
            self._rates,
            None if all_levels else lambda x, u: x[..., :2],
            n_x=4,
            n_u=2,
            n_y=4 if all_levels else 2,
            dt=dt,
            x0=self.levels_at_rest(self.voltages),
            substeps=max(1, round(dt)),  # of about a second; the time constants are 23 to 90 s
            measurement_noise=measurement_noise,
            generator=generator,
        )

    def levels_at_rest(self, voltages: Any) -> Tensor:
        """Return the levels at which constant voltages `(*batch, 2)` [V] hold the tanks, `(*batch, 4)` [cm]."""
        poured = as_data("voltages", voltages).double().clamp_min(0.0) @ self._inflow.mT
        through = poured + _into_lower(poured)
        return (through / self._outlet).square() / (2 * GRAVITY)

    def voltages_at_rest(self, levels: Any) -> Tensor:
        """Return the voltages that hold the lower tanks at levels `(*batch, 2)` [cm], `(*batch, 2)` [V].

        Raises:
            ValueError: no voltages that are positive hold the tanks there.
        """
        through = self._outlet[:2] * (2 * GRAVITY * as_data("levels", levels).double()).sqrt()
        total = self._inflow[:2] + self._inflow[2:]  # what a pump pours above a lower tank arrives in it
        voltages = torch.linalg.solve(total, through[..., None])[..., 0]
        if not bool((voltages >= 0).all()):
            raise ValueError(
                f"`levels` cannot be held with voltages of at least 0, got {levels!r}: {voltages.tolist()}."
            )
        return voltages

    def _rates(self, x: Tensor, u: Tensor) -> Tensor:
        level = x.clamp_min(0.0)
        # An empty tank has no outflow; the inner choice keeps the derivative of the root finite there.
        filled = level > 0
        speed = torch.where(filled, (2 * GRAVITY * torch.where(filled, level, 1.0)).sqrt(), 0.0)
        out = self._outlet * speed
        return (_into_lower(out) - out + u.clamp_min(0.0) @ self._inflow.mT) / self._area


def _into_lower(flow: Tensor) -> Tensor:
    """Return what flows of the four tanks mean for the lower two: tank 3 drains into 1, tank 4 into 2."""
    upper = flow[..., 2:]
    return torch.cat([upper, torch.zeros_like(upper)], dim=-1)
