"""What `import torch_dpc` loads: little beyond torch, and no warning."""

import subprocess
import sys

import pytest

#: Libraries that take long to load and are needed for single functions only.
HEAVY = (
    "clarabel",
    "control",
    "cvxpy",
    "gymnasium",
    "matplotlib",
    "networkx",
    "pandas",
    "pybullet",
    "rich",
    "safetensors",
    "scipy.integrate",
    "scipy.linalg",
    "scipy.optimize",
    "scipy.sparse",
    "sympy",
    "torch._dynamo",
    "typer",
)
LOADED = f"import sys; print([name for name in {HEAVY!r} if name in sys.modules])"
#: A layer with sets, a batch whose shapes have to be broadcast, a gradient, and a plan in a curved set.
FIRST_PLAN = """
import torch
import torch_dpc as dpc

u = torch.rand(60, 1, generator=torch.Generator().manual_seed(0)) - 0.5
data = dpc.HankelData.from_trajectories(u, u.cumsum(0) - u, t_ini=2, horizon=5)
layer = dpc.DPCLayer(data, Q=1.0, R=0.1, lambda_g=1.0, lambda_s=1e3, u_set=dpc.Box(torch.tensor([-0.3]), 0.3))
windows = torch.zeros(3, 1, 2, 1, requires_grad=True)
layer(torch.zeros(4, 2, 1), windows, y_ref=torch.ones(1)).u.sum().backward()
curved = dpc.DPCLayer(data, Q=1.0, R=0.1, lambda_g=1.0, lambda_s=1e3, u_set=dpc.Ball(0.3))
curved(torch.zeros(2, 1), torch.zeros(2, 1), y_ref=torch.ones(1))
"""


def run(code, *flags):
    command = [sys.executable, *flags, "-c", code]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=True).stdout.strip()


def test_nothing_heavy_is_imported():
    assert run(f"import torch_dpc; {LOADED}") == "[]"


def test_the_first_plan_does_not_import_what_it_does_not_need():
    """`torch.broadcast_shapes` imports sympy, which takes a second."""
    heavy = eval(run(FIRST_PLAN + LOADED))
    assert not {"sympy", "scipy.optimize", "scipy.integrate", "matplotlib", "torch._dynamo"} & set(heavy), heavy


def test_the_import_warns_of_nothing():
    run("import torch_dpc", "-W", "error")


#: What 0.3 s are of torch's own import (0.8 s) on an idle machine: other processes slow both down alike.
SHARE = 0.37
BOTH = """
import time
start = time.process_time(); import torch
between = time.process_time(); import torch_dpc
print(between - start, time.process_time() - between)
"""


@pytest.mark.slow
def test_the_import_is_short():
    """At most 0.3 s beyond torch, or that share of torch's own import: processor time, the least of five."""
    times = [tuple(map(float, run(BOTH).split())) for _ in range(5)]
    assert min(own for _, own in times) < 0.3 or min(own / of_torch for of_torch, own in times) < SHARE, times
