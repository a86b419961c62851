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


def of_batch(*shape):
    return torch.full(shape, 0.5, dtype=torch.float64)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"u_set": dpc.Box(-of_batch(3, 6, 2), of_batch(3, 6, 2))}, r"the samples \(2,\), lower \(3,\), upper \(3,\)"),
        ({"u_set": dpc.Ball(of_batch(3, 6))}, r"the samples \(2,\), u_set \(3,\)"),
        ({"lambda_g": of_batch(3)}, r"the samples \(2,\), lambda_g \(3,\)"),
        ({"lambda_g": of_batch(3), "u_set": dpc.Ball(1.0)}, r"the samples \(2,\), lambda_g \(3,\)"),
        ({"Q": torch.eye(4).expand(3, 4, 4)}, r"the samples \(2,\), Q \(3,\)"),
        ({"data": dpc.HankelBatch(members())}, r"the samples \(2,\), data \(3,\)"),
    ],
)
def test_samples_that_do_not_fit_a_batch_are_named(change, says):
    layer = dpc.DPCLayer(**{"data": small_data(), **SMALL, **change})
    with pytest.raises(ValueError, match="the batch shapes must broadcast, got " + says):
        layer(*inputs(2))
    assert layer(*inputs(3)).u.shape == (3, 6, 2)
    repr(layer)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"Q": torch.eye(4).expand(2, 4, 4), "lambda_g": of_batch(3)}, r"Q \(2,\), lambda_g \(3,\)"),
        ({"data": dpc.HankelBatch(members()), "lambda_u": of_batch(2)}, r"lambda_u \(2,\), data \(3,\)"),
        ({"u_set": dpc.Ball(of_batch(3, 6)), "lambda_s": of_batch(2)}, r"lambda_s \(2,\), u_set \(3,\)"),
        ({"u_set": dpc.Ball(of_batch(3, 6)), "y_set": dpc.Ball(of_batch(2, 6))}, r"u_set \(3,\), y_set \(2,\)"),
        ({"u_set": dpc.Box(-of_batch(3, 6, 2), 1.0), "y_set": dpc.Box(-of_batch(2, 6, 4), 1.0)}, r"u_set .*y_set"),
    ],
)
def test_batches_that_do_not_fit_each_other_are_told_at_construction(change, says):
    with pytest.raises(ValueError, match="the batch shapes must broadcast, got " + says):
        dpc.DPCLayer(**{"data": small_data(), **SMALL, **change})


def test_data_sets_of_different_lengths_plan_but_have_no_one_g():
    data = [small_data(), masses_data(1e-2, steps=120, t_ini=3, horizon=6), small_data(0.0)]
    layer, (u_ini, y_ini) = dpc.DPCLayer(dpc.HankelBatch(data), **{**SMALL, "lambda_g": 0.0}), inputs()
    plan = layer(u_ini, y_ini, y_ref=Y_REF)
    alone = [dpc.DPCLayer(one, **{**SMALL, "lambda_g": 0.0}) for one in data]
    plans = [one(u_ini[i], y_ini[i], y_ref=Y_REF) for i, one in enumerate(alone)]
    assert plan.info.nonsingular.tolist() == [bool(one.info.nonsingular) for one in plans]
    assert "reduced_kkt_size=36" in repr(layer) and "full_kkt_size" not in repr(layer)
    with pytest.raises(ValueError, match="different numbers of windows, .112, 142.: there is no one g"):
        plan.g  # noqa: B018
    with pytest.raises(ValueError, match="there is no one g"):
        layer.full_kkt_size  # noqa: B018


@pytest.mark.parametrize("what", [None, 3, small_data(), [small_data(), None], []], ids=lambda w: type(w).__name__)
def test_what_is_no_list_of_data_sets_is_named(what):
    with pytest.raises(ValueError, match="`members` must be a list of one HankelData or more, got "):
        dpc.HankelBatch(what)
    assert len(dpc.HankelBatch(small_data() for _ in range(2)).members) == 2
