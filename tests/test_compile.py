"""The layer inside compiled and exported models: no graph break, the numbers of eager."""

import subprocess
import sys

import pytest
import torch
from torch import nn

import torch_dpc as dpc
from helpers import SMALL, Y_REF, delayed_layer, delayed_windows, relative, small_data, windows

EXACT = 1e-12
BACKEND = "aot_eager"  # traces forward and backward whole; needs no compiler of C++


def parameter(value):
    return nn.Parameter(torch.as_tensor(value, dtype=torch.float64))


LAYERS = {
    "boxes": lambda: dpc.DPCLayer(small_data(), **SMALL, u_set=dpc.Box(-0.3, 0.3), y_set=dpc.Box(-0.9, 0.9)),
    "learnable": lambda: dpc.DPCLayer(
        small_data(),
        **{**SMALL, "Q": parameter(10 * torch.eye(4)), "lambda_g": parameter(2.0)},
        u_set=dpc.Box(-0.3, parameter(0.3)),
    ),
    "ball and soft box": lambda: dpc.DPCLayer(
        small_data(), **SMALL, u_set=dpc.Ball(parameter(0.4)), y_set=dpc.SoftBox(-0.2, 0.2, weight=20.0)
    ),
    "rates": lambda: dpc.DPCLayer(small_data(), **SMALL, R_du=0.1, du_set=dpc.Box(-0.2, 0.2), on_failure="nan"),
}


class Model(nn.Module):
    """A correction of the measurement, learnt through the plan."""

    def __init__(self, layer):
        super().__init__()
        self.layer = layer
        self.correction = nn.Linear(4, 4, dtype=torch.float64)
        nn.init.eye_(self.correction.weight)
        nn.init.zeros_(self.correction.bias)

    def forward(self, u_ini, y_ini, y_ref):
        plan = self.layer(u_ini, self.correction(y_ini), y_ref=y_ref)
        return plan.u, plan.y


def losses(model, run, inputs, steps=4):
    """The losses of a few steps of training."""
    optimizer = torch.optim.SGD(model.parameters(), lr=1e-3)
    found = []
    for _ in range(steps):
        optimizer.zero_grad()
        u, y = run(*inputs)
        loss = (y - 0.5).square().sum() + 0.1 * u.square().sum()
        loss.backward()
        optimizer.step()
        found.append(loss.detach())
    return torch.stack(found)


@pytest.mark.parametrize("case", LAYERS)
def test_a_compiled_model_trains_like_the_eager_one(case):
    torch._dynamo.reset()
    inputs = (*windows(3, 3, seed=1, scale=0.3), Y_REF)
    eager, compiled = Model(LAYERS[case]()), Model(LAYERS[case]())
    expected = losses(eager, eager, inputs)
    found = losses(compiled, torch.compile(compiled, fullgraph=True, backend=BACKEND), inputs)
    assert expected[0] > expected[-1] and relative(found, expected) < EXACT
    for mine, right in zip(compiled.parameters(), eager.parameters(), strict=True):
        assert right.grad is not None and relative(mine, right) < EXACT


def test_inductor_and_changing_batches():
    torch._dynamo.reset()
    model = Model(LAYERS["boxes"]())
    run = torch.compile(model, fullgraph=True, dynamic=True)
    for n in (2, 5, 3):
        inputs = (*windows(n, 3, seed=n, scale=0.3), Y_REF)
        u, y = run(*inputs)
        expected = model(*inputs)
        assert relative(u, expected[0]) < EXACT and relative(y, expected[1]) < EXACT


def test_a_compiled_plan_tells_u_y_lam_and_info_alone():
    torch._dynamo.reset()
    layer = LAYERS["boxes"]()
    inputs = windows(3, 3, seed=1, scale=0.3)
    plan = torch.compile(lambda u, y: layer(u, y, y_ref=Y_REF), fullgraph=True, backend=BACKEND)(*inputs)
    expected = layer(*inputs, y_ref=Y_REF)
    assert isinstance(plan, dpc.DPCSolution) and torch.equal(plan.info.n_active, expected.info.n_active)
    assert relative(plan.lam, expected.lam) < EXACT
    with pytest.raises(NotImplementedError, match="in a compiled or exported model"):
        plan.g  # noqa: B018


def test_failures_and_bad_input_are_told():
    torch._dynamo.reset()
    layer = LAYERS["boxes"]()
    u_ini, y_ini = windows(3, 3, seed=1, scale=0.3)
    run = torch.compile(lambda u, y: layer(u, y).u, fullgraph=True, backend=BACKEND)
    run(u_ini, y_ini)
    with pytest.raises(ValueError, match="`y_ini` must be finite"):
        run(u_ini, torch.full_like(y_ini, torch.nan))
    layer.u_set = dpc.Box(-0.01, 0.01)  # settings are those of the moment
    assert float(run(u_ini, y_ini).abs().max()) == pytest.approx(0.01, abs=1e-12)
    delayed = delayed_layer()
    run = torch.compile(lambda u, y: delayed(u, y).u, fullgraph=True, backend=BACKEND)
    with pytest.raises(dpc.InfeasibleError, match="index 1"):
        run(*delayed_windows(3, impossible=[1]))


def test_a_second_derivative_is_refused():
    torch._dynamo.reset()
    layer = LAYERS["boxes"]()
    u_ini, y_ini = windows(3, 3, seed=1, scale=0.3)
    theta, _ = layer.flatten(u_ini, y_ini, Y_REF, None)
    theta.requires_grad_()
    u = torch.ops.torch_dpc.plan(theta, layer.own_tensors(), layer._handle, "", "raise", [6, 2, 4, 0])[0]
    (bar,) = torch.autograd.grad(u.square().sum(), theta, create_graph=True)
    with pytest.raises(RuntimeError):
        bar.sum().backward()


@pytest.mark.parametrize("case", LAYERS)
def test_opcheck(case):
    layer = LAYERS[case]()
    theta, _ = layer.flatten(*windows(2, 3, seed=1, scale=0.3), Y_REF, None)
    n_du = 12 if case == "rates" else 0
    arguments = (theta.requires_grad_(), layer.own_tensors(), layer._handle, "", "raise", [6, 2, 4, n_du])
    torch.library.opcheck(torch.ops.torch_dpc.plan.default, arguments)
    u, y, lam, *_ = (x.detach() for x in torch.ops.torch_dpc.plan(*arguments))
    bars = (torch.ones_like(u), torch.zeros_like(y), torch.ones_like(lam))
    tensors = [x.detach() for x in layer.own_tensors()]
    options = (layer._handle, "", "raise", [True] * len(tensors))
    torch.library.opcheck(torch.ops.torch_dpc.adjoint.default, (theta.detach(), tensors, *bars, *options))


RUN = """
import sys, torch, torch_dpc
program, inputs = torch.export.load(sys.argv[1]).module(), torch.load(sys.argv[2])
torch.save([program(*each) for each in inputs], sys.argv[3])
"""


@pytest.mark.parametrize("case", ["boxes", "learnable", "ball and soft box"])
def test_an_exported_program_runs_in_a_fresh_process(case, tmp_path):
    model = Model(LAYERS[case]())
    inputs = [(*windows(n, 3, seed=n, scale=0.3), Y_REF) for n in (3, 5)]
    batch = torch.export.Dim("batch", min=2, max=64)
    program = torch.export.export(model, inputs[0], dynamic_shapes=({0: batch}, {0: batch}, None))
    torch.export.save(program, tmp_path / "model.pt2")
    torch.save(inputs, tmp_path / "inputs.pt")
    command = [sys.executable, "-c", RUN, *(str(tmp_path / name) for name in ("model.pt2", "inputs.pt", "out.pt"))]
    subprocess.run(command, check=True, timeout=300)
    for each, found in zip(inputs, torch.load(tmp_path / "out.pt"), strict=True):
        for mine, right in zip(found, model(*each), strict=True):
            assert relative(mine, right) < EXACT
