"""Newton's method for boxes alone: no second engine, no last resort and no judge that could mend what it leaves."""

import pytest
import torch

from torch_dpc.solve import kernels
from torch_dpc.solve.newton import solve_newton

EXACT = 1e-11  # of the multipliers, of size 1: the method ends in an exact active set
INSIDE = 5e-4  # how far free rows are from their upper bounds
SAMPLES = 60


@pytest.fixture(params=["torch", "kernel"])
def path(request, monkeypatch):
    if request.param == "torch":
        monkeypatch.setattr(kernels, "has_kernels", lambda v0: False)


def test_it_finds_the_multipliers_that_the_samples_were_made_of(path):
    """Rows at the upper bound, at the lower one, and free ones just inside the upper bound: v0 = v + G lam."""
    source = torch.Generator().manual_seed(0)
    Ct = torch.randn(6, 8, generator=source).double()
    G, bound = Ct @ Ct.mT, torch.full((6,), 0.5, dtype=torch.float64)
    kind = torch.randint(0, 3, (SAMPLES, 6), generator=source)
    size = 0.5 + torch.rand(SAMPLES, 6, generator=source).double()
    lam = torch.where(kind == 0, size, torch.where(kind == 1, -size, 0.0))
    v = torch.where(kind == 0, bound, torch.where(kind == 1, -bound, bound - INSIDE))
    found = solve_newton(G, Ct, v + lam @ G, -bound, bound)
    assert bool(found.converged.all())
    assert (found.lam - lam).abs().max() < EXACT
    assert ((found.lam == 0) == (kind == 2)).all()
