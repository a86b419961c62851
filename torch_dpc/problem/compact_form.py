"""The compact form of the problem, as the paper writes it.

minimise over u, y, g   1/2 |y - y_ref|_Q^2 + 1/2 |u - u_ref|_R^2 + lambda_g |M g|^2 + lambda_s |Yp g - y_ini|^2
subject to              Up g = u_ini,  u = Uf g,  y = Yf g,  u in U,  y in Y

M = I - W^+ W,  W = [Up; Yp; Uf]
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from ..data.hankel import HankelData
from ..reprs import shown
from .terms import Sizes, Terms
from .weights import Weights


class CompactForm(NamedTuple):
    """minimise 1/2 z'Pz + q'z subject to H z = b, z in U x Y x R^n_g, for z = (u, y, g)."""

    P: Tensor
    q: Tensor
    H: Tensor
    b: Tensor

    def __repr__(self) -> str:
        return f"CompactForm({', '.join(f'{name}={shown(x)}' for name, x in self._asdict().items())})"


def projector(data: HankelData) -> Tensor:
    """Return M = I - W^+ W, `(n_g, n_g)`, with the rank of W as the row space of the data decided it."""
    space = data.row_space
    in_W = space.basis[:, : space.rank_W]
    return torch.eye(data.n_g, dtype=in_W.dtype, device=in_W.device) - in_W @ in_W.T


def compact_form(data: HankelData, weights: Weights, theta: Tensor, terms: Terms = Terms()) -> CompactForm:  # noqa: B008
    """Return P, q, H, b as the paper writes them, with what the problem has beyond the paper's.

    For affine systems 1'g = 1 is the first row of H. A slack on u_ini moves Up from H to P, a weight on changes of the
    input widens R, and terminal steps are more rows of H. Subspace predictive control has rows K'g = 0, K a basis of
    the kernel of W. A set of the changes or of the slack is no part of z in D: it has no compact form.

    Args:
        data: the recorded data.
        weights: Q, R of the whole horizon, lambda_g, lambda_s; one problem.
        theta: (u_ini, y_ini, u_ref, y_ref) flattened, `(*batch, n_theta)`.
        terms: what the problem has beyond the paper's.

    Returns:
        P `(n, n)`, q `(*batch, n)`, H `(m, n)`, b `(*batch, m)` with n = horizon (n_u + n_y) + n_g and
        m = horizon (n_u + n_y) + t_ini n_u for the paper's terms.
    """
    sizes = replace(Sizes.of(data, terms), du=0)
    Up, Yp, Uf, Yf = (m.detach().to(theta) for m in data.matrices)
    Q, R = weights.Q.to(theta), weights.R.to(theta)
    u_ini, y_ini, u_ref, y_ref = theta.split(sizes.theta, dim=-1)
    of_g = 2 * weights.lambda_s * (Yp.T @ Yp) + _of_regularizer(data, weights, terms).to(theta)
    q_u, q_g = u_ref @ R, 2 * weights.lambda_s * (y_ini @ Yp)
    if weights.R_du is not None:
        S = weights.R_du.to(theta)
        change = torch.eye(sizes.u, dtype=theta.dtype, device=theta.device)
        change = change - torch.diag(change.new_ones(sizes.u - data.n_u), -data.n_u)
        before = torch.nn.functional.pad(u_ini[..., -data.n_u :], (0, sizes.u - data.n_u))
        R, q_u = R + change.T @ S @ change, q_u + before @ S @ change
    n_ones = int(terms.affine)  # 1'g = 1 stands before the rows of Up, and has no slack
    if weights.lambda_u is not None:
        of_g = of_g + 2 * weights.lambda_u * (Up[n_ones:].T @ Up[n_ones:])
        q_g = q_g + 2 * weights.lambda_u * (u_ini[..., n_ones:] @ Up[n_ones:])
    P = torch.block_diag(R, Q, of_g)
    q = -torch.cat([q_u, y_ref @ Q, q_g], dim=-1)
    n_v = sizes.u + sizes.y
    eye = torch.eye(n_v, dtype=theta.dtype, device=theta.device)
    H, b = [torch.cat([-eye, torch.cat([Uf, Yf])], dim=1)], [theta.new_zeros(*theta.shape[:-1], n_v)]
    exact = n_ones if terms.slack else sizes.u_ini
    if exact:
        H.insert(0, torch.cat([Up.new_zeros(exact, n_v), Up[:exact]], dim=1))
        b.insert(0, u_ini[..., :exact])
    if terms.terminal_steps:
        last = terms.terminal_steps * data.n_y
        H.append(torch.cat([eye[-last:], eye.new_zeros(last, data.n_g)], dim=1))
        b.append(y_ref[..., -last:])
    if terms.regularizer == "spc":
        W = data.basis[:, : data.row_space.rank_W].to(theta)
        beyond = torch.linalg.qr(W, mode="complete").Q[:, W.shape[1] :].mT
        H.append(torch.nn.functional.pad(beyond, (n_v, 0)))
        b.append(theta.new_zeros(*theta.shape[:-1], len(beyond)))
    return CompactForm(P, q, torch.cat(H), torch.cat(b, dim=-1))


def _of_regularizer(data: HankelData, weights: Weights, terms: Terms) -> Tensor:
    """Return the part of P that regularises g, `(n_g, n_g)`."""
    if terms.regularizer == "spc":
        return torch.zeros(data.n_g, data.n_g, dtype=torch.float64)
    M = torch.eye(data.n_g, dtype=torch.float64) if terms.regularizer == "identity" else projector(data).cpu()
    of_g = 2 * weights.lambda_g.cpu() * (M.T @ M)
    if weights.beta_2 is None:
        return of_g
    past = torch.cat([m.detach().double().cpu() for m in (data.Up, data.Yp)])
    past = past / data.row_space.units.cpu()[: len(past), None]
    explained = torch.linalg.pinv(past, rtol=data.rank_tolerance) @ past
    return of_g + 2 * weights.beta_2.cpu() * (torch.eye(data.n_g, dtype=torch.float64) - M - explained)
