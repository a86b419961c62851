"""Figure and tables of tune_regularization.py."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.ticker import LogLocator, NullLocator

from scripts.experiments.case import Case
from scripts.regularization.search import METHODS
from scripts.shared.plots import percent, plt, style

HELD_OUT, VALIDATED = "held out", "validation"
ALLOWED = 1.10  # of the paper's nominal error
LOWER = 0.99  # of the paper's attacked error: less than one per cent lower counts as the same
ZERO = 1e-6  # [m]: a nominal error below this is none
LOOKS = {
    "attack": ("#d55e00", "o"),
    "danskin": ("#0072b2", "s"),
    "lambdas": ("#009e73", "D"),
    "tpe": ("#cc79a7", "^"),
    "cmaes": ("#e69f00", "v"),
    "both": ("#56b4e9", "P"),
}
SHADE = "#009e73"
ATTACKS = {"nominal": "no attack", "random": "random noise", "algorithm1": "Algorithm 1", "other": "another target"}
Rows = list[dict[str, str]]


def errors(runs: Rows, case: str, point: str, split: str, attack: str, rho: float) -> np.ndarray:
    """Return the error of each recording, in the order of the seeds."""
    keys = {"case": case, "point": point, "split": split, "attack": attack, "rho": f"{rho:.9g}"}
    chosen = {int(r["seed"]): float(r["error"]) for r in runs if all(r[k] == v for k, v in keys.items())}
    return np.array([chosen[seed] for seed in sorted(chosen)])


def pair(runs: Rows, case: Case, point: str, split: str = HELD_OUT) -> tuple[np.ndarray, np.ndarray]:
    """Return the nominal and the attacked errors of a point."""
    nominal, attacked = (
        errors(runs, case.name, point, split, *a) for a in (("nominal", 0.0), ("algorithm1", case.rho))
    )
    return nominal, attacked


def allowed(runs: Rows, case: Case, split: str) -> float:
    """Return the largest nominal error that a point may have to dominate."""
    return max(ALLOWED * pair(runs, case, "paper", split)[0].mean(), ZERO)


def choose(points: Rows, runs: Rows, case: Case) -> str:
    """Return the point that the validation recordings recommend, whatever search found it."""
    limit = allowed(runs, case, VALIDATED)
    candidates = {}
    for row in points:
        if row["case"] == case.name:
            nominal, attacked = (e.mean() for e in pair(runs, case, row["point"], VALIDATED))
            candidates[row["point"]] = (nominal > limit, attacked)
    return min(candidates, key=lambda name: candidates[name])


def write_report(stem: Path, cases: Sequence[Case], points: Rows, course: Rows, runs: Rows, note: str) -> None:
    """Draw the figure and write the tables."""
    draw(stem.with_suffix(".png"), cases, points, course, runs)
    lines = [
        "# Weights that hold under attack",
        "",
        f"{note}. Errors are means over a run in closed loop [m], then over held-out recordings, with the smallest and "
        "the largest recording in brackets; the attacker knows the weights. A point dominates when its attacked error "
        f"is below the paper's by {1 - LOWER:.0%} or more, at no more than {ALLOWED - 1:.0%} more nominal error. The "
        "chosen point is the one with the least attacked error within that limit on other, validation recordings.",
    ]
    for case in cases:
        lines += ["", *case_lines(case, points, runs)]
    stem.with_suffix(".md").write_text("\n".join(lines) + "\n")


def case_lines(case: Case, points: Rows, runs: Rows) -> list[str]:
    """Return the tables of one case."""
    chosen, mine = choose(points, runs, case), [row for row in points if row["case"] == case.name]
    lines = [f"## {case.title[0].upper()}{case.title[1:]}, Algorithm 1 at {percent(case.rho)}", ""]
    lines += [
        "| weights | attacked weight | evaluations | CPU [s] | objective | no attack | Algorithm 1 | "
        "times the paper's | recordings with less | dominates |",
        "|---|---|---|---|---|---|---|---|---|---|",
        "| the paper's | | | | | " + " | ".join(map(cell, pair(runs, case, "paper"))) + " | | | |",
    ]
    paper = pair(runs, case, "paper")
    order = list(METHODS)
    for row in sorted(mine, key=lambda row: (order.index(row["method"]), float(row["attacked_weight"]))):
        nominal, attacked = pair(runs, case, row["point"])
        dominates = attacked.mean() < LOWER * paper[1].mean() and nominal.mean() <= allowed(runs, case, HELD_OUT)
        name = METHODS[row["method"]] + (", **chosen**" if row["point"] == chosen else "")
        cells = [name, f"{float(row['attacked_weight']):g}", row["evaluations"], f"{float(row['seconds']):.0f}"]
        cells += [f"{float(row['total']):.4f}" if float(row["attacked_weight"]) == 1 else ""]
        cells += [cell(nominal), cell(attacked), f"{attacked.mean() / paper[1].mean():.2f}"]
        cells += [f"{int((attacked < paper[1]).sum())} of {len(attacked)}", "yes" if dominates else "no"]
        lines.append("| " + " | ".join(cells) + " |")
    best = best_of_grid(case, runs)
    lines += ["", best, "", *other_attacks(case, chosen, runs), "", *weight_lines(case, chosen, mine)]
    return lines


def best_of_grid(case: Case, runs: Rows) -> str:
    """Return, in words, how far lambda_g and lambda_s alone get on the grid."""
    names = sorted({r["point"] for r in runs if r["case"] == case.name and r["point"].startswith("grid")})
    seeds = len(pair(runs, case, names[0])[0])
    paper = [e[:seeds].mean() for e in pair(runs, case, "paper")]
    means = {name: [e.mean() for e in pair(runs, case, name)] for name in names}
    fits = {name: a for name, (n, a) in means.items() if n <= max(ALLOWED * paper[0], ZERO)}
    best = min(fits, key=lambda name: fits[name])
    _, g, s = best.split()
    return (
        f"On the grid of {len(names)} pairs of lambda_g and lambda_s with the paper's Q and R ({seeds} recordings), "
        f"the least attacked error within {ALLOWED - 1:.0%} more nominal error is {fits[best]:.4f} m, at "
        f"lambda_g = {float(g):g} and lambda_s = {float(s):g}; the paper's weights have {paper[1]:.4f} m there."
    )


def other_attacks(case: Case, chosen: str, runs: Rows) -> list[str]:
    """Return the table of attacks that were not tuned against, beside the one that was."""
    target = ", ".join(f"{v:g}" for v in case.other_target.tolist())
    lines = [
        f"Other attacks on the paper's and the chosen weights; another target is Algorithm 1 towards u = ({target}):",
        "",
        "| attack | rho | the paper's | chosen | ratio |",
        "|---|---|---|---|---|",
    ]
    for attack in ("random", "algorithm1", "other"):
        for rho in case.rhos:
            before, after = (errors(runs, case.name, p, HELD_OUT, attack, rho) for p in ("paper", chosen))
            ratio = f"{after.mean() / before.mean():.2f}"
            cells = [ATTACKS[attack], percent(rho), cell(before), cell(after), ratio]
            lines.append("| " + " | ".join(cells) + " |")
    return lines


def weight_lines(case: Case, chosen: str, points: Rows) -> list[str]:
    """Return the paper's and the chosen weights."""
    (row,) = (row for row in points if row["point"] == chosen)
    paper, columns = case.paper(), ("lambda_g", "lambda_s")
    Q, R = ([float(v) for k, v in row.items() if k[0] == n and k[1:].isdigit()] for n in "QR")

    def line(name: str, lambdas: Sequence[float], Q: Sequence[float], R: Sequence[float]) -> str:
        cells = [name, *(f"{v:.3g}" for v in lambdas), *(", ".join(f"{v:.3g}" for v in d) for d in (Q, R))]
        return "| " + " | ".join(cells) + " |"

    return [
        "| | lambda_g | lambda_s | diagonal of Q | diagonal of R |",
        "|---|---|---|---|---|",
        line("the paper's", paper[:2], paper.Q, paper.R),
        line("chosen", [float(row[c]) for c in columns], Q, R),
    ]


def cell(values: np.ndarray) -> str:
    """Return mean (smallest to largest)."""
    if values.max() < ZERO:
        return "0"
    return f"{values.mean():.4f} ({values.min():.4f} to {values.max():.4f})"


def draw(path: Path, cases: Sequence[Case], points: Rows, course: Rows, runs: Rows) -> None:
    """Draw the front and the course of the searches of each case."""
    style()
    if len(cases) == 1:
        figure, panels = plt.subplots(1, 2, figsize=(8.6, 4.6))
        columns = [tuple(panels)]
    else:
        figure, panels = plt.subplots(2, len(cases), figsize=(4.4 * len(cases), 7.2))
        columns = list(panels.T)
    for (front, descent), case in zip(columns, cases, strict=True):
        draw_front(front, case, points, runs)
        draw_course(descent, case, course)
    handles, labels = columns[-1][0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=2, fontsize=9)
    figure.savefig(path)
    plt.close(figure)


def draw_front(axes: Any, case: Case, points: Rows, runs: Rows) -> None:
    """Draw nominal against attacked error on the held-out recordings."""
    groups = {"grid": sorted({r["point"] for r in runs if r["case"] == case.name and r["point"].startswith("grid")})}
    groups["paper"] = ["paper"]
    for method in LOOKS:
        names = [row["point"] for row in points if row["case"] == case.name and row["method"] == method]
        if names:
            groups[method] = names
    means = {key: np.array([[e.mean() for e in pair(runs, case, n)] for n in names]) for key, names in groups.items()}
    nominal, attacked = means["paper"][0]
    axes.set(title=case.title, ylabel=f"error under Algorithm 1 at {percent(case.rho)} [m]")
    if nominal > ZERO:
        spread_of = np.concatenate(list(means.values()))
        shade(axes, allowed(runs, case, HELD_OUT), attacked, spread_of)
        axes.set_xlabel("error without attack [m]")
    else:  # one value for all: side by side
        for i, values in enumerate(means.values()):
            values[:, 0] = i
        axes.axhspan(0, attacked, color=SHADE, alpha=0.1, linewidth=0)
        axes.set(xlabel="error without attack: 0 for all", xticks=[], ylim=(0, 1.25 * attacked))
    for key, values in means.items():
        axes.plot(*values.T, **look(key))


def shade(axes: Any, limit: float, attacked: float, points: np.ndarray) -> None:
    """Set the axes, logarithmic where the points are far apart, and shade where a point dominates."""
    wide = points.max(axis=0) > 5 * points.min(axis=0)
    low = np.where(wide, 0.7 * points.min(axis=0), 0.0)
    high = np.where(wide, 1.4 * points.max(axis=0), 1.15 * points.max(axis=0))
    for axis, name in enumerate("xy"):
        axes.set(**{f"{name}scale": "log" if wide[axis] else "linear", f"{name}lim": (low[axis], high[axis])})
        if wide[axis]:
            scale = getattr(axes, f"{name}axis")
            scale.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            scale.set_minor_locator(NullLocator())
            scale.set_major_formatter(lambda value, _: f"{value:g}")
    axes.fill_between([low[0], limit], low[1], attacked, color=SHADE, alpha=0.1, linewidth=0)
    axes.annotate("dominates", (low[0], low[1]), (6, 6), textcoords="offset points", fontsize=9, color="#00664a")


def look(group: str) -> dict[str, Any]:
    """Return how the points of a group are drawn."""
    if group == "grid":
        label = r"grid over $\lambda_g$, $\lambda_s$, the paper's Q and R"
        return {"linestyle": "", "marker": ".", "color": "0.6", "label": label}
    if group == "paper":
        return {"linestyle": "", "marker": "*", "color": "black", "markersize": 13, "label": "the paper's weights"}
    colour, marker = LOOKS[group]
    label = METHODS[group].replace("lambda_g", r"$\lambda_g$").replace("lambda_s", r"$\lambda_s$")
    edge = {"markeredgecolor": "white", "markersize": 8}
    return {"linestyle": "", "marker": marker, "color": colour, "label": label, **edge}


def draw_course(axes: Any, case: Case, course: Rows) -> None:
    """Draw the best objective so far against the processor time, for equal weights of both costs."""
    for method, (colour, _) in LOOKS.items():
        rows = [row for row in course if row["case"] == case.name and row["point"] == f"{method} 1"]
        if not rows:
            continue
        last = {int(row["evaluation"]): row for row in rows}  # a search that was killed may have left rows
        seconds = [float(row["seconds"]) for row in last.values()]
        best = np.minimum.accumulate([float(row["total"]) for row in last.values()])
        axes.step(seconds, best, where="post", color=colour)
    axes.set(xlabel="processor time [s]", ylabel="nominal + attacked objective [m]", ylim=(0, None))
