"""The check of the reduced map sees whatever is wrong with it: each part of it is shown a fault of that part alone."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import torch_dpc as dpc
import torch_dpc.problem.reduction as reduction_module
from helpers import HOLDING, SMALL, Y_REF, paper_layer, relative, small_data, small_layer, windows
from torch_dpc.problem.verification import verify
from torch_dpc.solve import last_resort

FAULT = 1e-6  # of the map; a check with a tolerance of 1e-3 would let it pass
ACCEPTED = 1e-8


def checked(layer):
    """Return the problem as posed and the map of a layer."""
    reduction = layer.reduction
    flat = reduction_module._map_tensors(reduction, lambda x: x[None])
    n_x = reduction.T.shape[-1]
    return reduction_module._one_of(flat, 0, False), reduction_module._map_of(flat, 0, torch.zeros(n_x, 0).double())


def unrefined(posed, found):
    """Return the errors that one check finds, in double precision."""
    return reduction_module.verify.__globals__["_check"](posed, found, reduction_module.verify.__globals__["SETTINGS"])


@pytest.mark.parametrize("layer", [paper_layer, lambda: paper_layer(1e-2), small_layer])
def test_the_map_of_a_sound_reduction_convinces(layer):
    posed, found = checked(layer())
    assert verify(posed, found)[1].error.max() < 1e-11


@pytest.mark.parametrize("weight", ["Q", "R", "lambda_g", "lambda_s"])
def test_a_map_of_other_weights_is_not_stationary(weight):
    """v = C a and Up g = u_ini hold for it: stationarity alone says that it is another problem's."""
    posed, _ = checked(small_layer())
    _, other = checked(small_layer(**{weight: SMALL[weight] * (1 + 1e-3)}))
    error = unrefined(posed, other).error
    assert ACCEPTED < error[: len(posed.C)].max() < 1.0
    assert error[len(posed.C) :].max() < 1e-10  # the equalities have nothing to say


def test_a_map_that_misses_u_ini_is_seen():
    posed, found = checked(small_layer())
    A = found.A.copy()
    A += FAULT * np.linalg.pinv(posed.Eq) @ np.ones((len(posed.Eq), A.shape[1]))
    error = unrefined(posed, replace(found, A=A, values=posed.C @ A)).error
    assert error[len(posed.C) :].max() > FAULT


@pytest.mark.parametrize("row", [0, 20])
def test_a_plan_that_is_not_that_of_g_is_seen(row):
    posed, found = checked(small_layer())
    values = found.values.copy()
    values[row] += FAULT
    error = unrefined(posed, replace(found, values=values)).error
    assert error[row].max() > FAULT and np.delete(error, row, axis=0).max() < 1e-10


def test_small_faults_are_corrected():
    posed, found = checked(small_layer())
    A = found.A * (1 + FAULT * np.sin(np.arange(found.A.size)).reshape(found.A.shape))
    corrected, verdict = verify(posed, replace(found, A=A, values=posed.C @ A))
    assert verdict.error.max() < 1e-10
    assert np.abs(corrected.values - found.values).max() / np.abs(found.values).max() < 1e-10


# --- a reduction that loses a part of the problem returns nothing unmarked --------------------------------------------


def plans():
    layer = dpc.DPCLayer(small_data(), **SMALL, u_set=dpc.Box(-0.5, 0.5), on_failure="nan")
    u_ini, y_ini = windows(4, 3, seed=3)
    return layer(u_ini, y_ini, y_ref=Y_REF, u_ref=HOLDING)


@pytest.mark.parametrize("fraction", [0.0, 0.5])
def test_a_cost_that_loses_a_term(monkeypatch, fraction):
    """The rows of lambda_s are left out of the factorisation, or halved: right after correction, or marked."""
    expected, whole = plans(), reduction_module.least_squares

    def without(rows, weights):
        E, f = whole(rows, weights)
        k = rows.Yp.shape[-2]
        scale = torch.ones(len(E), 1, dtype=E.dtype)
        scale[-k:] = fraction
        return E * scale, f * scale

    monkeypatch.setattr(reduction_module, "least_squares", without)
    found = plans()
    solved = found.info.status == dpc.Status.SOLVED
    assert not solved.any() or relative(found.u[solved], expected.u[solved]) < 1e-7


@pytest.mark.parametrize("resort", [True, False])
def test_equalities_that_lose_a_row(monkeypatch, resort):
    """The last resort eliminates them anew from the rows as posed; without it every sample is marked."""
    import torch_dpc.problem.rows as rows_module

    expected = plans()
    whole = rows_module._eliminate

    def without_last(Eq, units, tolerance):
        pinv, Z, reached = whole(Eq[:-1], units[:-1], tolerance)
        return torch.nn.functional.pad(pinv, (0, 1)), Z, reached

    monkeypatch.setattr(rows_module, "_eliminate", without_last)
    if not resort:
        monkeypatch.setattr(last_resort, "settled", lambda *_: dpc.Status.FAILED)
    found = plans()
    if resort:
        assert (found.info.status == dpc.Status.SOLVED).all() and relative(found.u, expected.u) < 1e-7
    else:
        assert (found.info.status == dpc.Status.FAILED).all()
