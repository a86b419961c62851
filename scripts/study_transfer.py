"""Study: how much of an attack survives when the attacker does not know the controller; beyond the paper.

    python -m scripts.study_transfer            # about 3 minutes on two cores
    python -m scripts.study_transfer --quick    # about 30 s: two seeds, fewer windows

The settings of Figures 3 and 4 at their largest rho. The attacker plans p on a surrogate, a layer with other data,
weights or horizon than the controller's, or asks the controller itself for its inputs, so many windows at a time. What
counts is the controller's answer: the decrease of psi on windows of a recording that neither has seen, as a share of
that of Algorithm 1 with full knowledge, and on the masses the tracking error in closed loop. Every seed has a
controller, an attacker's recording and held-out windows of its own. Rows are saved as they are made; a run that is
stopped goes on where it was (--fresh and --quick begin anew). Leaves, in results/:

    transfer.csv    one row for each plant, seed and attack
    transfer.png    shares with 95 % paired bootstrap intervals over the seeds
    transfer.md     the same as tables
"""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

import torch_dpc as dpc
from scripts.experiments.case import ATTACK_SEED
from scripts.experiments.surrogates import SURROGATES, Plant, closed_loop, load, surrogate
from scripts.shared import bootstrap
from scripts.shared.command import arguments, versions
from scripts.shared.plots import note as write_note
from scripts.shared.plots import plt, style
from scripts.shared.rows import Array, Rows, read_rows
from scripts.shared.tables import Table, as_they_finish, missing

SEEDS, QUICK_SEEDS = 5, 2
FIRST_SEED = 8500  # never looked at during development
WINDOW_EVERY, QUICK_EVERY = 12, 48  # steps between held-out windows
PLANTS = ("masses", "quadrotor")
ONE_STEP, MORE_STEPS = "Algorithm 1", "projected gradient"
FULL, RANDOM = "everything", "nothing: random noise"
SEARCHES = (20, 100, 500)  # queries a window
DIRECTIONS = 10
TITLES = {"masses": "Oscillating masses", "quadrotor": "Quadrotor"}
LOOKS = {r"$\psi$, one step or search": ("o", "#d55e00"), r"$\psi$, projected gradient": ("s", "#35178c")}
LOOKS["error in closed loop"] = ("D", "#0072b2")
#: How what is known begins -> the heading it is drawn under.
GROUPS = {"everything": "everything", "other recording": "other data", "half": "other data", "150": "other data"}
GROUPS |= {"lambda_g": "other lambda_g", "lambda_s": "other lambda_s", "horizon": "other horizon or past"}
GROUPS |= {"past": "other horizon or past", "Q": "other Q", "all of it": "all of it off", "nothing": "nothing"}
HEAD = """# How much of an attack survives partial knowledge

Shares of what Algorithm 1 with full knowledge does: of its decrease of psi on held-out windows, and on the masses of
its mean tracking error in closed loop. Ratios of means over the seeds, in brackets their 95 % paired bootstrap
intervals. The attacker plans on a surrogate that differs from the controller as the line says, or knows nothing and
asks the controller for its inputs. Noise is relative to the spread of each output; with all of it off the surrogate has
another recording with 1 % of noise, horizon 20, lambda_s / 10, lambda_g x 10 and Q / 2. The cosine is that between the
attacker's p, of one step, and Algorithm 1's with full knowledge."""
ROW = ("plant", "seed", "kind", "knows", "method", "queries", "cosine", "psi", "decrease", "unsolved", "error")


def attackers(plant: Plant, victim: dpc.DPCLayer, seed: int) -> Iterator[tuple[str, str, str, Any]]:
    """Yield the kind of knowledge, what is known, the method, and the attack."""
    budget = dpc.attacks.RelativeBall(plant.rho)
    for knows, changes in SURROGATES.items():
        problem = (surrogate(plant, seed=seed, **changes), plant.cost, budget)
        yield "surrogate", knows, ONE_STEP, dpc.attacks.LinearizedAttack(*problem)
        yield "surrogate", knows, MORE_STEPS, dpc.attacks.ProjectedGradientAttack(*problem)
    yield "none", RANDOM, RANDOM, dpc.attacks.RandomAttack(budget)
    problem = (victim, plant.cost, budget)
    rough = dpc.attacks.FiniteDifferenceAttack(*problem, directions=DIRECTIONS)
    yield "queries", f"differences along {DIRECTIONS} random directions", "differences", rough
    yield "queries", "differences of every entry", "differences", dpc.attacks.FiniteDifferenceAttack(*problem)
    for queries in SEARCHES:
        attack = dpc.attacks.RandomSearchAttack(*problem, queries=queries)
        yield "queries", f"random search, {queries} queries", "search", attack


def run_seed(name: str, seed: int, every: int) -> list[dict[str, Any]]:
    """Return one row for every attack of one seed on one plant."""
    torch.set_num_threads(1)
    plant = load(name, seed, every)
    victim = surrogate(plant)
    u_ini, y_ini = plant.windows
    cost = plant.cost.at(0)
    nominal = cost(victim(u_ini, y_ini, **plant.refs))
    rows: list[dict[str, Any]] = []
    full_p = None
    for kind, knows, method, attack in attackers(plant, victim, seed):
        generator = torch.Generator().manual_seed(ATTACK_SEED + seed)
        p = attack(u_ini, y_ini, **plant.refs, generator=generator)
        full_p = p if full_p is None else full_p
        cosine = float(torch.nn.functional.cosine_similarity(p.flatten(1), full_p.flatten(1)).mean())
        plan = victim(u_ini, y_ini + p, **plant.refs, on_failure="nan")
        solved = plan.info.status == dpc.Status.SOLVED
        decrease = float((nominal - cost(plan))[solved].mean())
        queries = getattr(attack, "n_queries", 0) / len(u_ini)
        in_closed_loop = name == "masses" and (method != MORE_STEPS or knows == FULL)
        error = closed_loop(plant, victim, attack, seed)[0] if in_closed_loop else np.nan
        row: dict[str, Any] = {"plant": name, "seed": seed, "kind": kind, "knows": knows, "method": method}
        row |= {"queries": queries, "cosine": cosine}  # with Algorithm 1's p under full knowledge
        row |= {"psi": float(nominal.mean()), "decrease": decrease, "unsolved": int((~solved).sum()), "error": error}
        rows.append(row)
    return rows


def pick(rows: Rows, plant: str, knows: str, method: str, column: str) -> Array:
    """Return a column over the seeds, in their order."""
    chosen = (rows["plant"] == plant) & (rows["knows"] == knows) & (rows["method"] == method)
    return rows[column][chosen][np.argsort(rows["seed"][chosen])]


def share(rows: Rows, plant: str, knows: str, method: str, column: str) -> bootstrap.Interval | None:
    """Return a column as a share of Algorithm 1's with full knowledge [%]; None where it was not measured."""
    values, full = pick(rows, plant, knows, method, column), pick(rows, plant, FULL, ONE_STEP, column)
    if not (len(values) and np.isfinite(values).all()):
        return None
    return bootstrap.ratio(values, full).times(100)


def cell(found: bootstrap.Interval | None) -> str:
    """Return a share in percent with its interval."""
    return "-" if found is None else "{:.0f} % ({:.0f} to {:.0f})".format(*(number + 0.0 for number in found[:3]))


def cases(rows: Rows, plant: str) -> list[tuple[str, str, list[str]]]:
    """Return the kind, the knowledge and the methods of every line of a table or plot, in order."""
    seen: dict[str, tuple[str, list[str]]] = {}
    for kind, knows, method in zip(rows["kind"], rows["knows"], rows["method"], strict=True):
        methods = seen.setdefault(knows, (kind, []))[1]
        if method not in methods:
            methods.append(method)
    return [(kind, knows, methods) for knows, (kind, methods) in seen.items()]


def table(rows: Rows, plant: str) -> list[str]:
    """Return the lines of one plant's table."""
    psi, decrease, error = (pick(rows, plant, FULL, ONE_STEP, column).mean() for column in ("psi", "decrease", "error"))
    has_error = bool(np.isfinite(error))
    text = f"Without an attack psi is {psi:.3g}; Algorithm 1 takes {decrease:.3g} from it"
    text += f", and leaves a mean error of {error:.3g} m in closed loop." if has_error else "."
    head = ["the attacker has", "queries a window", "cosine", "psi: one step or search", "psi: projected gradient"]
    head += ["error in closed loop, one step or search"] * has_error
    lines = [f"## {TITLES[plant]}", "", text, "", "| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for _, knows, methods in cases(rows, plant):
        first = methods[0]
        cells = [knows, f"{pick(rows, plant, knows, first, 'queries').mean():.0f}"]
        cells += [f"{pick(rows, plant, knows, first, 'cosine').mean():.2f}"]
        cells += [cell(share(rows, plant, knows, method, "decrease")) for method in (first, MORE_STEPS)]
        cells += [cell(share(rows, plant, knows, first, "error"))] * has_error
        lines.append("| " + " | ".join(cells) + " |")
    if has_error:
        more = cell(share(rows, plant, FULL, MORE_STEPS, "error"))
        lines += ["", f"In closed loop projected gradient with full knowledge makes {more} of Algorithm 1's error."]
    return [*lines, "", f"Windows without a plan, left out: {int(rows['unsolved'][rows['plant'] == plant].sum())}."]


def group_of(knows: str) -> str:
    """Return the heading under which a kind of knowledge is drawn."""
    for start, group in GROUPS.items():
        if knows.startswith(start):
            return group
    return "the controller's answers alone"


def as_formula(text: str) -> str:
    """Return a name with its lambdas as matplotlib sets them."""
    return re.sub(r"lambda_(\w)", r"$\\lambda_\1$", text).replace(" x ", " × ")


def places_of(axes: Any, lines: list[tuple[str, str, list[str]]]) -> list[float]:
    """Return where each line is drawn, and write the headings of groups of several lines."""
    groups = [group_of(knows) for _, knows, _ in lines]
    places: list[float] = []
    place = -1.0
    for i, group in enumerate(groups):
        place += 1
        if i == 0 or groups[i - 1] != group:
            place += 0.3 if i else 0.0
            if groups.count(group) > 1:
                look = {"transform": axes.get_yaxis_transform(), "ha": "right", "va": "center", "weight": "bold"}
                axes.text(-0.02, place, as_formula(group), **look)
                place += 1
        places.append(place)
    return places


def plot(path: Path, rows: Rows) -> None:
    """Draw the shares, one panel a plant, one line a kind of knowledge under the heading of its group."""
    style()
    lines = cases(rows, PLANTS[0])
    figure, panels = plt.subplots(1, 2, figsize=(9.0, 9.6), sharey=True, width_ratios=(1.2, 1))
    places = places_of(panels[0], lines)
    for axes, plant in zip(panels, PLANTS, strict=True):
        for place, (_, knows, methods) in zip(places, lines, strict=True):
            drawn = [(methods[0], "decrease", -0.25), (MORE_STEPS, "decrease", 0.0), (methods[0], "error", 0.25)]
            for (method, column, shift), (marker, colour) in zip(drawn, LOOKS.values(), strict=True):
                found = share(rows, plant, knows, method, column)
                if found is not None:
                    axes.hlines(place + shift, found.low, found.high, color=colour, linewidth=1.2)
                    axes.plot(found.value, place + shift, marker, color=colour, markersize=4)
        axes.axvline(100, color="black", linewidth=0.8, linestyle=(0, (4, 2)))
        axes.axvline(0, color="black", linewidth=0.8)
        axes.set_title(TITLES[plant])
        axes.grid(axis="y", visible=False)
    panels[0].set_yticks(places, [as_formula(knows) for _, knows, _ in lines])
    figure.supxlabel("share of what Algorithm 1 does with full knowledge [%]", fontsize=10)
    write_note(panels[1], f"{len(np.unique(rows['seed']))} seeds, bars: 95 %\npaired bootstrap\ninterval", "lower left")
    panels[0].set_ylim(places[-1] + 0.7, -0.7)
    for name, (marker, colour) in LOOKS.items():
        panels[0].plot([], [], marker, color=colour, markersize=4, label=name)
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper center", ncols=3)
    figure.savefig(path)
    plt.close(figure)


def main(argv: list[str] | None = None) -> None:
    parser = arguments(__doc__, seeds=SEEDS)
    parser.add_argument("--quick", action="store_true", help="two seeds and a quarter of the windows")
    parser.add_argument("--fresh", action="store_true", help="forget what was measured before")
    args = parser.parse_args(argv)
    out: Path = args.out
    out.mkdir(parents=True, exist_ok=True)
    seeds, every = (QUICK_SEEDS, QUICK_EVERY) if args.quick else (args.seeds, WINDOW_EVERY)
    path, began = out / "transfer.csv", time.perf_counter()
    if args.fresh or args.quick:
        path.unlink(missing_ok=True)
    measured = Table(path, ROW)

    pairs = [(plant, seed) for seed in range(FIRST_SEED, FIRST_SEED + seeds) for plant in dict.fromkeys(PLANTS)]
    jobs = [(*pair, every) for pair in missing(measured, pairs)]
    for found in tqdm(as_they_finish(run_seed, jobs, args.workers), total=len(jobs), desc="Transfer", unit="seed"):
        measured.add(found)

    rows, note = read_rows(path), versions(seeds, args.workers, FIRST_SEED)
    plot(out / "transfer.png", rows)
    body = [line for plant in PLANTS for line in ("", *table(rows, plant))]
    (out / "transfer.md").write_text("\n".join([HEAD, "", f"{note}.", *body]) + "\n")
    print(f"Transfer: {out / 'transfer.md'}, {time.perf_counter() - began:.0f} s")


if __name__ == "__main__":
    main()
