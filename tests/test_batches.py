"""A batch of data sets, alone and with a batch of weights: what each problem gives by itself."""

import pytest
import torch

import torch_dpc as dpc
from helpers import SMALL, Y_REF, central, delayed_data, masses_data, randn, relative, small_data, windows

EXACT = 1e-10
#: The noise-free members have one rank, the noisy one another: the shorter row spaces are padded.
MIXED = [0.0, 1e-2, 0.0]
DIFFERENCES = 1e-6
OF_DATA = 1e-4  # through M


def members(noises=MIXED):
    return [small_data(noise, seed=seed) for seed, noise in enumerate(noises)]


def inputs(n=3):
    u_ini, y_ini = windows(n, 3, seed=1, scale=0.5)
    return 0.3 * u_ini, y_ini + 0.05 * randn(n, 3, 4, seed=2)


SETS = {
    "box": {"u_set": dpc.Box(-0.4, 0.4)},
    "ball": {"u_set": dpc.Ball(0.5)},
    "rates": {"u_set": dpc.Box(-0.4, 0.4), "du_set": dpc.Box(-0.3, 0.3), "R_du": 0.5},
    "slack, terminal": {"lambda_u": 20.0, "terminal_steps": 1, "regularizer": "identity"},
}


@pytest.mark.parametrize("case", SETS)
@pytest.mark.parametrize("noises", [MIXED, [1e-2] * 3], ids=["mixed ranks", "one rank"])
def test_a_batch_is_its_members(case, noises):
    data, (u_ini, y_ini) = members(noises), inputs()
    many = dpc.DPCLayer(dpc.HankelBatch(data), **SMALL, **SETS[case])(u_ini, y_ini, y_ref=Y_REF)
    crossed = dpc.DPCLayer(dpc.HankelBatch(data), **SMALL, **SETS[case])(u_ini[:, None], y_ini[:, None], y_ref=Y_REF)
    assert crossed.u.shape == (3, 3, 6, 2)
    for i, one in enumerate(data):
        alone = dpc.DPCLayer(one, **SMALL, **SETS[case])(u_ini, y_ini, y_ref=Y_REF)
        for name in ("u", "y", "lam", "g"):
            assert relative(getattr(many, name)[i], getattr(alone, name)[i]) < EXACT
            assert relative(getattr(crossed, name)[:, i], getattr(alone, name)) < EXACT
        assert int(many.info.n_active[i]) == int(alone.info.n_active[i])
        assert bool(many.info.nonsingular[i]) == bool(alone.info.nonsingular[i])


@pytest.mark.parametrize("case", ["box", "ball"])
def test_gradients_reach_measurements_weights_and_data(case):
    u_ini, y_ini = inputs(2)
    plant, source = dpc.systems.OscillatingMasses(), torch.Generator().manual_seed(0)
    recordings = [dpc.collect(plant, 90, generator=source) for _ in range(2)]
    noise = 1e-2 * randn(90, 4, seed=9)
    weights = randn(2, 6, 2, seed=5), randn(2, 6, 4, seed=6)

    def scalar(y_ini, Q, y0):
        data = [
            dpc.HankelData.from_trajectories(u, y, t_ini=3, horizon=6)
            for u, y in ((recordings[0][0], y0), (recordings[1][0], recordings[1][1] + noise))
        ]
        options = {**SMALL, "Q": torch.diag_embed(Q), **SETS[case]}
        sol = dpc.DPCLayer(dpc.HankelBatch(data), **options)(u_ini, y_ini, y_ref=Y_REF)
        return sum((w * x).sum() for w, x in zip(weights, (sol.u, sol.y), strict=True))

    point = [y_ini, torch.tensor([[10.0, 8.0, 3.0, 1.0], [1.0, 2.0, 3.0, 4.0]]).double(), recordings[0][1] + noise]
    for i, (value, tolerance) in enumerate(zip(point, (DIFFERENCES, DIFFERENCES, OF_DATA), strict=True)):
        x = value.clone().requires_grad_()
        scalar(*point[:i], x, *point[i + 1 :]).backward()
        if i < 2:
            expected = central(lambda x, i=i: scalar(*point[:i], x, *point[i + 1 :]), value, 1e-6)
            assert relative(x.grad, expected) < tolerance
        else:  # one direction of the recording
            direction = randn(*value.shape, seed=11)
            ahead, behind = (scalar(*point[:i], value + s * 1e-6 * direction) for s in (1, -1))
            assert relative((x.grad * direction).sum(), (ahead - behind) / 2e-6) < tolerance


def test_a_batch_of_data_meets_a_batch_of_weights():
    data, (u_ini, y_ini) = members(), inputs()
    sweep = torch.tensor([0.1, 1.0, 10.0], dtype=torch.float64)
    options = {**SMALL, "u_set": dpc.Box(-0.4, 0.4)}
    many = dpc.DPCLayer(dpc.HankelBatch(data), **{**options, "lambda_g": sweep})(u_ini, y_ini, y_ref=Y_REF)
    for i, one in enumerate(data):
        alone = dpc.DPCLayer(one, **{**options, "lambda_g": float(sweep[i])})(u_ini[i], y_ini[i], y_ref=Y_REF)
        assert relative(many.u[i], alone.u) < EXACT


def test_a_member_without_a_solution_leaves_the_others_alone():
    data = [delayed_data(), delayed_data(seed=3)]
    layer = dpc.DPCLayer(
        dpc.HankelBatch(data), Q=1.0, R=0.1, lambda_g=1.0, lambda_s=1e3, on_failure="nan",
        y_set=dpc.Box(torch.tensor([-0.3, -0.5]), torch.tensor([0.3, 0.5])),
    )  # fmt: skip
    u_ini = torch.zeros(2, 3, 1, dtype=torch.float64)
    u_ini[1, -1] = 0.7
    status = layer(u_ini, torch.zeros(2, 3, 2, dtype=torch.float64)).info.status
    assert status.tolist() == [dpc.Status.SOLVED, dpc.Status.INFEASIBLE]


def test_bad_batches_are_named(tmp_path):
    with pytest.raises(ValueError, match="one HankelData or more"):
        dpc.HankelBatch([])
    with pytest.raises(ValueError, match="alike in"):
        dpc.HankelBatch([small_data(), masses_data(1e-2)])
    layer = dpc.DPCLayer(dpc.HankelBatch(members()), **SMALL)
    u_ini, y_ini = inputs()
    with pytest.raises(ValueError, match="takes one problem"):
        layer.compact_form(u_ini[0], y_ini[0])
    with pytest.raises(ValueError, match="cannot be saved"):
        layer.save(tmp_path / "layer.safetensors")
