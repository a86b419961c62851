"""A stored flight of the quadrotor, so that tests can plan for it without PyBullet.

`python -m tests.recordings`, from the root, records it anew; the seed, the recipe and the versions are inside the file.
"""

from importlib.metadata import version
from pathlib import Path

import numpy as np
import torch

ROOT = Path(__file__).parent
FILE = ROOT / "data" / "quadrotor_recording.npz"
SEED = 0
RECIPE = (
    "dpc.collect(Quadrotor(), 530, amplitude=0.5, hold=10, feedback=lambda y: -0.3 * (y[:3] - [0, 0, 1]), "
    "generator=torch.Generator().manual_seed(0)); u: velocity commands [m/s], y: position [m] and attitude [rad]"
)


def quadrotor_recording():
    """Return the commands `(530, 3)` [m/s] and the outputs `(530, 6)` [m, rad], float64."""
    with np.load(FILE) as file:
        return torch.from_numpy(file["u"]), torch.from_numpy(file["y"])


def fly_again():
    """Return the same from the simulator."""
    from scripts.experiments.quadrotor import Quadrotor

    case = Quadrotor()
    with case.system() as plant:
        return case.record(plant, SEED)


if __name__ == "__main__":
    u, y = fly_again()
    note = ", ".join(f"{name} {version(name)}" for name in ("torch", "numpy", "pybullet"))
    FILE.parent.mkdir(exist_ok=True)
    np.savez_compressed(FILE, u=u.numpy(), y=y.numpy(), seed=SEED, recipe=RECIPE, versions=note)
    print(f"{FILE}: {FILE.stat().st_size / 1e3:.0f} kB")
