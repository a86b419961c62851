"""Study: the paper's system as printed, J^+ at the settings a reader would try, and the attacks it leads to.

    python -m scripts.study_printed_system              # about 10 minutes on two cores
    python -m scripts.study_printed_system --quick      # about 2 minutes: one seed, no cvxpylayers

The paper differentiates the plan by the pseudo-inverse of J, which has condition 1e14 on noise-free data, and does not
say how small a singular value must be to count as zero. Every line solves the same system J' s = right with one
library's default, or differentiates by cvxpylayers, beside the layer's own gradient. On windows of runs under random
noise it is judged by the cosine to the layer's gradient and by the decrease of psi that its attack reaches, as a share;
then the loop is closed under each attack, at the largest rho: on the masses by all, on the quadrotor, where all agree
on every window, by a few. Leaves, in results/:

    study_printed_windows.csv   one row for each plant, seed, method and window
    study_printed_loops.csv     one row for each plant, seed and method: the error in closed loop
    study_printed_system.md     tables
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

import torch_dpc as dpc
from baselines import CvxpyLayersDPC, FullKKT
from scripts.experiments.case import Case
from scripts.experiments.masses import Masses
from scripts.experiments.quadrotor import Quadrotor
from scripts.shared import bootstrap
from scripts.shared.command import arguments, versions
from scripts.shared.rows import Array
from scripts.shared.tables import Table, as_they_finish
from torch_dpc import attacks

CASES: dict[str, Case] = {"masses": Masses(), "quadrotor": Quadrotor()}
FIRST_SEED = 6000  # never looked at during development
WINDOWS = (10, 60, 110, 160)  # steps of a run under random noise from which windows are cut
EXACT, NONE = "the layer", "no attack"
SCALED, GELSY = "rows of J' scaled to 1, then gelsd", "torch.linalg.lstsq (gelsy, 2e-13)"
ON_QUADROTOR = (NONE, EXACT, SCALED, GELSY)  # the methods that close the loop there: a run takes minutes
WINDOW = ("plant", "seed", "method", "step", "cosine", "decrease", "share", "ms")
LOOP = ("plant", "seed", "method", "error", "largest")
LeastSquares = Callable[[Tensor, Tensor], Tensor]


def _numpy(solve: Callable[[Array, Array], Array]) -> LeastSquares:
    return lambda matrix, right: torch.from_numpy(solve(matrix.numpy(), right.numpy()))


#: How a reader may solve J' s = right; the cut-off is relative to the largest singular value.
SYSTEMS: dict[str, LeastSquares] = {
    GELSY: lambda matrix, right: torch.linalg.lstsq(matrix, right).solution,
    'torch.linalg.lstsq, driver="gelsd"': lambda m, right: torch.linalg.lstsq(m, right, driver="gelsd").solution,
    "torch.linalg.pinv (2e-13)": lambda matrix, right: torch.linalg.pinv(matrix) @ right,
    "numpy.linalg.lstsq (2e-13)": _numpy(lambda matrix, right: np.linalg.lstsq(matrix, right, rcond=None)[0]),
    "numpy.linalg.pinv (1e-15)": _numpy(lambda matrix, right: np.linalg.pinv(matrix) @ right),
    "numpy.linalg.lstsq, rcond=1e-15": _numpy(lambda matrix, right: np.linalg.lstsq(matrix, right, rcond=1e-15)[0]),
    "torch.linalg.solve": torch.linalg.solve,
}
PEERS: dict[str, dict[str, Any]] = {
    "cvxpylayers, Clarabel, lsqr": {"solver_args": {"solve_method": "Clarabel", "mode": "lsqr"}},
    "cvxpylayers, ECOS, lsqr": {"solver_args": {"solve_method": "ECOS", "mode": "lsqr"}},
    "cvxpylayers, MOREAU": {"solver": "MOREAU"},
}


def planner_of(method: str, layer: dpc.DPCLayer) -> Any:
    """Return what plans, and differentiates, by one method."""
    if method == EXACT:
        return layer
    if method == SCALED:
        return FullKKT(layer)
    if method in SYSTEMS:
        return FullKKT(layer, scaled=False, least_squares=SYSTEMS[method])
    return CvxpyLayersDPC(layer, **PEERS[method])


class GradientAttack:
    """Algorithm 1 with the gradient of any planner: p = argmin over the budget of <d psi(u*(p)) / dp at 0, p>.

    Args:
        planner: with the layer's call, differentiable in y_ini.
        cost: of the attacker.
        budget: admissible p.
    """

    def __init__(self, planner: Any, cost: Any, budget: attacks.Budget):
        self.planner, self.cost, self.budget = planner, cost, budget

    def gradient(self, u_ini: Tensor, y_ini: Tensor, *, step: int = 0, **references: Any) -> Tensor:
        """Return d psi / d y_ini; zero where the method gives no finite number."""
        y = y_ini.detach().clone().requires_grad_()
        psi = self.cost.at(step)(self.planner(u_ini, y, **references))
        (found,) = torch.autograd.grad(psi.sum(), y)
        return torch.nan_to_num(found, 0.0, 0.0, 0.0)

    def __call__(self, u_ini: Tensor, y_ini: Tensor, *, generator: Any = None, **call: Any) -> Tensor:
        """Return p, of the shape of y_ini."""
        return self.budget.minimize_linear(self.gradient(u_ini, y_ini, **call), y_ini)


def judge_windows(plant: str, seed: int, methods: Sequence[str]) -> list[dict[str, Any]]:
    """Return one row for every method and window of one seed."""
    torch.set_num_threads(1)
    case, rows = CASES[plant], []
    budget, cost = attacks.RelativeBall(case.rho), case.target()
    with case.system() as system:
        layer = case.layer(case.data(system, seed))
        log = case.simulate(system, layer, seed, attacks.RandomAttack(budget))
    y_ref, u_ref = case.references(case.steps + case.horizon)
    exact = GradientAttack(layer, cost, budget)
    for method in methods:
        attack = GradientAttack(planner_of(method, layer), cost, budget)
        for k in WINDOWS:
            past, ahead = slice(k - case.t_ini, k), slice(k, k + case.horizon)
            window = log.u[past], log.y[past]
            call: dict[str, Any] = {"y_ref": y_ref[ahead], "u_ref": None if u_ref is None else u_ref[ahead]}
            began = time.perf_counter()
            found = attack.gradient(*window, step=k, **call)
            took = 1e3 * (time.perf_counter() - began)
            right = exact.gradient(*window, step=k, **call)
            psi = cost.at(k)
            nominal = psi(layer(*window, **call))
            drops = [
                float(nominal - psi(layer(window[0], window[1] + budget.minimize_linear(g, window[1]), **call)))
                for g in (found, right)
            ]
            cosine = float(torch.nn.functional.cosine_similarity(found.flatten(), right.flatten(), dim=0))
            row = {"plant": plant, "seed": seed, "method": method, "step": k, "cosine": cosine}
            rows.append(row | {"decrease": drops[0], "share": drops[0] / drops[1], "ms": took})
    return rows


def close_loop(plant: str, seed: int, method: str) -> list[dict[str, Any]]:
    """Return the row of one seed under the attack of one method."""
    torch.set_num_threads(1)
    case = CASES[plant]
    with case.system() as system:
        layer = case.layer(case.data(system, seed))
        attack = None
        if method != NONE:
            attack = GradientAttack(planner_of(method, layer), case.target(), attacks.RelativeBall(case.rho))
        run = case.summed_up(case.simulate(system, layer, seed, attack))
    return [{"plant": plant, "seed": seed, "method": method, "error": run.error, "largest": run.largest}]


HEAD = ["gradient by", "cosine, median (smallest)", "share of the decrease, median (smallest)", "ms a gradient"]
HEAD += ["error in closed loop [m]", "less the layer's, paired"]


def report(windows: list[dict[str, str]], loops: list[dict[str, str]], methods: Sequence[str]) -> list[str]:
    """Return the tables of both plants."""
    lines = []
    for plant, case in CASES.items():
        errors = {method: _errors(loops, plant, method) for method in (NONE, *methods)}
        seeds = len(errors[EXACT])
        lines += ["", f"## {case.title}, rho {100 * case.rho:g} %", ""]
        lines += [f"No attack: {errors[NONE].mean():.4f} m. {seeds} seeds, {len(WINDOWS)} windows each.", ""]
        lines += ["| " + " | ".join(HEAD) + " |", "|---" * len(HEAD) + "|"]
        for method in methods:
            rows = [row for row in windows if (row["plant"], row["method"]) == (plant, method)]
            cosine, share, ms = (np.array([float(row[name]) for row in rows]) for name in ("cosine", "share", "ms"))
            cells = [method, f"{np.median(cosine):.3f} ({cosine.min():.3f})"]
            cells += [f"{100 * np.median(share):.0f} % ({100 * share.min():.0f} %)", f"{np.median(ms):.3g}"]
            error = errors[method]
            cells += [f"{error.mean():.4f}" if len(error) else "not run"]
            paired = len(error) == seeds > 1 and method != EXACT
            cells += [f"{bootstrap.difference(error, errors[EXACT]):+.4f}" if paired else ""]
            lines.append("| " + " | ".join(cells) + " |")
    return lines


def _errors(loops: list[dict[str, str]], plant: str, method: str) -> Array:
    """Return the mean error of each seed [m], in the order of the seeds."""
    mine = {int(row["seed"]): row for row in loops if (row["plant"], row["method"]) == (plant, method)}
    return np.array([float(mine[seed]["error"]) for seed in sorted(mine)])


def main(argv: list[str] | None = None) -> None:
    parser = arguments(__doc__, seeds=4)
    parser.add_argument("--quick", action="store_true", help="one seed, without cvxpylayers")
    parser.add_argument("--fresh", action="store_true", help="forget what was measured before")
    args = parser.parse_args(argv)
    out: Path = args.out
    out.mkdir(parents=True, exist_ok=True)
    seeds = range(FIRST_SEED, FIRST_SEED + (1 if args.quick else args.seeds))
    solved, peers = [EXACT, SCALED, *SYSTEMS], [] if args.quick else list(PEERS)
    names, began = ("study_printed_windows.csv", "study_printed_loops.csv"), time.perf_counter()
    if args.fresh:
        for name in names:
            (out / name).unlink(missing_ok=True)
    windows, loops = Table(out / names[0], WINDOW), Table(out / names[1], LOOP)

    done = {(r["plant"], int(r["seed"]), r["method"]) for r in windows.rows()}
    jobs: list[tuple[Any, ...]] = [
        (plant, seed, (method,))
        for seed in seeds
        for plant in CASES
        for method in (*solved, *peers)
        if (plant, seed, method) not in done
    ]
    for rows in tqdm(as_they_finish(judge_windows, jobs, args.workers), total=len(jobs), desc="Windows", unit="job"):
        windows.add(rows)
    done = {(r["plant"], int(r["seed"]), r["method"]) for r in loops.rows()}
    closing = {"masses": (NONE, *solved, *peers), "quadrotor": ON_QUADROTOR}
    jobs = [(p, s, m) for s in seeds for p, some in closing.items() for m in some if (p, s, m) not in done]
    for rows in tqdm(as_they_finish(close_loop, jobs, args.workers), total=len(jobs), desc="Closed loop", unit="run"):
        loops.add(rows)

    note = f"{versions(len(seeds), args.workers).split(';')[0]}; seeds {seeds[0]} to {seeds[-1]}; 1 thread a process"
    lines = ["# The system as printed, and the attacks it leads to", "", f"{note}."]
    lines += report(windows.rows(), loops.rows(), [*solved, *peers])
    (out / "study_printed_system.md").write_text("\n".join(lines) + "\n")
    print(f"Printed system: {out / 'study_printed_system.md'}, {time.perf_counter() - began:.0f} s")


if __name__ == "__main__":
    main()
