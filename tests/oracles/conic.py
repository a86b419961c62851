"""Clarabel behind one call: a quadratic cost, blocks of constraints, and the multipliers back in the blocks' order."""

import clarabel
import numpy as np
from scipy import sparse

from .blocks import Block
from .extended import Array


def conic(P: Array, q: Array, blocks: list[tuple[Block, Array, Array]], tolerance: float) -> tuple[Array, list[Array]]:
    """Return argmin 1/2 x'Px + q'x + prices over M x + m in the block, for each (block, M, m), and its multipliers.

    Ends of intervals, soft or hard, are rows of their own; a soft end has a slack with a price.
    """
    n = len(q)
    linear, cones, prices = [], [], []
    for i, (b, M, m) in enumerate(blocks):
        if b.kind == "interval":
            for sign, end in ((1, b.upper), (-1, b.lower)):
                if np.isfinite(end):
                    linear.append((sign * M[0], float(sign * (end - m[0])), i, sign))
                    prices.append(None if b.hard else float(b.price))
        elif b.kind == "ball":
            cones.append((np.vstack([np.zeros(n), -M]), np.concatenate([[float(b.radius)], m]), i))
        else:
            cones.append((-M, m, i))
    soft = [k for k, price in enumerate(prices) if price is not None]
    slack = np.zeros((len(linear), len(soft)))
    slack[soft, range(len(soft))] = -1
    A = [np.hstack([np.array([row for row, *_ in linear]).reshape(-1, n), slack])]
    b_side = [np.array([end for _, end, *_ in linear])]
    A.append(np.hstack([np.zeros((len(soft), n)), -np.eye(len(soft))]))
    b_side.append(np.zeros(len(soft)))
    shape = [clarabel.NonnegativeConeT(len(linear) + len(soft))]
    for rows, offset, _ in cones:
        A.append(np.hstack([rows, np.zeros((len(rows), len(soft)))]))
        b_side.append(offset)
        shape.append(clarabel.SecondOrderConeT(len(rows)))
    settings = clarabel.DefaultSettings()
    settings.verbose, settings.max_iter, settings.max_threads = False, 200, 1
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = tolerance
    full = np.zeros((n + len(soft), n + len(soft)))
    full[:n, :n] = P
    cost = np.concatenate([q, [prices[k] for k in soft]])
    sides = [np.asarray(part, float) for part in (np.vstack(A), np.concatenate(b_side))]
    solver = clarabel.DefaultSolver(
        sparse.csc_matrix(np.triu(full)), cost, sparse.csc_matrix(sides[0]), sides[1], shape, settings
    )
    answer = solver.solve()
    x, dual = np.array(answer.x[:n]), np.array(answer.z)
    lam = [np.zeros(len(M)) for _, M, _ in blocks]
    for k, (*_, i, sign) in enumerate(linear):
        lam[i][0] += sign * dual[k]
    at = len(linear) + len(soft)
    for rows, _, i in cones:
        z, at = dual[at : at + len(rows)], at + len(rows)
        lam[i] = -z[1:] if blocks[i][0].kind == "ball" else -z
        # 0 = gradient + M'lam:  the cone's slack is b - A x = M x + m, so A'z = -M'z.
    return x, lam
