"""Record four_tanks.csv, the recording of the tutorial: two hours of the quadruple-tank process.

    python docs/tutorials/record_four_tanks.py
"""

from pathlib import Path

import numpy as np
import torch

import torch_dpc as dpc

if __name__ == "__main__":
    generator = torch.Generator().manual_seed(0)
    plant = dpc.systems.FourTanks(dt=10.0, measurement_noise=0.02, generator=generator)
    u, y = dpc.collect(plant, steps=720, generator=generator, offset=3.0, amplitude=0.6, hold=3)
    time = 10.0 * np.arange(len(u))[:, None]
    np.savetxt(
        Path(__file__).with_name("four_tanks.csv"),
        np.hstack([time, u, y]),
        delimiter=",",
        header="time_s,v1,v2,h1,h2",
        comments="",
        fmt=["%.0f", "%.4f", "%.4f", "%.3f", "%.3f"],
    )
