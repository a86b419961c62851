"""Gradients of a whole run, with and without checkpoints."""

import pytest
import torch

import torch_dpc as dpc
from helpers import HOLDING, Y_REF, central, generator, randn, relative, small_data, small_layer
from torch_dpc import attacks
from torch_dpc.systems import Ode, OscillatingMasses

DIFFERENCES = 1e-7
SAME = 1e-12  # of the gradient: sums in another order


class Signal:
    """An attack that is one tensor a step, `(steps, 4)`, for every sample of the window."""

    def __init__(self, p):
        self.p = p

    def __call__(self, u_ini, y_ini, *, y_ref, u_ref, generator, step):
        return self.p[step].expand_as(y_ini)


def loss(log):
    return (log.y - log.y_ref).square().sum() + 0.1 * log.u.square().sum()


def run(layer, signal, every, *, plant=None, batch=None, attack=None, source=None):
    plant = OscillatingMasses() if plant is None else plant
    attack = Signal(signal) if attack is None else attack
    return dpc.simulate(
        plant, dpc.DPCController(layer, 3), Y_REF, steps=14, u_ref=HOLDING, attack=attack, batch=batch,
        checkpoint_every=every, generator=source,
    )  # fmt: skip


def test_the_gradient_of_a_signal_against_differences():
    layer, signal = small_layer(u_set=None), (0.01 * randn(14, 4)).requires_grad_()
    (gradient,) = torch.autograd.grad(loss(run(layer, signal, None)), signal)
    assert gradient[::3].abs().amin() > 0 and not gradient[1::3].any()  # plans are made every three steps
    assert relative(gradient, central(lambda p: loss(run(layer, p, None)), signal)) < DIFFERENCES


@pytest.mark.parametrize("every", [1, 4, 14, 100])
@pytest.mark.parametrize("batch", [None, 3])
def test_checkpoints_change_neither_the_run_nor_its_gradient(every, batch):
    layer, signal = small_layer(), (0.01 * randn(14, 4)).requires_grad_()
    logs = [run(layer, signal, k, batch=batch) for k in (None, every)]
    for name in ("u", "y", "p", "status"):
        assert torch.equal(getattr(logs[0], name), getattr(logs[1], name))
    plain, bounded = (torch.autograd.grad(loss(log), signal)[0] for log in logs)
    assert relative(bounded, plain) < SAME


def test_noise_is_drawn_again_as_it_was():
    signal = (0.01 * randn(14, 4)).requires_grad_()
    gradients, states = [], []
    for every in (None, 4):
        source, noise = generator(1), generator(2)
        plant = OscillatingMasses(noise=0.01, generator=noise)
        budget = attacks.RelativeBall(0.05)

        def attack(u_ini, y_ini, *, generator, budget=budget, **rest):
            return Signal(signal)(u_ini, y_ini, generator=generator, **rest) + budget.random(y_ini.detach(), generator)

        log = run(small_layer(), signal, every, plant=plant, attack=attack, source=source)
        states.append((source.get_state(), noise.get_state(), *plant.snapshot()))
        gradients.append(torch.autograd.grad(loss(log), signal)[0])
        after = (source.get_state(), noise.get_state(), *plant.snapshot())
        assert all(map(torch.equal, states[-1], after))  # a backward pass moves neither the plant nor the noise
    assert relative(*gradients[::-1]) < SAME and all(map(torch.equal, *states))


def test_weights_learn_from_a_whole_run():
    weight = torch.nn.Parameter(torch.tensor(2.0, dtype=torch.float64))

    def of(value, every):
        layer = dpc.DPCLayer(small_data(), Q=10.0, R=1.0, lambda_g=value, lambda_s=1e3, u_set=dpc.Box(-0.5, 0.5))
        return loss(run(layer, torch.zeros(14, 4, dtype=torch.float64), every))

    for every in (None, 5):
        (gradient,) = torch.autograd.grad(of(weight, every), weight)
        assert relative(gradient, central(lambda v: of(v, None), weight)) < 1e-5


def test_a_plant_that_cannot_go_back_is_named():
    class Bare:
        n_u, n_y, dt = 2, 4, 0.1

        def __init__(self):
            self.inner = OscillatingMasses()
            self.reset, self.step = self.inner.reset, self.inner.step

    with pytest.raises(ValueError, match=r"`checkpoint_every` must be left out for Bare, which has no `snapshot\(\)`"):
        run(small_layer(), torch.zeros(14, 4), 4, plant=Bare())


def test_checkpoints_bound_the_memory():
    """A nonlinear plant of 20 small steps a step: its intermediate results are kept, or made again."""
    signal = (0.01 * randn(14, 4)).requires_grad_()
    springs = Ode(lambda x, u: torch.cat([x[..., 2:], u - x[..., :2].sin()], -1), n_x=4, n_u=2, dt=0.1, substeps=20)
    gradients = []

    def kept(every):
        storages = {}

        def pack(tensor):
            storages[tensor.untyped_storage().data_ptr()] = tensor.untyped_storage()
            return tensor

        with torch.autograd.graph.saved_tensors_hooks(pack, lambda tensor: tensor):
            log = run(small_layer(), signal, every, plant=springs, batch=20)
        gradients.append(torch.autograd.grad(loss(log), signal)[0])
        return sum(storage.nbytes() for storage in storages.values())

    assert kept(2) < kept(None) / 10 and relative(*gradients) < SAME
