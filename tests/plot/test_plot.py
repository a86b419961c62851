"""Figures: what is drawn, with which values and labels; drawn with Agg."""

import subprocess
import sys
import textwrap
import types
from dataclasses import replace

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt  # noqa: E402
import numpy as np  # noqa: E402
import pytest  # noqa: E402
import torch  # noqa: E402
from PIL import Image  # noqa: E402

import torch_dpc as dpc  # noqa: E402
from helpers import HOLDING, Y_REF, generator, masses_data, randn, small_data, small_layer  # noqa: E402
from torch_dpc import attacks, plot  # noqa: E402


@pytest.fixture(autouse=True)
def no_open_figures():
    yield
    plt.close("all")


@pytest.fixture(scope="module")
def layer():
    return small_layer(y_set=dpc.Box(-50.0, torch.tensor([1.25, 50.0, 50.0, 50.0])))


@pytest.fixture(scope="module")
def runs(layer):
    """A run without an attack, and three with random noise."""
    controller, plant = dpc.DPCController(layer, replan_every=3), dpc.systems.OscillatingMasses()
    noise = attacks.RandomAttack(attacks.RelativeBall(0.05))
    options = {"steps": 12, "u_ref": HOLDING, "reset": {"state": torch.tensor([0.5, 0.0, 0.0, 0.0])}}
    clean = dpc.simulate(plant, controller, Y_REF, **options)
    return clean, [
        dpc.simulate(plant, controller, Y_REF, attack=noise, generator=generator(i), **options) for i in range(3)
    ]


FIELDS = ("u", "y", "y_ref", "p", "status", "replanned", "alarm")


def batch_of(logs):
    return dpc.ClosedLoopLog(logs[0].t, **{name: torch.stack([getattr(log, name) for log in logs]) for name in FIELDS})


def line(axes, label):
    (found,) = (one for one in axes.lines if one.get_label() == label)
    return found


def labels(axes):
    return [one.get_label() for one in axes.lines if not one.get_label().startswith("_")]


# --- runs -------------------------------------------------------------------------------------------------------------


def test_a_run_is_drawn_channel_by_channel(runs, layer):
    log = runs[1][0]
    names = ["q1 [m]", "q2 [m]", "v1 [m/s]", "v2 [m/s]"]
    axes = log.plot(layer=layer, y_names=names, u_names=["F1 [N]", "F2 [N]"]).axes
    assert [one.get_ylabel() for one in axes] == [*names, "F1 [N]", "F2 [N]", "|p|"]
    for i in range(4):
        np.testing.assert_array_equal(line(axes[i], "output").get_xdata(), log.t)
        np.testing.assert_array_equal(line(axes[i], "output").get_ydata(), log.y[:, i])
        np.testing.assert_array_equal(line(axes[i], "reference").get_ydata(), log.y_ref[:, i])
    for i in range(2):
        np.testing.assert_array_equal(line(axes[4 + i], "input").get_ydata(), log.u[:, i])
    np.testing.assert_allclose(line(axes[6], "perturbation").get_ydata(), log.p.flatten(1).norm(dim=1))
    assert axes[3].get_xlabel() == axes[6].get_xlabel() == "time [s]"


def test_bounds_that_are_near_are_drawn_and_far_ones_left_out(runs, layer):
    axes = plot.log(runs[0], layer=layer).axes
    np.testing.assert_array_equal(line(axes[0], "bound").get_ydata(), [1.25, 1.25])  # the lower one is at -50
    assert "bound" not in labels(axes[1])
    drawn = [one.get_ydata()[0] for one in axes[4].lines if one.get_linestyle() == ":"]
    assert 0.5 in drawn
    assert "bound" not in labels(plot.log(runs[0]).axes[0])


def test_a_run_without_attack_has_no_panel_for_it(runs):
    figure = plot.log(runs[0])
    assert [one.get_ylabel() for one in figure.axes] == ["y0", "y1", "y2", "y3", "u0", "u1"]
    legend = [text.get_text() for text in figure.legends[0].get_texts()]
    assert legend == ["reference", "output", "input", "plan made"]


def test_steps_of_plans_are_marked(runs):
    for axes in runs[0].plot().axes:
        np.testing.assert_array_equal(line(axes, "plan made").get_xdata(), runs[0].t[::3])
    every_step = replace(runs[0], replanned=torch.ones(12, dtype=torch.bool))
    assert "plan made" not in labels(every_step.plot().axes[0])


def test_few_runs_are_lines(runs):
    figure = plot.log(batch_of(runs[1]))
    blue = line(figure.axes[0], "output").get_color()
    drawn = [one.get_ydata() for one in figure.axes[0].lines if one.get_color() == blue]
    np.testing.assert_array_equal(np.array(drawn), [log.y[:, 0] for log in runs[1]])
    assert figure.legends[0].get_title().get_text() == "3 runs, a line each"


def test_many_runs_are_median_and_band(runs):
    log = replace(batch_of(runs[1] * 5), y=randn(15, 12, 4))
    figure = log.plot()
    np.testing.assert_allclose(line(figure.axes[1], "output").get_ydata(), np.median(log.y[..., 1].numpy(), axis=0))
    (band,) = figure.axes[1].collections
    low, high = np.percentile(log.y[..., 1].numpy(), (10, 90), axis=0)
    heights = band.get_paths()[0].vertices[:, 1]
    assert heights.min() == pytest.approx(low.min())
    assert heights.max() == pytest.approx(high.max())
    assert figure.legends[0].get_title().get_text() == "15 runs, median and 10 to 90 %"


def test_axes_in_figure_out(runs):
    own, grid = plt.subplots(2, 3)
    assert plot.log(runs[0], grid) is own
    assert labels(grid[0, 0]) == ["reference", "output", "plan made"]
    assert not own.legends
    with pytest.raises(ValueError, match="`axes` must be 6 matplotlib axes, got 1 of Axes"):
        plot.log(runs[0], grid[0, 0])
    with pytest.raises(ValueError, match="`axes` must be 6 matplotlib axes, got 1 of str"):
        plot.log(runs[0], "axes")
    with pytest.raises(ValueError, match="`y_names` must have one name for each of the 4 channels"):
        plot.log(runs[0], y_names=["a"])


# --- plans ------------------------------------------------------------------------------------------------------------


def test_a_plan_with_its_past_and_the_truth(runs, layer):
    log = runs[0]
    plan = layer(log.u[:3], log.y[:3], y_ref=Y_REF, u_ref=HOLDING)
    figure = plan.plot(past=(log.u[:3], log.y[:3]), truth=(log.u[3:9], log.y[3:9]), y_ref=Y_REF, dt=0.1)
    assert len(figure.axes) == 6
    first, last = figure.axes[0], figure.axes[-1]
    np.testing.assert_allclose(line(first, "past").get_xdata(), [-0.3, -0.2, -0.1])
    np.testing.assert_array_equal(line(first, "past").get_ydata(), log.y[:3, 0])
    np.testing.assert_allclose(line(first, "planned output").get_xdata(), 0.1 * np.arange(6))
    np.testing.assert_array_equal(line(first, "planned output").get_ydata(), plan.y.detach()[:, 0])
    np.testing.assert_array_equal(line(first, "truth").get_ydata(), log.y[3:9, 0])
    np.testing.assert_array_equal(line(first, "reference").get_ydata(), np.ones(6))
    np.testing.assert_array_equal(line(last, "planned input").get_ydata(), plan.u.detach()[:, 1])
    np.testing.assert_array_equal(line(last, "truth").get_ydata(), log.u[3:9, 1])
    assert last.get_xlabel() == "time from the plan [s]"


def test_a_batch_of_plans_and_a_plan_alone(layer):
    plans = layer(torch.zeros(2, 3, 2), randn(2, 3, 4))
    axes = plot.plan(plans, truth=torch.zeros(4, 4)).axes
    blue = line(axes[0], "planned output").get_color()
    assert sum(one.get_color() == blue for one in axes[0].lines) == 2
    assert labels(axes[5]) == ["planned input"]
    assert axes[5].get_xlabel() == "step of the plan"


# --- data -------------------------------------------------------------------------------------------------------------


def test_the_hankel_picture_and_the_rank():
    data = masses_data(steps=150, t_ini=3, horizon=6)
    figure = data.plot()
    picture, values, inputs, _ = figure.axes
    image = picture.images[0].get_array()
    units = data.row_space.units
    np.testing.assert_allclose(image, torch.cat([data.Up, data.Yp, data.Uf, data.Yf]) / units[:, None])
    assert [text.get_text() for text in picture.get_yticklabels()] == ["$U_p$", "$Y_p$", "$U_f$", "$Y_f$"]
    assert len(line(values, "kept").get_xdata()) == data.rank == 2 * 9 + 4  # n_u (t_ini + horizon) + the order
    assert line(values, "kept").get_ydata().min() > 1e-3
    assert line(values, "counted as zero").get_ydata().max() < 1e-14
    assert "rank 22 of 54" in values.get_title()
    assert inputs.get_title() == "input rows: rank 18 of 18\nexciting of order 9"
    np.testing.assert_array_equal(line(values, "tolerance 1e-10").get_ydata(), [1e-10, 1e-10])


def test_poor_excitation_is_said():
    u = torch.ones(40, 1, dtype=torch.float64)
    with pytest.warns(dpc.ExcitationWarning):
        data = dpc.HankelData.from_trajectories(u, u.cumsum(0), t_ini=2, horizon=3)
    assert plot.data(data).axes[2].get_title() == "input rows: rank 1 of 5\nNOT exciting of order 5"


def test_compact_data_can_be_drawn():
    assert ", compact in " in plot.data(small_data().compressed()).axes[0].get_xlabel()


# --- attacks ----------------------------------------------------------------------------------------------------------


def test_damage_is_median_and_band():
    values = torch.arange(11.0)
    figure = plot.damage({"noise": {0.02: values, 0.01: 0.5 * values}, "best": {0.01: 3.0}}, ylabel="error [m]")
    (axes,) = figure.axes
    np.testing.assert_array_equal(line(axes, "noise").get_xydata(), [[0.01, 2.5], [0.02, 5.0]])
    np.testing.assert_array_equal(line(axes, "best").get_xydata(), [[0.01, 3.0]])
    (band,) = axes.collections
    assert band.get_paths()[0].vertices[:, 1].max() == pytest.approx(9.0)
    assert axes.get_ylabel() == "error [m]"
    assert axes.get_title() == "median and 10 to 90 % of 1 to 11 runs"
    assert axes.xaxis.get_major_formatter()(0.02) == "2 %"
    for empty in ({}, {"noise": {}}):
        with pytest.raises(ValueError, match="`curves` must map"):
            plot.damage(empty)


def test_perturbations_of_a_run(runs):
    log = runs[1][0]
    size, picture, _ = plot.perturbation(log).axes
    np.testing.assert_allclose(size.lines[0].get_ydata(), log.p.flatten(1).norm(dim=1))
    image = picture.images[0].get_array()
    assert image.shape == (4 * 3, 12)
    largest = log.p.abs().amax((0, 1))
    np.testing.assert_allclose(image[3:6, 7], log.p[7, :, 1] / largest[1])  # the second output, oldest on top
    assert picture.get_yticklabels()[1].get_text() == f"y1 (max {float(largest[1]):.2g})"
    with pytest.raises(ValueError, match="`log` must be one run"):
        plot.perturbation(batch_of(runs[1]))


def test_a_worst_case():
    figures = {"value": torch.tensor(1.5), "bound": torch.tensor(1.25), "gap": torch.tensor(0.2), "nominal": 2.0}
    result = types.SimpleNamespace(p=randn(3, 2), **figures)
    entries, proof = plot.worst_case(result).axes
    np.testing.assert_array_equal(line(entries, "y1").get_ydata(), result.p[:, 1])
    assert [text.get_text() for text in proof.texts] == ["no attack 2", "found 1.5", "bound 1.25"]
    assert proof.get_title() == "gap 2.0e-01"


# --- films ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("plane", [None, (0, 1)])
def test_a_film_shows_the_run_growing(runs, plane, tmp_path):
    path = plot.animate(runs[0], tmp_path / "run.gif", plane=plane)
    with Image.open(path) as film:
        assert film.n_frames == 12
        frames = []
        for i in (0, 6, 11):
            film.seek(i)
            frames.append(np.asarray(film.convert("RGB"), dtype=int))
    coloured = [(frame.max(-1) - frame.min(-1) > 60).sum() for frame in frames]  # pixels that are no grey
    assert coloured[0] < coloured[1] < coloured[2]
    assert not plt.get_fignums()


def test_films_say_what_is_wrong(runs, tmp_path, monkeypatch):
    with pytest.raises(ValueError, match=r"`plane` must name two of the outputs 0 to 3, got \(0, 4\)"):
        plot.animate(runs[0], tmp_path / "run.gif", plane=(0, 4))
    monkeypatch.setattr("matplotlib.animation.writers.is_available", lambda name: False)
    with pytest.raises(RuntimeError, match=r"'.mp4' needs ffmpeg"):
        plot.animate(runs[0], tmp_path / "run.mp4")


# --- the module -------------------------------------------------------------------------------------------------------


def test_the_users_settings_stay(runs):
    before = dict(matplotlib.rcParams)
    plot.log(runs[0])
    plot.data(small_data())
    assert dict(matplotlib.rcParams) == before


@pytest.mark.slow
def test_a_notebook_shows_every_figure_once():
    """The kernel of a notebook runs the cells: a figure is shown as the value of its cell, or else after it."""
    nbclient, v4 = pytest.importorskip("nbclient"), pytest.importorskip("nbformat.v4")
    pytest.importorskip("ipykernel")
    setup = """
        import torch, torch_dpc as dpc, matplotlib.pyplot as plt
        u = torch.rand(60, 1, generator=torch.Generator().manual_seed(0))
        data = dpc.HankelData.from_trajectories(u, u.cumsum(0) - u, t_ini=2, horizon=4)
        """
    alone = ["data.plot();", "data.plot()", "figure = data.plot()", "figure", "plt.plot([1]);"]
    cells = [*alone, "data.plot(); data.plot();"]
    notebook = v4.new_notebook(cells=[v4.new_code_cell(text) for text in (textwrap.dedent(setup), *cells)])
    nbclient.NotebookClient(notebook, timeout=120).execute()
    shown = [sum("image/png" in output.get("data", {}) for output in cell.outputs) for cell in notebook.cells]
    assert shown == [0, 1, 1, 1, 1, 1, 2]


def test_importing_the_package_imports_no_matplotlib():
    code = "import sys, torch_dpc; dir(torch_dpc.plot); assert 'matplotlib' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120)


def test_without_matplotlib_the_error_says_what_to_install():
    code = (
        "import sys; sys.modules['matplotlib'] = None\n"
        "import torch_dpc\n"
        "try:\n    torch_dpc.plot.log\n"
        "except ImportError as error:\n    assert \"pip install 'torch_dpc[plot]'\" in str(error)\n"
        "else:\n    raise SystemExit('no error')"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120)


def test_no_backend_is_chosen():
    code = (
        "import os; os.environ['MPLBACKEND'] = 'svg'\n"
        "import torch, torch_dpc as dpc, matplotlib\n"
        "dpc.plot.damage({'a': {0.1: 1.0}})\n"
        "assert matplotlib.get_backend() == 'svg'"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120)


def test_unknown_names():
    with pytest.raises(AttributeError, match="has no attribute 'pie'"):
        plot.pie  # noqa: B018
