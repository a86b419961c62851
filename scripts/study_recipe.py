"""Study: what decides the factor between Algorithm 1 and random noise on the quadrotor; beyond the paper.

    python -m scripts.study_recipe              # about 10 minutes on two cores
    python -m scripts.study_recipe --quick      # about 1 minute: two seeds, no fresh ones

The paper says that Algorithm 1 increases the tracking error "by more than ten times" against random noise, and does not
say how the data were recorded, how high and how fast the circle is flown, or what u_ref is. Every line changes one or
two of these in the setting of Figure 4 and flies it without an attack, under random noise and under Algorithm 1 at
0.3 %. Ten seeds make the table; ten fresh ones see whether it holds. Rows are saved as they are made: a run that is
stopped goes on where it was (`--fresh` begins anew). Leaves, in results/:

    study_recipe.csv        one row a flight
    study_recipe.md, .png   the table, and what decides the factor
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from tqdm import tqdm

from scripts.experiments.quadrotor import Quadrotor
from scripts.shared import bootstrap
from scripts.shared.command import arguments, versions
from scripts.shared.plots import note as write_note
from scripts.shared.plots import plt, style
from scripts.shared.rows import Array
from scripts.shared.statistics import BAND, NOMINAL, POISON, RANDOM, band
from scripts.shared.tables import Table, as_they_finish

PAPER = Quadrotor()
WIDE = {"y_min": (-2.0, -2.0, 0.0, *3 * [-math.pi / 2]), "y_max": (2.0, 2.0, 2.0, *3 * [math.pi / 2])}  # [m, rad]
CLAIM = 10.0  # the paper's "more than ten times"
FRESH_FROM = 5000  # seeds that were never looked at during development
COLUMNS = ("variation", "seed", "attack", "error", "largest", "crashed", "unsolved")
LOOKS = {"ratio": ("o", "#0072b2", "error / error"), "added": ("s", "#d55e00", "added error / added error")}


class Variation(NamedTuple):
    """One line of the study: its group, its name, and the numbers of the setting that it changes."""

    group: str
    name: str
    changes: dict[str, Any]

    @property
    def key(self) -> str:
        """What the rows are filed under."""
        return f"{self.group}: {self.name}"


VARIATIONS = (
    Variation("paper's setting", "every 10 steps, our choices", {}),
    Variation("replanning", "every 5 steps", {"replan_every": 5}),
    Variation("replanning", "every 2 steps", {"replan_every": 2}),
    Variation("replanning", "every step", {"replan_every": 1}),
    Variation("u_ref = circle's velocity", "every 10 steps", {"u_ref": None}),
    Variation("u_ref = circle's velocity", "every 5 steps", {"u_ref": None, "replan_every": 5}),
    Variation("u_ref = circle's velocity", "every step", {"u_ref": None, "replan_every": 1}),
    Variation("attitude bound", "pi/2 for pi/8", WIDE),
    Variation("height", "0.8 m", {"height": 0.8}),
    Variation("height", "1.5 m", {"height": 1.5}),
    Variation("period", "5 s", {"period": 5.0}),
    Variation("period", "20 s", {"period": 20.0}),
    Variation("recorded commands", "0.25 m/s", {"amplitude": 0.25}),
    Variation("recorded commands", "0.25 m/s, every step", {"amplitude": 0.25, "replan_every": 1}),
    Variation("recorded commands", "held 5 steps", {"hold": 5}),
    Variation("recorded commands", "held 20 steps", {"hold": 20}),
    Variation("recorded commands", "pull 0.2 / s", {"pull": 0.2}),
    Variation("recorded commands", "pull 0.6 / s", {"pull": 0.6}),
    Variation("noise in the recording", "1e-5 of the spread", {"noise": 1e-5}),
    Variation("noise in the recording", "1e-4", {"noise": 1e-4}),
    Variation("noise in the recording", "1e-3", {"noise": 1e-3}),
    Variation("noise in the recording", "1e-3, every step", {"noise": 1e-3, "replan_every": 1}),
    Variation("noise in the recording", "1e-2", {"noise": 1e-2}),
    Variation("physics", "200 Hz", {"physics_hz": 200}),
    Variation("physics", "500 Hz", {"physics_hz": 500}),
)


def fly(variation: Variation, seed: int) -> list[dict[str, Any]]:
    """Return one row for each flight of one seed: no attack, random noise, Algorithm 1."""
    torch.set_num_threads(1)
    case, rows = replace(PAPER, **variation.changes), []
    with case.system() as plant:
        layer = case.layer(case.data(plant, seed))
        for attack in (NOMINAL, RANDOM, POISON):
            run = case.run(plant, layer, seed, attack, case.rho)
            crashed = bool(plant.down[-1])
            keys = {"variation": variation.key, "seed": seed, "attack": attack, "crashed": int(crashed)}
            rows.append(keys | run._asdict())
    return rows


class Errors(NamedTuple):
    """The mean error of each seed [m], `(seeds,)`, and how many flights crashed or had plans without a solution."""

    nominal: Array
    random: Array
    poison: Array
    crashed: int
    unsolved: int

    @property
    def by_seed(self) -> Array:
        """The factor of each seed, `(seeds,)`."""
        return self.poison / self.random


def errors_of(rows: Sequence[dict[str, str]], variation: Variation, seeds: Sequence[int]) -> Errors:
    """Return the errors of one variation on some seeds, in their order."""
    mine = [row for row in rows if row["variation"] == variation.key and int(row["seed"]) in set(seeds)]
    found = {(row["attack"], int(row["seed"])): float(row["error"]) for row in mine}
    nominal, random, poison = (np.array([found[a, seed] for seed in seeds]) for a in (NOMINAL, RANDOM, POISON))
    crashed, unsolved = (sum(int(row[name]) for row in mine) for name in ("crashed", "unsolved"))
    return Errors(nominal, random, poison, crashed, unsolved)


def added(e: Errors) -> bootstrap.Interval | None:
    """Return how many times as much Algorithm 1 adds; None where random noise does not clearly add anything."""
    if bootstrap.difference(e.random, e.nominal).low <= 0:
        return None
    return bootstrap.added_ratio(e.poison, e.random, e.nominal)


def reproduced(e: Errors, f: Errors) -> bool:
    """Return whether the median factor of fresh seeds lies within the band over the first ones."""
    _, low, high = band(e.by_seed)
    return bool(low <= np.median(f.by_seed) <= high)


def cell(value: bootstrap.Interval | None) -> str:
    """Return an interval, or why there is none."""
    return "random adds nothing" if value is None else f"{value:.1f}"


def table(rows: Sequence[dict[str, str]], seeds: Sequence[int], fresh: Sequence[int]) -> list[str]:
    """Return the lines of the table."""
    head = ["setting", "no attack [m]", "random noise [m]", "Algorithm 1 [m]", "error / error", "seeds above 10"]
    head += ["added / added", "crashes", "plans without a solution"]
    head += ["fresh seeds: error / error", "added / added", "inside the band"] if fresh else []
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for variation in VARIATIONS:
        e = errors_of(rows, variation, seeds)
        cells = [variation.key, *(f"{values.mean():.4f}" for values in e[:3])]
        cells += [f"{bootstrap.ratio(e.poison, e.random):.1f}", f"{int((e.by_seed > CLAIM).sum())} of {len(seeds)}"]
        cells += [cell(added(e)), str(e.crashed), str(e.unsolved)]
        if fresh:
            f = errors_of(rows, variation, fresh)
            cells += [f"{bootstrap.ratio(f.poison, f.random):.1f}", cell(added(f))]
            cells += ["yes" if reproduced(e, f) else "no"]
        lines.append("| " + " | ".join(cells) + " |")
    if fresh:
        both = [(errors_of(rows, v, seeds), errors_of(rows, v, fresh)) for v in VARIATIONS]
        lines += ["", f"Inside the band: {sum(reproduced(e, f) for e, f in both)} of {len(both)} settings."]
        lines += ["", *pooled(rows, [*seeds, *fresh])]
    return lines


def pooled(rows: Sequence[dict[str, str]], seeds: Sequence[int]) -> list[str]:
    """Return the lines of the table of both factors over all seeds together."""
    lines = [f"| all {len(seeds)} seeds | error / error | seeds above 10 | added / added |", "|---|---|---|---|"]
    for variation in VARIATIONS:
        e = errors_of(rows, variation, seeds)
        cells = [variation.key, f"{bootstrap.ratio(e.poison, e.random):.1f}", str(int((e.by_seed > CLAIM).sum()))]
        lines.append("| " + " | ".join([*cells, cell(added(e))]) + " |")
    return lines


def plot(path: Path, rows: Sequence[dict[str, str]], seeds: Sequence[int], fresh: Sequence[int]) -> None:
    """Draw both factors of every variation with their intervals, grouped by what is changed; fresh seeds hollow."""
    style()
    groups = list(dict.fromkeys(variation.group for variation in VARIATIONS))
    figure, axes = plt.subplots(figsize=(8.4, 9.6))
    places, names, place = [], [], 0.0
    for group in groups:
        axes.text(-0.02, place, group, transform=axes.get_yaxis_transform(), ha="right", va="center", weight="bold")
        place += 1
        for variation in (v for v in VARIATIONS if v.group == group):
            for some, shift in ((seeds, -0.1), (fresh, 0.1)) if fresh else ((seeds, 0.0),):
                e = errors_of(rows, variation, some)
                found = {"ratio": bootstrap.ratio(e.poison, e.random), "added": added(e)}
                for lower, (kind, value) in zip((-0.2, 0.2), found.items(), strict=True):
                    marker, colour, _ = LOOKS[kind]
                    if value is not None:
                        face = colour if some is seeds else "white"
                        axes.hlines(place + lower + shift, value.low, value.high, color=colour, linewidth=1.2)
                        axes.plot(
                            value.value, place + lower + shift, marker, color=colour, markersize=4, markerfacecolor=face
                        )
            places.append(place)
            names.append(variation.name)
            place += 1
        axes.axhline(place - 0.5, color="0.8", linewidth=0.6)
    axes.axvline(CLAIM, color="black", linewidth=1, linestyle=(0, (4, 2)))
    axes.annotate('the paper: "more than ten times"', (CLAIM, -0.9), (4, 0), textcoords="offset points", va="center")
    axes.set(xscale="log", ylim=(place - 0.5, -1.4), xlabel="Algorithm 1 / random noise, both at 0.3 %")
    axes.set_yticks(places, names)
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.set_xticks((1, 2, 5, 10, 20, 50))
    axes.minorticks_off()
    for marker, colour, label in LOOKS.values():
        axes.plot([], [], marker, color=colour, linestyle="-", label=label)
    figure.legend(*axes.get_legend_handles_labels(), loc="outside upper center", ncols=2)
    text = f"ratio of means over {len(seeds)} seeds;\nbars: 95 % paired bootstrap interval"
    write_note(axes, text + (f";\nhollow: {len(fresh)} fresh seeds" if fresh else ""), "lower right")
    figure.savefig(path)
    plt.close(figure)


def main(argv: list[str] | None = None) -> None:
    parser = arguments(__doc__)
    parser.add_argument("--quick", action="store_true", help="two seeds, no fresh ones")
    parser.add_argument("--fresh", action="store_true", help="forget what was flown before")
    args = parser.parse_args(argv)
    out: Path = args.out
    out.mkdir(parents=True, exist_ok=True)
    seeds = range(2 if args.quick else args.seeds)
    fresh = range(0) if args.quick else range(FRESH_FROM, FRESH_FROM + args.seeds)
    if args.fresh:
        (out / "study_recipe.csv").unlink(missing_ok=True)
    flown, began = Table(out / "study_recipe.csv", COLUMNS), time.perf_counter()

    done = {(row["variation"], int(row["seed"])) for row in flown.rows()}
    jobs = [(v, seed) for seed in (*seeds, *fresh) for v in VARIATIONS if (v.key, seed) not in done]
    for rows in tqdm(as_they_finish(fly, jobs, args.workers), total=len(jobs), desc="Recipe", unit="seed"):
        flown.add(rows)

    note = versions(len(seeds), args.workers)
    lines = ["# What decides the factor between Algorithm 1 and random noise", "", f"{note}."]
    lines += [f"Fresh seeds: {FRESH_FROM} to {fresh[-1]}." if fresh else "No fresh seeds.", ""]
    lines += [
        "Ratios are of means over the seeds, with 95 % paired bootstrap intervals. Added is the error less that of",
        "the same seed without an attack; where its interval under random noise includes 0, random adds nothing. The",
        f"band holds the factors of the seeds, {BAND[0]}th to {BAND[1]}th percentile; inside means that the median of",
        "the fresh seeds lies within it. A crashed vehicle counts as lying where it crashed.",
        "",
        *table(flown.rows(), seeds, fresh),
    ]
    (out / "study_recipe.md").write_text("\n".join(lines) + "\n")
    plot(out / "study_recipe.png", flown.rows(), seeds, fresh)
    print(f"Recipe: {out / 'study_recipe.md'}, {time.perf_counter() - began:.0f} s")


if __name__ == "__main__":
    main()
