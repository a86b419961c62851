"""Shared builders, and oracles that use nothing of the package beyond its inputs."""

import functools

import torch

import torch_dpc as dpc

# The problems are small: on a busy machine threads that wait for each other cost 50 times more.
torch.set_num_threads(1)

T_INI, HORIZON, SAMPLES = 6, 25, 530  # the paper's
Y_REF = torch.tensor([1.0, 1.0, 0.0, 0.0], dtype=torch.float64)
HOLDING = torch.tensor([1.0, 1.0], dtype=torch.float64)  # the input that holds the masses at Y_REF
PAPER = {"Q": 10.0, "R": 1.0, "lambda_g": 100.0, "lambda_s": 1e6}
SMALL = {"Q": 10.0, "R": 1.0, "lambda_g": 1.0, "lambda_s": 1e3}


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def randn(*shape, seed=0):
    return torch.randn(*shape, dtype=torch.float64, generator=generator(seed))


@functools.cache
def masses_data(noise=0.0, *, steps=SAMPLES, t_ini=T_INI, horizon=HORIZON, seed=0):
    """Data of the oscillating masses; `noise` is the standard deviation on each measured output."""
    source = generator(seed)
    plant = dpc.systems.OscillatingMasses(noise=noise, generator=source)
    u, y = dpc.collect(plant, steps, generator=source)
    return dpc.HankelData.from_trajectories(u, y, t_ini=t_ini, horizon=horizon)


def small_data(noise=1e-2, seed=0):
    return masses_data(noise, steps=150, t_ini=3, horizon=6, seed=seed)


def paper_layer(noise=0.0, **options):
    """The layer of the paper's masses experiment."""
    options = {**PAPER, "u_set": dpc.Box(-1.0, 1.0), "y_set": dpc.Box(-5.0, 5.0), **options}
    return dpc.DPCLayer(masses_data(noise), **options)


def small_layer(noise=1e-2, **options):
    """A layer of 3 past and 6 future steps of the masses, some of whose inputs meet their bounds."""
    return dpc.DPCLayer(small_data(noise), **{**SMALL, "u_set": dpc.Box(-0.5, 0.5), **options})


def windows(n, t_ini=T_INI, *, seed=0, scale=1.0, noise=0.0):
    """Past windows of the masses under random inputs from random states: `(n, t_ini, 2)` and `(n, t_ini, 4)`."""
    source = generator(seed)
    plant = dpc.systems.OscillatingMasses(noise=noise, generator=source)
    us = 2 * torch.rand(n, t_ini, 2, dtype=torch.float64, generator=source) - 1
    states = scale * torch.randn(n, 4, dtype=torch.float64, generator=source)
    ys = []
    for state, u in zip(states, us, strict=True):
        y = [plant.reset(state)]
        y += [plant.step(step) for step in u[:-1]]
        ys.append(torch.stack(y))
    return us, torch.stack(ys) if n else us.new_zeros(0, t_ini, 4)


def delayed_data(n=120, t_ini=3, horizon=6, seed=0, noise=0.0):
    """y = (a first-order lag of u, the u of the step before): past inputs alone decide one output of the plan."""
    u = 2 * torch.rand(n, 1, dtype=torch.float64, generator=generator(seed)) - 1
    y = torch.zeros(n, 2, dtype=torch.float64)
    for k in range(n - 1):
        y[k + 1] = torch.stack([0.8 * y[k, 0] + 0.2 * u[k, 0], u[k, 0]])
    y = y + noise * randn(n, 2, seed=seed + 1)
    return dpc.HankelData.from_trajectories(u, y, t_ini=t_ini, horizon=horizon)


def delayed_layer(noise=0.0, **options):
    """The second output of the first step is the last u_ini: a last u_ini beyond 0.5 excludes every plan."""
    weights = {"Q": 1.0, "R": 0.1, "lambda_g": 1.0, "lambda_s": 1e3}
    sets = {"u_set": dpc.Box(-1.0, 1.0), "y_set": dpc.Box(torch.tensor([-0.3, -0.5]), torch.tensor([0.3, 0.5]))}
    return dpc.DPCLayer(delayed_data(noise=noise), **{**weights, **sets, **options})


def delayed_windows(n, impossible=(), seed=1):
    u_ini = 0.8 * torch.rand(n, 3, 1, dtype=torch.float64, generator=generator(seed)) - 0.4
    u_ini[list(impossible), -1] = 0.7
    return u_ini, randn(n, 3, 2)


# --- differences ------------------------------------------------------------------------------------------------------


def central(function, x, step=1e-5):
    """Return d function / d x, `(*function, *x)`, by central differences."""
    flat = x.detach().reshape(-1)
    columns = []
    for i in range(len(flat)):
        change = torch.zeros_like(flat)
        change[i] = step
        with torch.no_grad():
            ahead, behind = (function((flat + s * change).reshape(x.shape)) for s in (1, -1))
        columns.append((ahead - behind) / (2 * step))
    return torch.stack(columns, dim=-1).reshape((*columns[0].shape, *x.shape))


def relative(a, b):
    """Return the largest difference relative to the largest entry of b."""
    a, b = torch.as_tensor(a).detach(), torch.as_tensor(b).detach()
    assert a.shape == b.shape, (a.shape, b.shape)
    return float((a - b).abs().max() / b.abs().max().clamp_min(1e-300))


# --- oracles ----------------------------------------------------------------------------------------------------------


#: Violation and wrong sign that rounding may leave at an oracle's solution.
CERTIFIED = 1e-10


def nearest_point(rows, lower, upper):
    """Return argmin 1/2 |x|^2 subject to lower <= rows x <= upper: an interior-point method, then one exact solve."""
    tight = lower == upper
    if tight.any():
        x0 = torch.linalg.pinv(rows[tight]) @ lower[tight]
        kernel = torch.linalg.svd(rows[tight])[2][int(tight.sum()) :].T
        others = rows[~tight]
        shifted = (end[~tight] - others @ x0 for end in (lower, upper))
        return x0 + kernel @ nearest_point(others @ kernel, *shifted)
    ends = [(upper.isfinite(), 1.0, upper), (lower.isfinite(), -1.0, lower)]
    A = torch.cat([sign * rows[kept] for kept, sign, _ in ends])
    b = torch.cat([sign * end[kept] for kept, sign, end in ends])
    x, s, lam = rows.new_zeros(rows.shape[1]), b.clamp_min(1.0), torch.ones_like(b)
    if len(b) == 0:
        return x
    for _ in range(100):
        dual, primal, gap = x + A.T @ lam, A @ x + s - b, s * lam
        if gap.max() < 1e-4:  # the active set may be known already: solve on it, and believe the optimality conditions
            active = lam > s
            inverse = torch.linalg.pinv(A[active])
            exact = inverse @ b[active]
            forces = -inverse.T @ exact
            if (A @ exact - b).max() < CERTIFIED and (forces > -CERTIFIED).all():
                return exact
        K = torch.eye(len(x), dtype=x.dtype) + A.T @ ((lam / s)[:, None] * A)
        target = gap
        for corrects in (False, True):  # Mehrotra's predictor, then the centred corrector
            dx = torch.linalg.solve(K, -dual - A.T @ ((lam * primal - target) / s))
            ds = -primal - A @ dx
            dlam = -(target + lam * ds) / s
            reach = [torch.where(d < 0, -v / d, torch.inf).min() for v, d in ((s, ds), (lam, dlam))]
            length = min(1.0, 0.99 * float(min(reach)))
            if not corrects:
                after = (s + length * ds) @ (lam + length * dlam) / len(b)
                target = gap + ds * dlam - after**3 / gap.mean() ** 2
        x, s, lam = x + length * dx, s + length * ds, lam + length * dlam
    raise AssertionError("the interior-point oracle did not converge")


def constrained_least_squares(E, e, C, c, lower, upper):
    """Return argmin |E x - e|^2 subject to lower <= C x + c <= upper, for E of full column rank."""
    orthogonal, T = torch.linalg.qr(E)
    x0 = torch.linalg.solve(T, orthogonal.T @ e)
    rows = torch.linalg.solve(T.T, C.T).T
    v0 = C @ x0 + c
    return x0 + torch.linalg.solve(T, nearest_point(rows, lower - v0, upper - v0))


def bounds_of(layer):
    """Return lower and upper of (u, y)."""
    steps, ends = layer.data.horizon, []
    for end in ("lower", "upper"):
        parts = [
            torch.as_tensor(getattr(box, end), dtype=torch.float64).detach().expand(steps, n).reshape(-1)
            for box, n in ((layer.u_set, layer.data.n_u), (layer.y_set, layer.data.n_y))
        ]
        ends.append(torch.cat(parts))
    return ends


def reference_plan(layer, u_ini, y_ini, y_ref, u_ref=None, cutoff=1e-9):
    """Return u, y of one sample from the QP as printed, posed on the row space of the data (an SVD of its own)."""
    data, steps = layer.data, layer.data.horizon
    Up, Yp, Uf, Yf = (m.double() for m in (data.Up, data.Yp, data.Uf, data.Yf))
    y_ref = y_ref.double().expand(steps, -1).reshape(-1)
    u_ref = torch.zeros(data.n_u) if u_ref is None else u_ref
    u_ref = u_ref.double().expand(steps, -1).reshape(-1)
    LR, LQ = (_root(w, n, steps) for w, n in ((layer.R, data.n_u), (layer.Q, data.n_y)))
    W = torch.cat([Up, Yp, Uf])
    _, size, in_all = torch.linalg.svd(torch.cat([W, Yf]), full_matrices=False)
    basis = in_all[size > cutoff * size[0]].T
    _, size_W, in_W = torch.linalg.svd(W, full_matrices=False)
    in_W = in_W[size_W > cutoff * size[0]]
    _, size_p, kernel = torch.linalg.svd(Up @ basis)
    kernel = kernel[int((size_p > cutoff * size_p[0]).sum()) :].T
    g0 = basis @ torch.linalg.pinv(Up @ basis, rtol=cutoff) @ u_ini.double().reshape(-1)
    S = basis @ kernel
    root_g, root_s = float(2 * layer.lambda_g) ** 0.5, float(2 * layer.lambda_s) ** 0.5
    M_S, M_g0 = (root_g * (m - in_W.T @ (in_W @ m)) for m in (S, g0))
    E = torch.cat([LR @ Uf @ S, LQ @ Yf @ S, M_S, root_s * Yp @ S])
    mismatch = root_s * (y_ini.double().reshape(-1) - Yp @ g0)
    e = torch.cat([LR @ (u_ref - Uf @ g0), LQ @ (y_ref - Yf @ g0), -M_g0, mismatch])
    C = torch.cat([Uf, Yf])
    v = C @ (g0 + S @ constrained_least_squares(E, e, C @ S, C @ g0, *bounds_of(layer)))
    u, y = v.split((steps * data.n_u, steps * data.n_y))
    return u.reshape(steps, -1), y.reshape(steps, -1)


def _root(weight, n, steps):
    weight = torch.as_tensor(weight, dtype=torch.float64).detach()
    weight = weight * torch.eye(n, dtype=torch.float64) if weight.ndim == 0 else weight
    weight = torch.block_diag(*[weight] * steps) if len(weight) < n * steps else weight
    values, vectors = torch.linalg.eigh(weight)
    return values.clamp_min(0).sqrt()[:, None] * vectors.T


def model_plan(layer, u_ini, y_ini, y_ref, u_ref, *, hard=False):
    """Return u, y of predictive control with the true model of the masses: no data, no Hankel matrices.

    The state at the start of the window is free and pays lambda_s for every past output it misses, as in the
    data-driven problem; with `hard` the present state is the true one, as in textbook predictive control.
    """
    plant = dpc.systems.OscillatingMasses()
    t_ini, steps = layer.data.t_ini, layer.data.horizon
    n_x, n_u, total = 4, 2, t_ini + steps
    # outputs of step k: free[k] x_start + forced[k] (u_0, ..., u_{k-1})
    free = torch.stack([torch.linalg.matrix_power(plant.A, k) for k in range(total)])
    forced = torch.zeros(total, n_x, total * n_u, dtype=torch.float64)
    for k in range(1, total):
        forced[k] = plant.A @ forced[k - 1]
        forced[k][:, (k - 1) * n_u : k * n_u] = plant.B
    split = t_ini * n_u
    constant = forced[:, :, :split] @ u_ini.reshape(-1)
    maps = torch.cat([free, forced[:, :, split:]], dim=2)  # of (x_start, u of the plan)
    pick = torch.eye(n_x + steps * n_u, dtype=torch.float64)[n_x:]
    future, offset = maps[t_ini:].flatten(0, 1), constant[t_ini:].reshape(-1)
    root_q, root_r, root_s = (float(w) ** 0.5 for w in (layer.Q, layer.R, 2 * layer.lambda_s))
    E, e = [root_r * pick, root_q * future], [root_r * u_ref.repeat(steps), root_q * (y_ref.repeat(steps) - offset)]
    C, c = torch.cat([pick, future]), torch.cat([torch.zeros_like(u_ref).repeat(steps), offset])
    if hard:
        x_start = torch.cat([y_ini[0], torch.zeros_like(u_ref).repeat(steps)])
        e = [t - m @ x_start for m, t in zip(E, e, strict=True)]
        c, C, E = c + C @ x_start, C[:, n_x:], [m[:, n_x:] for m in E]
    else:
        E.append(root_s * maps[:t_ini].flatten(0, 1))
        e.append(root_s * (y_ini.reshape(-1) - constant[:t_ini].reshape(-1)))
    v = C @ constrained_least_squares(torch.cat(E), torch.cat(e), C, c, *bounds_of(layer)) + c
    u, y = v.split((steps * n_u, steps * n_x))
    return u.reshape(steps, n_u), y.reshape(steps, n_x)
