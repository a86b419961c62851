"""Tables of tune_regularization.py, and which point is chosen."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
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


def summary(runs: Rows, case: str, point: str) -> tuple[float, float]:
    """Return the mean error over all scenarios without an attack and that under Algorithm 1, on validation."""
    nominal = np.mean([errors(runs, case, point, VALIDATED, trial).mean() for trial in NOMINAL_TRIALS])
    return float(nominal), float(errors(runs, case, point, VALIDATED, ATTACKED_TRIAL).mean())


def has_ridge(point: str) -> bool:
    """Return whether the data of a point have the ridge."""
    return point.startswith(RIDGE)


def twin(point: str) -> str:
    """Return the name of a point's weights with the ridge in the data."""
    return f"{RIDGE} and {point}"


def without_ridge(point: str) -> str:
    """Return the point whose twin this is, else the point itself."""
    return point.removeprefix(f"{RIDGE} and ")


def twins(points: Rows, runs: Rows, case: Case) -> list[str]:
    """Return the points that are tried once more with the ridge: those that are worse in no scenario."""
    mine = [row["point"] for row in points if row["case"] == case.name and not has_ridge(row["point"])]
    return [twin(point) for point in mine if excess(runs, case, point)[0] <= SAME]


def excess(runs: Rows, case: Case, point: str) -> tuple[float, str]:
    """Return the largest relative growth of the error without an attack on the validation recordings, and its trial.

    An error within `TINY` of the paper's has not grown.
    """
    found = []
    for trial in NOMINAL_TRIALS:
        after, before = (float(errors(runs, case.name, name, VALIDATED, trial).mean()) for name in (point, "paper"))
        grown = after > before + TINY
        found.append(((after - before) / max(before, TINY) if grown else 0.0, trial))
    return max(found)


def choose(points: Rows, runs: Rows, case: Case, ridged: bool = False) -> str:
    """Return the point that the validation recordings recommend, whatever search found it.

    The one with the least error under Algorithm 1 among those that are worse in no scenario without an attack; the
    paper's weights if there is none.

    Args:
        points, runs: rows.
        case: the experiment.
        ridged: whether the points with the ridge are meant, instead of those without.
    """
    names = [RIDGE if ridged else "paper", *(row["point"] for row in points if row["case"] == case.name)]
    names += twins(points, runs, case) if ridged else []
    fit = [name for name in names if has_ridge(name) == ridged and excess(runs, case, name)[0] <= SAME]
    fit = fit or ["paper"]
    return min(fit, key=lambda name: errors(runs, case.name, name, VALIDATED, ATTACKED_TRIAL).mean())


def candidates(points: Rows, runs: Rows, case: Case) -> dict[str, str]:
    """Return the points that are judged beside the paper's weights, and what they are called."""
    found = {choose(points, runs, case): "tuned weights", RIDGE: "paper's weights, ridge"}
    tuned = choose(points, runs, case, ridged=True)
    label = "weights tuned with the ridge" if tuned == without_ridge(tuned) else "tuned weights and the ridge"
    found |= {} if tuned in (RIDGE, "paper") else {tuned: label}
    return {name: label for name, label in found.items() if name != "paper"}


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
        lines += ["", f"## {case.title[0].upper()}{case.title[1:]}, rho {100 * case.rho:g} %", ""]
        lines += [*trial_table(case, points, runs), "", *point_table(case, points, runs), ""]
        lines += weight_lines(case, points, runs)
    path.write_text("\n".join(lines) + "\n")


def judged(runs: Rows, case: Case, names: Iterable[str]) -> dict[str, list[Verdict]]:
    """Return the verdicts of some points on the held-out recordings."""
    held_out = [row for row in runs if row["split"] == HELD_OUT]
    return {name: verdicts(held_out, case.name, "paper", name) for name in names}


def trial_table(case: Case, points: Rows, runs: Rows) -> list[str]:
    """Return the table of before and after, trial by trial, and the verdicts."""
    labels = candidates(points, runs, case)
    found = judged(runs, case, labels)
    head = ["trial", "paper's weights"]
    for label in labels.values():
        head += [label, "change", ""]
    lines = ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
    for verdicts_of_trial in zip(*found.values(), strict=True):
        cells = [verdicts_of_trial[0].trial, f"{verdicts_of_trial[0].before.mean():.4f}"]
        for verdict in verdicts_of_trial:
            cells += [f"{verdict.after.mean():.4f}", f"{verdict.change:+.4f}", verdict.says]
        lines.append("| " + " | ".join(cells) + " |")
    said = []
    if choose(points, runs, case) == "paper":
        said.append("Tuned weights without the ridge: none chosen, each is worse in some scenario without an attack.")
    for name, verdict in found.items():
        counts = ", ".join(f"{sum(v.says == word for v in verdict)} {word}" for word in ("better", "same", "worse"))
        word = "dominate" if dominates(verdict) else "do not dominate"
        said.append(f"{labels[name][0].upper()}{labels[name][1:]} ({name}): {counts}; they {word} the paper's.")
    seeds = len(next(iter(found.values()))[0].before)
    return [*lines, "", f"{seeds} recordings.", *(f"\n- {line}" for line in said)]


def point_table(case: Case, points: Rows, runs: Rows) -> list[str]:
    """Return the table of every tuned point: what its search cost, its errors on validation, and what rejects it."""
    head = ["weights", "attacked weight", "evaluations", "CPU [s]", "objective", "no attack, all scenarios"]
    head += ["Algorithm 1", "largest growth without an attack"]
    lines = ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]

    def outcome(point: str) -> list[str]:
        growth, trial = excess(runs, case, point)
        where = f"{growth:+.0%}, {trial.removesuffix(', no attack')}" if growth > 0 else "none"
        return [*(f"{value:.4f}" for value in summary(runs, case.name, point)), where]

    chosen = candidates(points, runs, case)
    for name, label in (("paper", "the paper's"), (RIDGE, "the paper's, ridge")):
        lines.append("| " + " | ".join([label, "", "", "", "", *outcome(name)]) + " |")
    order = list(METHODS)
    mine = [row for row in points if row["case"] == case.name]
    for row in sorted(mine, key=lambda row: (order.index(row["method"]), float(row["attacked_weight"]))):
        name = METHODS[row["method"]] + (", **chosen**" if row["point"] in chosen else "")
        cells = [name, f"{float(row['attacked_weight']):g}", row["evaluations"], f"{float(row['seconds']):.0f}"]
        cells += [f"{float(row['total']):.4f}" if float(row["attacked_weight"]) == 1 else ""]
        cells += outcome(row["point"])
        lines.append("| " + " | ".join(cells) + " |")
    for name in twins(points, runs, case):
        label = f"{without_ridge(name)}, ridge" + (", **chosen**" if name in chosen else "")
        lines.append("| " + " | ".join([label, "", "", "", "", *outcome(name)]) + " |")
    seeds = len(errors(runs, case.name, "paper", VALIDATED, ATTACKED_TRIAL))
    return [*lines, "", f"Errors on {seeds} validation recordings; a growth above {SAME:.0%} rejects a point."]


def weight_lines(case: Case, points: Rows, runs: Rows) -> list[str]:
    """Return the paper's and the chosen weights."""
    paper = case.paper()
    labels = {without_ridge(name): label for name, label in candidates(points, runs, case).items()}

    def line(name: str, lambdas: Sequence[float], Q: Sequence[float], R: Sequence[float]) -> str:
        cells = [name, *(f"{v:.3g}" for v in lambdas), *(", ".join(f"{v:.3g}" for v in d) for d in (Q, R))]
        return "| " + " | ".join(cells) + " |"

    lines = ["| | lambda_g | lambda_s | diagonal of Q | diagonal of R |", "|---|---|---|---|---|"]
    lines += [line("the paper's", paper[:2], paper.Q, paper.R)]
    for row in points:
        if row["case"] == case.name and row["point"] in labels:
            Q, R = ([float(v) for k, v in row.items() if k[0] == n and k[1:].isdigit()] for n in "QR")
            lines += [line(labels[row["point"]], [float(row[name]) for name in ("lambda_g", "lambda_s")], Q, R)]
    return lines
