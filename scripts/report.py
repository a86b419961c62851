"""Gather what the figure and table scripts left into results/report.md.

Command: `python -m scripts.report`, after the other scripts; it takes a second.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from scripts.shared.command import RESULTS
from scripts.shared.plots import percent

FIGURES = {
    "figure3_masses": (
        "Figure 3: oscillating masses",
        "Tracking error of the first mass, in m. The recorded data are noise-free and Algorithm 1 is deterministic, so "
        "its runs differ by rounding alone from seed to seed. The nominal solution lies on the input bound: those rows "
        "are weakly active, and Algorithm 1's gradient counts them as free (`info.n_weakly_active`).",
        ["figure3_masses.png"],
    ),
    "figure4_quadrotor": (
        "Figure 4: quadrotor in PyBullet",
        "Distance between the vehicle and its reference, in m. The budget is relative to the measured window, and so "
        "to the origin of the coordinates: at 1 m height 0.3 % allows 7.7 mm over the six samples of a window. Without "
        "an attack the error is a lag, the price of the weight R on the velocity command. A crashed vehicle counts as "
        "lying where it crashed.",
        ["figure4_quadrotor.png", "figure4_paths.png", "figure4_flight.gif"],
    ),
}


CLAIMS = [
    "## The paper's claims beside ours",
    "",
    "| the paper says | ours | where it holds |",
    "|---|---|---|",
]


def spread(numbers: dict[str, float]) -> str:
    """Return the mean over the seeds and, in brackets, the extremes."""
    return f"{numbers['mean']:.4f} ({numbers['min']:.4f} to {numbers['max']:.4f})"


def times(ratio: float | None, interval: list[float] | None) -> str:
    """Return a ratio of means and, in brackets, its confidence interval."""
    if ratio is None:
        return "random adds nothing"
    return f"{ratio:.1f}" + (f" ({interval[0]:.1f} to {interval[1]:.1f})" if interval else "")


def table(result: dict[str, Any]) -> list[str]:
    """Return the lines of a figure's table."""
    lines = [
        "| rho | random noise | Algorithm 1 | ratio | added by random | added by Algorithm 1 | ratio of added |",
        "|---|---|---|---|---|---|---|",
    ]
    for level in result["levels"]:
        cells = [
            percent(level["rho"]),
            spread(level["random"]),
            spread(level["poison"]),
            times(level["ratio"], level["ratio_interval"]),
            spread(level["added_random"]),
            spread(level["added_poison"]),
            times(level["added_ratio"], level["added_ratio_interval"]),
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return lines


def claims(folder: Path) -> list[str]:
    """Return the lines of the table of what the paper claims and what we find."""
    rows = []
    masses, quadrotor = (_read(folder / f"{name}.json") for name in FIGURES)
    if masses:
        last = masses["levels"][-1]
        ours = f"{last['random']['mean']:.4f} and {last['poison']['mean']:.4f} m at {percent(last['rho'])}"
        ours += f", factor {times(last['ratio'], last['ratio_interval'])}; largest {masses['largest']:.3f} m"
        rows.append(("Figure 3: errors on axes from 0 to 0.1 m, Algorithm 1 above random noise", ours, "at every rho"))
    if quadrotor:
        last = quadrotor["levels"][-1]
        ours = f"error / error {times(last['ratio'], last['ratio_interval'])}; "
        ours += f"added error / added error {times(last['added_ratio'], last['added_ratio_interval'])}"
        where = f"in the added error, at {percent(last['rho'])} and our choices where the paper is silent; "
        where += "in the raw error it depends on the replanning interval and u_ref (scripts/study_recipe.py)"
        claim = 'Figure 4: Algorithm 1 "increases the tracking error by more than ten times" against random noise'
        rows.append((claim, ours, where))
    if (folder / "table1_sizes.csv").exists():
        ours = (folder / "table1_sizes.csv").read_text().splitlines()[1].split(",")[1]
        rows.append(("Table I: CVXPYlayers solves 1799 unknowns on the masses at horizon 25", ours, "as printed"))
    return ["", *CLAIMS, *("| " + " | ".join(row) + " |" for row in rows)] if rows else []


def _read(path: Path) -> dict[str, Any] | None:
    return json.loads(path.read_text()) if path.exists() else None


def counts(result: dict[str, Any]) -> list[str]:
    """Return what went wrong, counted, and what else a script has to say."""
    lines = [f"- Plans without a solution: {result['unsolved']}."]
    if "crashes" in result:
        crashed = [f"{count} of {result['seeds']} ({kind})" for kind, count in result["crashes"].items() if count]
        lines.append(f"- Crashes: {', '.join(crashed) or 'none'}.")
    if "settled" in result:
        pairs = zip(result["levels"], result["settled"]["random"], result["settled"]["algorithm1"], strict=True)
        means = "; ".join(f"{percent(level['rho'])}: {random:.4f} and {poison:.4f}" for level, random, poison in pairs)
        lines.append(f"- Mean from {result['settled_from']:g} s on, random and Algorithm 1: {means}.")
        lines.append(f"- Largest error of any run: {result['largest']:.3f} m.")
    return lines


def figure_section(folder: Path, name: str) -> list[str]:
    """Return the lines about one figure."""
    title, remark, pictures = FIGURES[name]
    result = _read(folder / f"{name}.json")
    if result is None:
        return ["", f"## {title}", "", f"Not made: run `python -m scripts.{name}`."]
    lines = ["", f"## {title}", "", remark, ""]
    lines += [f"![{picture}]({picture})" for picture in pictures if (folder / picture).exists()]
    lines += ["", f"No attack: {spread(result['nominal'])}.", "", *table(result), "", *counts(result)]
    return lines + [f"- {result['versions']}; {result['seconds']:.0f} s."]


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder of the results (default results/)")
    out: Path = parser.parse_args(argv).out
    lines = [
        "# Results",
        "",
        "Errors are means over the time of a run; a number is the mean over the seeds, with the smallest and the "
        "largest seed in brackets. Ratios are of those means, with 95 % paired bootstrap intervals over the seeds. "
        "What an attack adds is its error less that of the same seed without an attack.",
    ]
    lines += claims(out)
    for name in FIGURES:
        lines += figure_section(out, name)
    for name in ("table1_sizes", "study_recipe", "study_noise", "study_printed_system", "study_sensitivity"):
        if (out / f"{name}.md").exists():
            text = (out / f"{name}.md").read_text().strip().splitlines()
            lines += ["", *("#" + line if line.startswith("#") else line for line in text)]
            if (out / f"{name}.png").exists():
                lines += ["", f"![{name}.png]({name}.png)"]
    (out / "report.md").write_text("\n".join(lines) + "\n")
    print(f"Report: {out / 'report.md'}")


if __name__ == "__main__":
    main()
