"""Mutants of the problem: weights, references, terms, reduction, the paper's form."""

from .mutant import Mutant as M

RED, ROWS = "torch_dpc/problem/reduction.py", "torch_dpc/problem/rows.py"
OPT, TERMS, REDUCTION = "solve/test_optimality.py", "problem/test_terms.py", "problem/test_reduction.py"
GRAD = "solve/test_gradients.py"
FORMULATIONS = "problem/test_formulations.py -k conic"
OF_DATA = "problem/test_formulations.py -k g_has"
REGULARIZERS = "torch_dpc/problem/regularizers.py"

MUTANTS = [
    M(
        "lambda_g without its 2",
        "torch_dpc/problem/least_squares.py",
        "root_g = (2 * weights.lambda_g).sqrt()",
        "root_g = weights.lambda_g.sqrt()",
        OPT,
    ),
    M(
        "lambda_s without its 2",
        "torch_dpc/problem/least_squares.py",
        "root = (2 * getattr(weights, fit.weight)).sqrt()",
        "root = getattr(weights, fit.weight).sqrt()",
        OPT,
    ),
    M(
        "references of u and y swapped ends",
        ROWS,
        'Tracking("Q", slice(len(Uf), n_v), y_ref, data.n_y)',
        'Tracking("Q", slice(len(Uf), n_v), None, data.n_y)',
        OPT,
    ),
    M(
        "u_ref ignored",
        ROWS,
        'Tracking("R", slice(0, len(Uf)), u_ref, data.n_u)',
        'Tracking("R", slice(0, len(Uf)), None, data.n_u)',
        OPT,
    ),
    M(
        "M charges one direction too few",
        REGULARIZERS,
        "torch.arange(rank, device=device) >= first",
        "torch.arange(rank, device=device) > first",
        OPT + " " + REDUCTION,
    ),
    M(
        "identity charged like the projection",
        REGULARIZERS,
        'first = 0 if regularizer == "identity" else rank_W',
        "first = rank_W",
        TERMS,
    ),
    M(
        "gamma_2 begins with the past inputs",
        REGULARIZERS,
        "Z = W[:n_past]",
        "Z = W[: n_past - 1]",
        FORMULATIONS,
    ),
    M("gamma_2 does not turn with W", REGULARIZERS, "return N + of_W -", "return N -", OF_DATA),
    M(
        "the row space of W does not turn with the data",
        REGULARIZERS,
        "return kept + rows[:, rank_W:] @ (change",
        "return kept + 0 * rows[:, rank_W:] @ (change",
        OF_DATA,
    ),
    M(
        "the slack has the sign of the data alone",
        ROWS,
        "equal.append(Yp - torch.eye(",
        "equal.append(Yp + torch.eye(",
        FORMULATIONS,
    ),
    M(
        "the change of u counts from zero",
        ROWS,
        "Uf - torch.cat([Up, Uf])[len(Up) - data.n_u : -data.n_u]",
        "Uf - torch.cat([0 * Up, Uf])[len(Up) - data.n_u : -data.n_u]",
        TERMS,
    ),
    M("terminal outputs are the first ones", ROWS, "equal.append(Yf[-last:])", "equal.append(Yf[:last])", TERMS),
    M(
        "terminal reference is the first one",
        ROWS,
        "places.append(torch.arange(len(rows) - last, len(rows)))",
        "places.append(torch.arange(len(rows) - len(Yf), len(rows) - len(Yf) + last))",
        TERMS,
    ),
    M(
        "what the data cannot produce is let through",
        ROWS,
        "return norm(missed, dim=-1) > REACHABLE",
        "return norm(missed, dim=-1) > 1e9 + REACHABLE",
        "solve/test_failures.py",
    ),
    M(
        "the particular solution forgotten",
        RED,
        "A_theta[..., :, rows.Eq_theta] += rows.Eq_pinv",
        "A_theta[..., :, rows.Eq_theta] += 0 * rows.Eq_pinv",
        OPT,
    ),
    M(
        "multipliers act with the wrong sign",
        RED,
        "return solution[..., : rows.n_theta], -solution[..., rows.n_theta :]",
        "return solution[..., : rows.n_theta], solution[..., rows.n_theta :]",
        REDUCTION,
    ),
    M(
        "derivative through M is lost",
        "torch_dpc/problem/least_squares.py",
        "return M - change - change.mT",
        "return M",
        REDUCTION,
    ),
    M(
        "derivative through M has the wrong sign",
        "torch_dpc/problem/least_squares.py",
        "return M - change - change.mT",
        "return M + change + change.mT",
        REDUCTION,
    ),
    M(
        "the weight's derivative at half",
        RED,
        "Psi = 2 * weights.lambda_g[..., None, None]",
        "Psi = weights.lambda_g[..., None, None]",
        REDUCTION,
    ),
]
