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


def spread(numbers: dict[str, float]) -> str:
    """Return the mean over the seeds and, in brackets, the extremes."""
    return f"{numbers['mean']:.4f} ({numbers['min']:.4f} to {numbers['max']:.4f})"


def times(ratio: float | None, by_seed: dict[str, float] | None, seeds_left_out: int = 0) -> str:
    """Return a ratio of means and, in brackets, the extremes over the seeds."""
    if ratio is None or by_seed is None:
        return "random adds nothing"
    left_out = f", without {seeds_left_out} where random adds nothing" if seeds_left_out else ""
    return f"{ratio:.1f} ({by_seed['min']:.1f} to {by_seed['max']:.1f}{left_out})"


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
            times(level["ratio"], level["ratio_by_seed"]),
            spread(level["added_random"]),
            spread(level["added_poison"]),
            times(
                level["added_ratio"],
                level["added_ratio_by_seed"],
                level["seeds"] - level["seeds_where_random_adds"],
            ),
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return lines


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
    file = folder / f"{name}.json"
    if not file.exists():
        return ["", f"## {title}", "", f"Not made: run `python -m scripts.{name}`."]
    result = json.loads(file.read_text())
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
        "largest seed in brackets. Ratios are of those means, with the range over the seeds. What an attack adds is "
        "its error less that of the same seed without an attack.",
    ]
    for name in FIGURES:
        lines += figure_section(out, name)
    for name in ("table1_sizes", "study_sensitivity"):
        if (out / f"{name}.md").exists():
            text = (out / f"{name}.md").read_text().strip().splitlines()
            lines += ["", *("#" + line if line.startswith("#") else line for line in text)]
            if (out / f"{name}.png").exists():
                lines += ["", f"![{name}.png]({name}.png)"]
    (out / "report.md").write_text("\n".join(lines) + "\n")
    print(f"Report: {out / 'report.md'}")


if __name__ == "__main__":
    main()
