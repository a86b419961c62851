"""Cases of the fuzz that were once wrong, failed or falsely infeasible: each is right now."""

import numpy as np
import pytest

from tests.fuzz.posed import problem_of
from tests.fuzz.problems import make
from tests.fuzz.run import run
from tests.oracles.extended import long
from tests.oracles.judge import Verdict, cost, reference, rows_missed
from tests.oracles.reduction import rows_of

RIGHT = (Verdict.RIGHT.value, Verdict.MARKED.value)
MENDED = {
    "a cone and a ball over units far apart: suboptimal": ("any", 68),
    "the row space of W, off by rounding over 1e-6: suboptimal": ("any", 193),
    "the same where lambda_g is large": ("any", 541),
    "a small channel in a ball of large ones: suboptimal": ("any", 1078),
    "a small channel in a cone: suboptimal": ("any", 543),
    "a ball over a trajectory in odd units: g misses its rows": ("any", 894),
    "coefficients of 1e12 that cancel: g misses its rows": ("any", 1107),
    "boxes over units far apart: falsely infeasible": ("any", 1268),
    "nonnegative outputs over units far apart: falsely infeasible": ("777", 125),
    "an optimum of cost zero with free directions: failed": ("any", 33),
    "sixty free directions: failed": ("any", 62),
    "soft bounds with free directions: failed": ("any", 347),
    "no set at all, free directions: failed": ("any", 334),
    "free directions along which plans go far: failed": ("any", 1401),
    "prices on a cost of 1e-8: failed": ("any", 709),
    "multipliers on the changes of the input: g misses its rows": ("any", 1981),
    "equalities that leave nothing free: an exception": ("any", 250),
}


@pytest.mark.parametrize("kind", MENDED)
def test_what_was_wrong_is_right(kind):
    report = run(*MENDED[kind])
    assert not report.error
    verdicts = [sample["verdict"] for sample in report.samples]
    # The reference itself may not decide a sample of those; it never says that one is wrong.
    assert all(verdict in (*RIGHT, Verdict.UNDECIDED.value) for verdict in verdicts), report.samples
    assert any(verdict in RIGHT for verdict in verdicts)


@pytest.mark.parametrize("index, sample", [(266, 0), (683, 1), (1481, 2)])
def test_the_plan_of_the_reference_passes_its_own_test(index, sample):
    """Free directions move an output by rounding alone: 1e17 times that was once a plan of lower cost."""
    case = make("any", index)
    p, s = problem_of(case), case.samples[sample]
    rows = rows_of(p)
    ref = reference(p, rows, s)
    v, a = ref.plan
    v = v * long(p.scale_v)
    n_u = p.horizon * p.n_u
    u, y = v[:n_u].reshape(-1, p.n_u), v[n_u : n_u + p.horizon * p.n_y].reshape(-1, p.n_y)
    g = np.asarray(rows.basis @ a, float)
    assert rows_missed(p, s, u, y, g) < 1e-6
    value, allowance = cost(p, rows, s, u, y, g)
    assert value <= ref.optimum.value * (1 + 1e-6) + allowance
