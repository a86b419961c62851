"""Tables of tune_regularization.py, and which point is chosen."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from scripts.experiments.case import Case
from scripts.experiments.scenario import FIGURE
from scripts.regularization.search import METHODS
from scripts.regularization.trials import QUICK_TRIALS, SAME, TINY, Trial, Verdict, dominates, verdicts
from scripts.shared.rows import Array

HELD_OUT, VALIDATED, RIDGE = "held out", "validation", "ridge"
NOMINAL_TRIALS = [trial.name for trial in QUICK_TRIALS if trial.attack == "nominal"]
ATTACKED_TRIAL = Trial(FIGURE, "algorithm1").name
Rows = list[dict[str, Any]]


def errors(runs: Rows, case: str, point: str, split: str, trial: str) -> Array:
    """Return the error of each recording, in the order of the seeds."""
    keys = {"case": case, "point": point, "split": split, "trial": trial}
    chosen = {int(r["seed"]): float(r["error"]) for r in runs if all(r[k] == v for k, v in keys.items())}
    return np.array([chosen[seed] for seed in sorted(chosen)])


def summary(runs: Rows, case: str, point: str, split: str) -> tuple[float, float]:
    """Return the mean error over all scenarios without an attack, and that under Algorithm 1 in the figure's run."""
    nominal = np.mean([errors(runs, case, point, split, trial).mean() for trial in NOMINAL_TRIALS])
    return float(nominal), float(errors(runs, case, point, split, ATTACKED_TRIAL).mean())


def choose(points: Rows, runs: Rows, case: Case) -> str:
    """Return the point that the validation recordings recommend, whatever search found it.

    The one with the least error under Algorithm 1 among those that are worse in no scenario without an attack; the
    paper's weights if there is none.
    """

    def means(point: str) -> list[float]:
        return [float(errors(runs, case.name, point, VALIDATED, trial).mean()) for trial in NOMINAL_TRIALS]

    before = means("paper")
    names = ["paper", *(row["point"] for row in points if row["case"] == case.name)]
    fit = [
        name
        for name in names
        if all(after <= old + max(SAME * old, TINY) for after, old in zip(means(name), before, strict=True))
    ]
    return min(fit, key=lambda name: errors(runs, case.name, name, VALIDATED, ATTACKED_TRIAL).mean())


def write_report(path: Path, cases: Sequence[Case], points: Rows, runs: Rows, note: str) -> None:
    """Write the tables of every case."""
    lines = [
        "# Weights that hold under attack",
        "",
        f"{note}. Errors are means over a run in closed loop [m], then over held-out recordings. Changes are paired "
        "differences from the paper's weights with 95 % bootstrap intervals. A change is *better* or *worse* where its "
        f"interval excludes 0 and it exceeds {SAME:.0%} of the error before and {1e3 * TINY:g} mm. Weights *dominate* "
        "if no trial's interval reaches such a worsening and one trial is better. Every attacker knows the weights.",
    ]
    for case in cases:
        chosen = choose(points, runs, case)
        lines += ["", f"## {case.title[0].upper()}{case.title[1:]}, rho {100 * case.rho:g} %", ""]
        lines += [*trial_table(case, chosen, runs), "", *point_table(case, chosen, points, runs), ""]
        lines += weight_lines(case, chosen, points)
    path.write_text("\n".join(lines) + "\n")


def judged(runs: Rows, case: Case, chosen: str) -> dict[str, list[Verdict]]:
    """Return the verdicts of the chosen weights and of the ridge, on the held-out recordings."""
    held_out = [row for row in runs if row["split"] == HELD_OUT]
    return {name: verdicts(held_out, case.name, "paper", name) for name in (chosen, RIDGE)}


def trial_table(case: Case, chosen: str, runs: Rows) -> list[str]:
    """Return the table of before and after, trial by trial, and the verdicts."""
    found = judged(runs, case, chosen)
    head = ["trial", "the paper's", "tuned", "change", "", "paper's and ridge", "change", ""]
    lines = ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
    for tuned, ridge in zip(*found.values(), strict=True):
        cells = [tuned.trial, f"{tuned.before.mean():.4f}"]
        for verdict in (tuned, ridge):
            cells += [f"{verdict.after.mean():.4f}", f"{verdict.change:+.4f}", verdict.says]
        lines.append("| " + " | ".join(cells) + " |")
    names = {chosen: "no tuned weights: the paper's" if chosen == "paper" else f"the tuned weights ({chosen})"}
    names[RIDGE] = "the paper's weights with the ridge"
    said = [
        f"{names[name].capitalize()} {'dominate' if dominates(v) else 'do not dominate'}." for name, v in found.items()
    ]
    return [*lines, "", f"{len(found[RIDGE][0].before)} recordings. " + " ".join(said)]


def point_table(case: Case, chosen: str, points: Rows, runs: Rows) -> list[str]:
    """Return the table of every tuned point and of the grid."""
    head = [
        "weights",
        "attacked weight",
        "evaluations",
        "CPU [s]",
        "objective",
        "no attack, all scenarios",
        "Algorithm 1",
    ]
    lines = ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
    lines += [
        "| the paper's | | | | | " + " | ".join(f"{v:.4f}" for v in summary(runs, case.name, "paper", HELD_OUT)) + " |"
    ]
    order = list(METHODS)
    mine = [row for row in points if row["case"] == case.name]
    for row in sorted(mine, key=lambda row: (order.index(row["method"]), float(row["attacked_weight"]))):
        name = METHODS[row["method"]] + (", **chosen**" if row["point"] == chosen else "")
        cells = [name, f"{float(row['attacked_weight']):g}", row["evaluations"], f"{float(row['seconds']):.0f}"]
        cells += [f"{float(row['total']):.4f}" if float(row["attacked_weight"]) == 1 else ""]
        cells += [f"{value:.4f}" for value in summary(runs, case.name, row["point"], HELD_OUT)]
        lines.append("| " + " | ".join(cells) + " |")
    return lines


def weight_lines(case: Case, chosen: str, points: Rows) -> list[str]:
    """Return the paper's and the chosen weights."""
    paper = case.paper()

    def line(name: str, lambdas: Sequence[float], Q: Sequence[float], R: Sequence[float]) -> str:
        cells = [name, *(f"{v:.3g}" for v in lambdas), *(", ".join(f"{v:.3g}" for v in d) for d in (Q, R))]
        return "| " + " | ".join(cells) + " |"

    lines = ["| | lambda_g | lambda_s | diagonal of Q | diagonal of R |", "|---|---|---|---|---|"]
    lines += [line("the paper's", paper[:2], paper.Q, paper.R)]
    for row in points:
        if (row["case"], row["point"]) == (case.name, chosen):
            Q, R = ([float(v) for k, v in row.items() if k[0] == n and k[1:].isdigit()] for n in "QR")
            lines += [line("tuned", [float(row[name]) for name in ("lambda_g", "lambda_s")], Q, R)]
    return lines
