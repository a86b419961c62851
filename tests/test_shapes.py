"""Shapes broadcast as torch broadcasts them."""

import itertools

import pytest
import torch

from torch_dpc.shapes import broadcast_shapes

SHAPES = [(), (1,), (3,), (0,), (2, 1), (2, 3), (1, 0), (4, 1, 3)]


@pytest.mark.parametrize("shapes", itertools.product(SHAPES, repeat=3))
def test_as_torch_does(shapes):
    try:
        expected = torch.broadcast_shapes(*shapes)
    except RuntimeError:
        with pytest.raises(ValueError, match="must broadcast"):
            broadcast_shapes(*shapes)
    else:
        result = broadcast_shapes(*shapes)
        assert type(result) is torch.Size
        assert result == expected


def test_no_shape_at_all():
    assert broadcast_shapes() == torch.Size(())
