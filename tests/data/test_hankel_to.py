"""Data move between devices and precisions."""

import pytest
import torch

import torch_dpc as dpc
from helpers import SMALL, Y_REF, relative, small_data, windows


@pytest.mark.parametrize("compact", [False, True])
def test_data_in_another_precision_plan_alike(compact):
    data = small_data().compressed() if compact else small_data()
    single = data.to(torch.float32)
    assert single.Up.dtype == torch.float32 and single.rank == data.rank and data.to(torch.float64).rank == data.rank
    back = single.to(torch.float64)
    assert back.recorded_as == torch.float32 and back.rank_tolerance == single.rank_tolerance
    u, y = windows(3, 3, seed=1, scale=0.5)
    plans = [dpc.DPCLayer(held, **SMALL)(u, y, y_ref=Y_REF).u for held in (data, single, back)]
    assert relative(plans[1], plans[0]) < 1e-3 and torch.equal(plans[1], plans[2])


def test_data_on_another_device_keep_their_graph_and_rank():
    u = torch.rand(60, 1, dtype=torch.float64, generator=torch.Generator().manual_seed(0)).requires_grad_()
    data = dpc.HankelData.from_trajectories(u, u.detach().cumsum(0), t_ini=2, horizon=5)
    data.row_space  # noqa: B018  # known before the move
    moved = data.to("cpu")
    assert moved.Up.requires_grad and moved.row_space is data.row_space
    batch = dpc.HankelBatch([data, data]).to(torch.float32)
    assert [member.Up.dtype for member in batch.members] == [torch.float32] * 2


def test_whole_numbers_are_refused():
    with pytest.raises(ValueError, match="`Up` must hold floating-point numbers, got torch.int64"):
        small_data().to(torch.int64)
