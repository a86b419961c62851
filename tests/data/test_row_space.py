"""The basis of the row space, where rows are nearly dependent."""

import numpy as np
import torch

import torch_dpc as dpc


def test_a_sum_of_rows_lies_in_the_row_space_of_nearly_dependent_ones():
    """With noise of 1e-6 singular vectors are off by 1e-10, and |M g| of a g in the row space was 1e-10 |g|."""
    draw = np.random.default_rng(0)
    u = draw.uniform(-1, 1, (60, 2))
    y = np.zeros((60, 3))
    for k in range(59):
        y[k + 1] = 0.7 * y[k] + u[k] @ [[1.0, 0.2, 0.0], [0.0, 0.5, 1.0]]
    y += 1e-6 * draw.normal(size=y.shape)
    data = dpc.HankelData.from_trajectories(torch.from_numpy(u), torch.from_numpy(y), t_ini=3, horizon=4)
    space = data.row_space
    W = np.concatenate([m.numpy() for m in data.matrices[:3]])
    left, size, _ = np.linalg.svd(W)
    assert space.rank_W == len(W) and size[-1] < 1e-5 * size[0]
    basis = space.basis[:, : space.rank_W].numpy()
    for i in (-1, -2, 0):
        g = (W.T.astype(np.longdouble) @ (left[:, i] / size[i])).astype(float)
        assert np.linalg.norm(g - basis @ (basis.T @ g)) < 1e-12 * np.linalg.norm(g)  # 1e-19 over 1e-7
