"""Attacks by a trained network, and their training: exact cases, resumed and shared runs, small runs of the script."""

import os
import signal
import subprocess
import sys
import time

import pytest
import torch

import torch_dpc as dpc
from helpers import HOLDING, Y_REF, generator, randn, relative, small_data, small_layer, windows
from torch_dpc import attacks

INSIDE = 1e-9  # what every attack promises
EXACT = 1e-12
SHARED = 1e-10  # sums in another order, through a solver whose answers agree to 1e-13, over a few steps of Adam

BUDGETS = {
    "relative": attacks.RelativeBall(0.1),
    "ball": attacks.Ball(0.3),
    "box": attacks.Box([0.1, 0.2, 0.3, 0.0]),
    "ellipsoid": attacks.Ellipsoid([0.1, 0.2, 0.3, 0.0]),
    "1-norm": attacks.L1Ball(0.3),
    "sparse": attacks.SparseBall(2, 0.1, relative=True),
    "per channel": attacks.PerChannel(attacks.RelativeBall(0.1)),
}


class Constant(torch.nn.Module):
    """A policy that answers with a parameter."""

    def __init__(self, direction):
        super().__init__()
        self.direction = torch.nn.Parameter(direction)

    def forward(self, u_ini, y_ini, y_ref, u_ref, step):
        return self.direction.expand(y_ini.shape)


def policy(seed=0, data=None, **options):
    return attacks.AttackPolicy(data or small_data(), hidden=(8, 8), generator=generator(seed), **options)


def norm(x):
    return torch.linalg.vector_norm(x, dim=(-2, -1))


# --- the map into the budget ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("budget", BUDGETS.values(), ids=BUDGETS)
@pytest.mark.parametrize("reach", [None, "support", "projection"])
def test_every_answer_is_in_its_budget(budget, reach):
    attack = attacks.PolicyAttack(policy(), budget, reach=reach)
    u_ini, y_ini = windows(40, 3, seed=1)
    y_ini[0] = 0.0
    p = attack(u_ini, y_ini, y_ref=Y_REF, u_ref=HOLDING, generator=generator(), step=3)
    assert p.shape == y_ini.shape and torch.isfinite(p).all()
    assert budget.excess(p.detach(), y_ini).max() < INSIDE
    if reach != "projection" or budget.convex:  # what is projected onto few sensors is shorter than their ball
        assert budget.excess(1.01 * p[1:].detach(), y_ini[1:]).min() > 1e-3  # it spends it: a little more is outside
    assert budget is not BUDGETS["relative"] or not p[0].any()
    p.sum().backward()
    assert all(torch.isfinite(w.grad).all() for w in attack.parameters())


@pytest.mark.parametrize("budget", BUDGETS.values(), ids=BUDGETS)
@pytest.mark.parametrize("reach", ["support", "projection"])
def test_without_a_direction_there_is_no_attack(budget, reach):
    attack = attacks.PolicyAttack(Constant(torch.zeros(3, 4).double()), budget, reach=reach)
    p = attack(*windows(2, 3, seed=1))
    assert torch.equal(p, torch.zeros_like(p))
    p.sum().backward()
    assert torch.isfinite(attack.policy.direction.grad).all()


def test_for_a_ball_it_is_the_direction_at_the_size_of_the_ball():
    d, (u_ini, y_ini) = randn(3, 4, seed=2), windows(5, 3, seed=1)
    for reach in ("support", "projection"):
        p = attacks.PolicyAttack(Constant(d), attacks.RelativeBall(0.1), reach=reach)(u_ini, y_ini)
        assert relative(p, 0.1 * norm(y_ini)[:, None, None] * d / norm(d)) < EXACT
    scale = torch.tensor([0.1, 0.2, 0.3, 0.4]).double()
    p = attacks.PolicyAttack(Constant(d), attacks.Ellipsoid(scale))(u_ini, y_ini)
    assert relative(p, (scale**2 * d / norm(scale * d)).expand(5, 3, 4)) < EXACT


def test_in_a_box_it_can_reach_every_corner_and_still_learn():
    radius = torch.tensor([0.1, 0.2, 0.3, 0.4]).double()
    sign = randn(3, 4, seed=2).sign()
    attack = attacks.PolicyAttack(Constant(sign * radius), attacks.Box(radius))
    p = attack(*windows(1, 3, seed=1))
    assert relative(p, (sign * radius)[None]) < EXACT
    attack = attacks.PolicyAttack(Constant(randn(3, 4, seed=3)), attacks.Box(radius))
    cost = randn(3, 4, seed=4)
    best = -(radius * cost.abs()).sum()  # at a corner
    optimizer = torch.optim.Adam(attack.parameters(), lr=0.05)
    for _ in range(300):
        optimizer.zero_grad()
        reached = (cost * attack(*windows(1, 3, seed=1))).sum()
        reached.backward()
        optimizer.step()
    assert reached.item() < 0.98 * best.item()


@pytest.mark.parametrize("budget", BUDGETS.values(), ids=BUDGETS)
def test_derivatives_are_those_of_differences(budget):
    u_ini, y_ini = windows(2, 3, seed=1)

    def reach(d, y):
        return attacks.PolicyAttack(torch.nn.Identity(), budget)._reach(d, y)

    free = torch.tensor([1.0, 1.0, 1.0, 0.0]).double()  # a channel that cannot be touched has no derivative to compare
    d = randn(2, 3, 4, seed=5) * free
    assert torch.autograd.gradcheck(lambda d, y: reach(d * free, y), (d.requires_grad_(), y_ini.requires_grad_()))


@pytest.mark.parametrize("batch", [(), (1,), (0,), (5,), (2, 3)], ids=str)
def test_batches(batch):
    attack = attacks.PolicyAttack(policy(), attacks.RelativeBall(0.1))
    u_ini, y_ini = windows(6, 3, seed=1)
    one = torch.stack([attack(u, y, y_ref=Y_REF, u_ref=HOLDING) for u, y in zip(u_ini, y_ini, strict=True)])
    n = int(torch.tensor(batch).prod()) if batch else 1
    p = attack(u_ini[:n].reshape(*batch, 3, 2), y_ini[:n].reshape(*batch, 3, 4), y_ref=Y_REF, u_ref=HOLDING)
    assert p.shape == (*batch, 3, 4)
    torch.testing.assert_close(p.reshape(n, 3, 4), one[:n], rtol=EXACT, atol=EXACT)


def test_single_precision_stays_single_and_inside():
    u_ini, y_ini = (w.float() for w in windows(20, 3, seed=1))
    for budget in BUDGETS.values():
        p = attacks.PolicyAttack(policy(), budget)(u_ini, y_ini)
        assert p.dtype == torch.float32 and torch.isfinite(p).all()


def test_what_a_policy_may_not_return_is_named():
    u_ini, y_ini = windows(2, 3, seed=1)
    budget = attacks.RelativeBall(0.1)
    with pytest.raises(ValueError, match="`policy` must return a direction of the shape of y_ini"):
        attacks.PolicyAttack(Flat(), budget)(u_ini, y_ini)
    with pytest.raises(ValueError, match="not finite"):
        attacks.PolicyAttack(Constant(torch.full((3, 4), torch.nan)), budget)(u_ini, y_ini)
    with pytest.raises(ValueError, match="`y_ini` must be finite"):
        attacks.PolicyAttack(policy(), budget)(u_ini, y_ini * torch.nan)
    with pytest.raises(ValueError, match="`y_ini` must have shape"):
        attacks.PolicyAttack(policy(), budget)(u_ini, y_ini[:, :2])
    with pytest.raises(ValueError, match="`reach` must be"):
        attacks.PolicyAttack(policy(), budget, reach="far")


class Flat(torch.nn.Module):
    def forward(self, u_ini, y_ini, y_ref, u_ref, step):
        return y_ini.flatten(-2)


# --- the network ------------------------------------------------------------------------------------------------------


def test_without_bounds_the_way_around_the_hidden_layers_is_algorithm_1():
    layer = small_layer(u_set=None)
    cost, target = attacks.TargetInput(torch.ones(2)), torch.ones(2).double()
    refs = {"y_ref": Y_REF, "u_ref": HOLDING}

    def gradient(u_ini, y_ini):
        y = y_ini.clone().requires_grad_()
        (0.5 * (layer(u_ini, y, **refs).u - target) ** 2).sum().backward()
        return y.grad

    u_ini, y_ini = windows(60, 3, seed=1)  # 18 + 1 unknowns a row of an affine map
    x = torch.cat([u_ini.flatten(1), y_ini.flatten(1), torch.ones(60, 1).double()], dim=1)
    rows = torch.linalg.lstsq(x, -gradient(u_ini, y_ini).flatten(1), driver="gelsd").solution
    network = attacks.AttackPolicy(layer.data, hidden=())
    with torch.no_grad():
        network.skip.weight.zero_()
        network.skip.weight[:, :18] = rows[:18].T
        network.skip.bias.copy_(rows[18])
    fresh = windows(20, 3, seed=2)
    budget = attacks.RelativeBall(0.1)
    expected = attacks.LinearizedAttack(layer, cost, budget)(*fresh, **refs)
    p = attacks.PolicyAttack(network, budget)(*fresh)
    assert relative(p, expected) < 1e-7  # the windows of the fit, nearly noise-free, are conditioned like 1e4


def test_a_shared_reference_is_a_reference_for_each():
    u_ini, y_ini = windows(5, 3, seed=1)
    y_ref, u_ref = randn(6, 4, seed=3), randn(6, 2, seed=4)
    shared = policy()(u_ini, y_ini, y_ref, u_ref)
    each = policy()(u_ini, y_ini, y_ref.expand(5, 6, 4), u_ref.expand(5, 6, 2))
    torch.testing.assert_close(shared, each, rtol=EXACT, atol=EXACT)
    torch.testing.assert_close(policy()(u_ini, y_ini), policy()(u_ini, y_ini, 0 * y_ref, 0 * u_ref))
    assert relative(shared, policy()(u_ini, y_ini)) > 1e-2


def test_the_context_is_windowed_by_the_step():
    u_ini, y_ini = windows(4, 3, seed=1)
    run = randn(20, 2, seed=3)
    network = policy(context=run, looks=6)
    steps = torch.tensor([0, 5, 17, 40])
    together = network(u_ini, y_ini, step=steps)
    for i, k in enumerate(steps.tolist()):
        ahead = run[[min(k + j, 19) for j in range(6)]]
        alone = policy(context=ahead, looks=6)(u_ini[i], y_ini[i], step=0)
        torch.testing.assert_close(together[i], alone, rtol=EXACT, atol=EXACT)
        torch.testing.assert_close(together[i], network(u_ini[i], y_ini[i], step=k), rtol=EXACT, atol=EXACT)


def test_every_channel_is_seen_at_the_size_1_whatever_its_unit():
    u_ini, y_ini = windows(50, 3, seed=1)
    run, step = randn(60, 2, seed=3), torch.arange(50)
    unit = torch.tensor([1.0, 1e3, 1e-3, 1.0]).double()  # the second output in mm, the third in km/s
    options = {"hidden": (8,), "looks": 3, "context": run}
    plain, scaled = (
        attacks.AttackPolicy.for_windows(
            small_data(), (u_ini, y * k, Y_REF * k, None, step), **options, generator=generator()
        )
        for y, k in ((y_ini, 1.0), (y_ini, unit))
    )
    z = torch.cat([part.expand(50, -1) for part in plain._parts(u_ini, y_ini, Y_REF, None, step)], dim=1) / plain.scale
    channels = z[:, 6:18].reshape(150, 4)  # of y_ini
    torch.testing.assert_close(channels.square().mean(0), torch.ones(4).double(), rtol=EXACT, atol=0)
    assert torch.equal(plain.scale[18:24], torch.ones(6).double())  # u_ref is idle
    seen = plain(u_ini, y_ini, Y_REF, None, step)
    torch.testing.assert_close(scaled(u_ini, y_ini * unit, Y_REF * unit, None, step), seen, rtol=1e-9, atol=1e-9)


def test_weights_come_from_the_generator_alone():
    torch.manual_seed(0)
    before = torch.get_rng_state()
    a, b, c = policy(1), policy(1), policy(2)
    assert torch.equal(before, torch.get_rng_state())
    assert all(map(torch.equal, a.parameters(), b.parameters()))
    assert not torch.equal(a.skip.weight, c.skip.weight)


@pytest.mark.parametrize("hidden", [(), (7,), (8, 5)], ids=str)
@pytest.mark.parametrize("context", [None, torch.ones(30, 2).double()], ids=["still", "moving"])
def test_a_state_dict_says_how_wide_the_network_is(hidden, context):
    u_ini, y_ini = windows(9, 3, seed=1)
    recorded = (u_ini, y_ini, Y_REF, HOLDING, torch.arange(9))
    options = {"hidden": hidden, "context": context, "looks": 3, "generator": generator()}
    network = attacks.AttackPolicy.for_windows(small_data(), recorded, **options)
    again = attacks.AttackPolicy.from_state_dict(small_data(), network.state_dict())
    assert torch.equal(again(*recorded), network(*recorded))


# --- training ---------------------------------------------------------------------------------------------------------

pytest.importorskip("matplotlib", reason="the scripts draw with matplotlib")
pytest.importorskip("tqdm", reason="the scripts show their progress with tqdm")
pytest.importorskip("safetensors", reason="checkpoints are safetensors")

from scripts import train_adversary
from scripts.adversary import training
from scripts.experiments.masses import Masses
from scripts.shared.command import ROOT
from scripts.shared.rows import read_rows


def test_trained_through_the_layer_it_lowers_psi_as_algorithm_1_does():
    layer, budget = small_layer(u_set=dpc.Box(-1.0, 1.0)), attacks.RelativeBall(0.1)
    cost = attacks.TargetInput(torch.zeros(2))
    refs = {"y_ref": Y_REF, "u_ref": HOLDING}
    seen, fresh = windows(300, 3, seed=1, scale=0.3), windows(200, 3, seed=2, scale=0.3)

    def lowered(attack, u_ini, y_ini):
        return cost(layer(u_ini, y_ini, **refs)) - cost(layer(u_ini, y_ini + attack(u_ini, y_ini, **refs), **refs))

    network = attacks.AttackPolicy.for_windows(
        layer.data, (*seen, Y_REF, HOLDING, 0), hidden=(16,), generator=generator(3)
    )
    attack = attacks.PolicyAttack(network, budget)
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-2)
    for _ in range(300):
        optimizer.zero_grad()
        (-lowered(attack, *seen).mean()).backward()
        optimizer.step()
    base = lowered(attacks.LinearizedAttack(layer, cost, budget), *fresh).mean()
    with torch.no_grad():
        assert lowered(attack, *fresh).mean() > 0.9 * base


def test_the_batched_loop_of_the_masses_is_simulate_and_so_is_its_derivative():
    plant = Masses()
    layer = plant.planner(5)
    starts = plant.starts(3, 7)
    network = attacks.AttackPolicy(layer.data, hidden=(8,), context=plant.context, generator=generator())
    attack = attacks.PolicyAttack(network, attacks.RelativeBall(0.05))
    y, seen = plant.loop(layer, attack, starts)
    batched = torch.autograd.grad(plant.mean_errors(y, starts).sum(), list(network.parameters()))
    error = 0.0
    for i, start in enumerate(starts):
        log = dpc.simulate(
            dpc.systems.OscillatingMasses(),
            dpc.DPCController(layer, 10),
            torch.tensor(plant.y_ref),
            steps=y.shape[1],
            u_ref=torch.tensor(plant.u_ref),
            attack=attack,
            reset={"state": start},
            u_warmup=torch.tensor(plant.u_ref),
        )
        torch.testing.assert_close(log.y, y[i], rtol=0, atol=1e-9)
        error = error + plant.mean_errors(log.y, start)
    one_by_one = torch.autograd.grad(error, list(network.parameters()))
    for a, b in zip(batched, one_by_one, strict=True):
        assert relative(a, b) < 1e-6  # rounding grows on the way back through twenty plans
    assert len(seen) == 3 * y.shape[1] and torch.equal(seen[seen.step == 10].y_ini, y[:, 4:10])


class Stopped(Exception):
    """A run that ends before its time."""


def tiny_training(path, stop_at=None):
    """Train two numbers towards noise that depends on the iteration; return them and the curve."""
    network = Constant(torch.zeros(1, 2).double())

    def loss(iteration, share):
        if iteration == stop_at:
            raise Stopped
        noise = randn(6, 2, seed=iteration)[share]
        return ((network.direction - 1 - noise) ** 2).sum() / 6

    stages = [training.Stage("first", loss, 5, 0.1, every=2), training.Stage("second", loss, 9, 0.05, 0.5, every=2)]
    curve = training.train(
        network, stages, path, settings={"seed": 0}, validate=lambda: float(network.direction.detach().sum())
    )
    return network.direction.detach(), curve


@pytest.mark.parametrize("stop_at", [1, 3, 6, 8])
def test_a_run_that_was_killed_ends_as_one_that_was_not(tmp_path, stop_at):
    whole, curve = tiny_training(tmp_path / "whole.safetensors")
    with pytest.raises(Stopped):
        tiny_training(tmp_path / "cut.safetensors", stop_at)
    resumed, its_curve = tiny_training(tmp_path / "cut.safetensors")
    assert torch.equal(whole, resumed) and torch.equal(curve, its_curve)
    assert curve[:, :2].tolist() == [[0, 2], [0, 4], [0, 5], [1, 2], [1, 4], [1, 6], [1, 8], [1, 9]]
    again, _ = tiny_training(tmp_path / "cut.safetensors", stop_at=0)  # nothing is left to do
    assert torch.equal(again, whole)


def test_checkpoints_of_other_settings_are_refused(tmp_path):
    tiny_training(tmp_path / "a.safetensors")
    with pytest.raises(ValueError, match="was made with.*--restart"):
        training.train(Constant(torch.zeros(1, 2)), [], tmp_path / "a.safetensors", settings={"seed": 1})


def test_the_learning_rate_falls_and_large_gradients_are_cut(tmp_path):
    network = Constant(torch.zeros(1, 1).double())
    stage = training.Stage("only", lambda i, share: 100.0 * network.direction.sum(), 8, rate=0.1, largest=1e-3)
    training.train(network, [stage], tmp_path / "a.safetensors", settings={})
    # Adam with a constant gradient steps by the rate itself: 0.1 (1 + cos(pi i / 8)) / 2, together 0.45
    assert float(network.direction.detach()) == pytest.approx(-0.45, rel=1e-3)  # eps over a gradient of 1e-3


def run_script(out, *more, processes=1, **options):
    """Return the command and environment of a small run of the script."""
    launch = (
        ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", str(processes)] if processes > 1 else []
    )
    command = [
        sys.executable,
        *launch,
        "-m",
        "scripts.train_adversary",
        "--quick",
        "--out",
        str(out),
        "--workers",
        "1",
    ]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    return {"args": [*command, *more], "cwd": ROOT, "env": environment, **options}


def weights(path):
    return training.policy_tensors(training.read_tensors(path)[0])


@pytest.mark.slow
def test_two_processes_train_the_network_of_one(tmp_path):
    done = subprocess.run(
        **run_script(tmp_path / "two", "--no-judging", processes=2, capture_output=True, text=True, timeout=100)
    )
    assert done.returncode == 0, done.stderr[-2000:]
    train_adversary.main(["--quick", "--no-judging", "--workers", "1", "--out", str(tmp_path / "one")])
    for mode in ("windows", "closed-loop"):
        one, two = (weights(tmp_path / n / f"adversary_masses_{mode}.safetensors") for n in ("one", "two"))
        assert one.keys() == two.keys()
        for name, tensor in one.items():
            torch.testing.assert_close(two[name], tensor, rtol=SHARED, atol=SHARED)


@pytest.mark.slow
def test_a_process_that_is_killed_goes_on_where_it_was(tmp_path, monkeypatch):
    path = tmp_path / "cut" / "adversary_masses_windows.safetensors"
    process = subprocess.Popen(**run_script(tmp_path / "cut", "--no-judging", stderr=subprocess.DEVNULL))
    deadline = time.monotonic() + 60
    while not path.exists() and time.monotonic() < deadline:
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert path.exists()
    for name in ("cut", "whole"):
        train_adversary.main(["--quick", "--no-judging", "--workers", "1", "--out", str(tmp_path / name)])
    for mode in ("windows", "closed-loop"):
        cut, whole = (weights(tmp_path / n / f"adversary_masses_{mode}.safetensors") for n in ("cut", "whole"))
        assert all(torch.equal(cut[name], whole[name]) for name in whole)


@pytest.mark.slow
def test_a_small_run_of_the_script(tmp_path):
    train_adversary.main(["--quick", "--seeds", "1", "--workers", "1", "--out", str(tmp_path)])
    rows = read_rows(tmp_path / "adversary_masses.csv")
    held_out = rows["setting"] == "held-out windows"
    base = rows["attack"] == "algorithm1"
    assert (rows["of_algorithm1"][held_out & base] == 1).all() and len(rows["rho"][held_out]) == 5 * 3
    assert set(rows["setting"][~held_out]) == {"at rest", "disturbed"} and len(rows["rho"][~held_out]) == 2 * (
        1 + 7 * 3
    )
    assert (rows["of_algorithm1"][rows["attack"] == "projected_gradient"][:3] >= 1).all()  # never worse
    for story in ("training", "windows", "loop"):
        assert (tmp_path / f"adversary_masses_{story}.png").stat().st_size > 10_000
    assert "| policy trained in closed loop |" in (tmp_path / "adversary_masses.md").read_text()


@pytest.mark.slow
def test_flights_are_recorded_the_same_by_any_number_of_processes():
    pytest.importorskip("pybullet", reason="the quadrotor flies in PyBullet")
    from scripts.experiments.quadrotor import Quadrotor

    one, two = (Quadrotor().record_windows(3, 7, workers, every_step=False) for workers in (1, 2))
    for a, b in zip(one.tensors().values(), two.tensors().values(), strict=True):
        assert torch.equal(a, b)
    assert len(one) > 7 * 20 and torch.equal(one.step % 10, torch.zeros(len(one)).long())


@pytest.mark.slow
def test_the_linear_model_of_a_recording_flies_as_pybullet_does():
    pytest.importorskip("pybullet", reason="the quadrotor flies in PyBullet")
    from scripts.experiments.closed_loops import TRAINING
    from scripts.experiments.quadrotor import Quadrotor, fly_lap

    plant = Quadrotor()
    layer, start = plant.planner(TRAINING), torch.tensor([0])
    # Within pi/8 the linear model is 13 % off under the strongest attack; docs/adversaries.md says so.
    for rho, near in zip(plant.rhos, (0.05, 0.05, 0.15), strict=True):
        attack = attacks.LinearizedAttack(layer, plant.target(), attacks.RelativeBall(rho))
        outputs, seen = plant.loop(layer, attack, start)
        log, down = fly_lap(plant, layer, attack, 0, None)
        flown = torch.linalg.vector_norm((log.y - log.y_ref)[:, :3], dim=1).mean().item()
        assert not down.any() and plant.mean_errors(outputs, start).item() == pytest.approx(flown, rel=near)
        assert torch.equal(seen[seen.step == 30].y_ref[0], log.y_ref[30:55])
