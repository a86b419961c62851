"""Commands: `python -m torch_dpc check` and `audit` (extra `cli`)."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

try:
    import typer
    from rich.console import Console
    from rich.table import Table
except ImportError:
    sys.exit("the commands need typer: pip install 'torch_dpc[cli]'.")

import torch

from .commands.audit import Audit
from .commands.audit import audit as audit_layer
from .commands.check import Check
from .commands.check import check as check_recordings
from .data.csv import read_csv
from .layer import DPCLayer

app = typer.Typer(
    help="Data-driven predictive control: is a recording good enough, and how vulnerable is a controller?",
    pretty_exceptions_enable=False,
    add_completion=False,
    rich_markup_mode="markdown",  # joins the lines of a paragraph
)
console = Console()

Inputs = Annotated[str, typer.Option("-u", "--inputs", help="Columns of the inputs, separated by commas.")]
Outputs = Annotated[str, typer.Option("-y", "--outputs", help="Columns of the outputs, separated by commas.")]
Picture = Annotated[Path | None, typer.Option("--picture", help="Write a picture here (.png, .pdf, .svg).")]


@app.command()
def check(
    recordings: Annotated[list[Path], typer.Argument(help="CSV files, each a recording: one sample a line.")],
    inputs: Inputs,
    outputs: Outputs,
    t_ini: Annotated[int, typer.Option(min=1, help="Past steps that fix the initial condition.")],
    horizon: Annotated[int, typer.Option(min=1, help="Future steps that are planned.")],
    picture: Picture = None,
) -> None:
    """Judge a recording: rank, excitation, and the prediction of its last quarter from the rest.

    Ends with status 1 if the recording is not good enough, and says what to do about it.
    """
    u_names, y_names = _names(inputs), _names(outputs)
    pairs = [read_csv(path, u_names, y_names) for path in recordings]
    verdict = check_recordings([u for u, _ in pairs], [y for _, y in pairs], t_ini=t_ini, horizon=horizon)
    _print_check(verdict, y_names)
    if picture is not None:
        verdict.plot(y_names).savefig(picture, dpi=150)
        console.print(f"Picture: {picture}")
    raise typer.Exit(0 if verdict.is_exciting and verdict.is_useful else 1)


@app.command()
def audit(
    layer: Annotated[Path, typer.Argument(help="A layer that `DPCLayer.save` wrote.")],
    recording: Annotated[Path, typer.Argument(help="A CSV file whose windows are the initial conditions.")],
    inputs: Inputs,
    outputs: Outputs,
    rho: Annotated[str, typer.Option(help="Sizes of the attack, relative to |y_ini|.")] = "0.01,0.05",
    y_ref: Annotated[str | None, typer.Option(help="Reference, a number an output; default their mean.")] = None,
    u_ref: Annotated[str | None, typer.Option(help="Input reference, a number an input; default zero.")] = None,
    windows: Annotated[int, typer.Option(min=1, help="Windows of the recording, evenly spread.")] = 200,
    seed: Annotated[int, typer.Option(help="Of the random noise.")] = 0,
    picture: Picture = None,
) -> None:
    """Show what sensor attacks do to the plans of a saved layer.

    Random noise, Algorithm 1 and projected gradient perturb the measured windows by at most rho |y_ini|. The error is
    what the layer's own data predict for the planned inputs.
    """
    u, y = read_csv(recording, _names(inputs), _names(outputs))
    wanted = y.mean(0) if y_ref is None else _reference("y_ref", y_ref, y.shape[1])
    wanted_u = torch.zeros(u.shape[1]) if u_ref is None else _reference("u_ref", u_ref, u.shape[1])
    rhos = _numbers("rho", rho)
    loaded = DPCLayer.load(layer)
    result = audit_layer(loaded, u, y, rhos=rhos, windows=windows, y_ref=wanted, u_ref=wanted_u, seed=seed)
    console.print(f"Reference {[round(value, 6) for value in wanted.tolist()]}, {len(result.nominal)} windows")
    _print_audit(result)
    if picture is not None:
        result.plot().savefig(picture, dpi=150)
        console.print(f"Picture: {picture}")


def _print_check(verdict: Check, names: list[str]) -> None:
    data, space = verdict.data, verdict.data.row_space
    windows = f"{data.n_windows} windows of {data.t_ini} past and {data.horizon} future steps"
    table = Table(title=windows, show_header=False)
    reached, needed = verdict.excitation, data.t_ini + data.horizon
    excitation = f"order {reached}, {needed} needed" if verdict.is_exciting else f"order {reached} of {needed}"
    table.add_row("excitation", excitation, "good" if verdict.is_exciting else "too little")
    has_gap = space.clear and data.rank < space.n_rows
    gap = "a clear gap: hardly any noise" if has_gap else "no gap: noise, or a nonlinear plant"
    table.add_row("rank", f"{data.rank} of {space.n_rows} rows", gap)
    console.print(table)
    columns = ("output", "1 step ahead", f"{data.horizon} steps ahead", f"held for {data.horizon} steps")
    table = Table(*columns, title=f"error of {verdict.n_held_out} held-out windows")
    for i, name in enumerate(names):
        cells = (verdict.errors[0, i], verdict.errors[-1, i], verdict.holding[-1, i])
        table.add_row(name, *(f"{100 * float(cell):.3g} %" for cell in cells))
    console.print(table)
    console.print("Errors are in percent of the standard deviation of the output; held: the last measured output.")
    if verdict.is_exciting and verdict.is_useful:
        console.print("The recording is good enough to control with.")
    for sentence in verdict.advice:
        console.print(sentence)


def _print_audit(result: Audit) -> None:
    table = Table("attack", "rho", "input change", "error increase [%]", "no plan", title="median (90th percentile)")
    for damage in result.damages:
        increase = _median_and_high(100 * damage.increase)
        unsolved = f"{100 * damage.unsolved:.3g} %"
        change = _median_and_high(damage.input_change)
        table.add_row(damage.attack, f"{100 * damage.rho:g} %", change, increase, unsolved)
    console.print(table)
    console.print("Input change: of the planned inputs, the largest, in their units. Error: what the data predict.")
    _print_comparison(result)
    console.print(f"Predicted error without an attack, rms of |y - y_ref|_Q: {_median_and_high(result.nominal)}.")
    if result.skipped:
        console.print(f"{result.skipped} windows were left out: the layer has no plan there, without an attack.")


def _print_comparison(result: Audit) -> None:
    """Print what the strongest attack of the largest size does beside random noise, in one sentence."""
    largest = max(damage.rho for damage in result.damages)
    of_size = [damage for damage in result.damages if damage.rho == largest and len(damage.increase)]
    increases = {damage.attack: 100 * float(damage.increase.median()) for damage in of_size}
    noise = increases.pop("random noise", None)
    if noise is not None and increases:
        console.print(
            f"Measurement errors of {100 * largest:g} % raise the predicted error by {max(increases.values()):.3g} % "
            f"if an attacker chooses them, and by {noise:.3g} % if they are random (medians)."
        )


def _median_and_high(values: torch.Tensor) -> str:
    if not len(values):
        return "-"
    return f"{float(values.median()):.3g} ({float(values.quantile(0.9)):.3g})"


def _reference(option: str, text: str, channels: int) -> torch.Tensor:
    values = torch.tensor(_numbers(option, text), dtype=torch.float64)
    if len(values) != channels:
        raise ValueError(f"`--{option.replace('_', '-')}` must have {channels} numbers, got {len(values)}.")
    return values


def _names(text: str) -> list[str]:
    return [name.strip() for name in text.split(",") if name.strip()]


def _numbers(option: str, text: str) -> list[float]:
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        raise ValueError(f"`--{option.replace('_', '-')}` must be numbers separated by commas, got {text!r}.") from None


def main() -> None:
    """Run a command; bad input ends with a message and status 2."""
    try:
        app(prog_name="python -m torch_dpc")
    except (ValueError, OSError, ImportError) as error:
        Console(stderr=True).print(f"error: {error}", style="red", markup=False)
        sys.exit(2)


if __name__ == "__main__":
    main()
