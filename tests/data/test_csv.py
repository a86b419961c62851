"""Data from CSV files, and what is wrong with a file."""

import pytest
import torch

import torch_dpc as dpc
from helpers import generator

SIZES = {"t_ini": 2, "horizon": 6}
COLUMNS = {"inputs": ["force"], "outputs": ["position", "speed"]}


def recording(steps=40, seed=0):
    u = 2 * torch.rand(steps, 1, dtype=torch.float64, generator=generator(seed)) - 1
    speed = torch.cat([torch.zeros(1, 1), u.cumsum(0)[:-1]]).double()
    return u, torch.cat([torch.cat([torch.zeros(1, 1), speed.cumsum(0)[:-1]]).double(), speed], dim=1)


def written(path, u, y, header="time, position,force,speed,note"):
    rows = [
        f"{0.1 * k},{p!r},{f!r},{s!r},ok"
        for k, (f, (p, s)) in enumerate(zip(u[:, 0].tolist(), y.tolist(), strict=True))
    ]
    path.write_text("\n".join([header, *rows]) + "\n", encoding="utf-8-sig")
    return path


def test_named_columns_become_the_same_data(tmp_path):
    u, y = recording()
    data = dpc.HankelData.from_csv(written(tmp_path / "a.csv", u, y), **COLUMNS, **SIZES)
    expected = dpc.HankelData.from_trajectories(u, y, **SIZES)
    for one, other in zip(data.matrices, expected.matrices, strict=True):
        assert torch.equal(one, other)
    swapped = dpc.HankelData.from_csv(str(tmp_path / "a.csv"), inputs=["force"], outputs=["speed", "position"], **SIZES)
    assert torch.equal(swapped.Yf[::2], expected.Yf[1::2])


def test_a_list_of_files_is_a_list_of_recordings(tmp_path):
    parts = [recording(seed=0), recording(30, seed=1)]
    paths = [written(tmp_path / f"{i}.csv", *part) for i, part in enumerate(parts)]
    data = dpc.HankelData.from_csv(paths, **COLUMNS, **SIZES)
    assert torch.equal(data.Uf, dpc.HankelData.from_trajectories(*map(list, zip(*parts, strict=True)), **SIZES).Uf)


def test_other_delimiters(tmp_path):
    u, y = recording()
    path = written(tmp_path / "a.csv", u, y)
    (tmp_path / "b.csv").write_text(path.read_text(encoding="utf-8-sig").replace(",", ";"))
    one = dpc.HankelData.from_csv(tmp_path / "b.csv", delimiter=";", **COLUMNS, **SIZES)
    assert torch.equal(one.Yp, dpc.HankelData.from_csv(path, **COLUMNS, **SIZES).Yp)


def test_a_csv_under_control(tmp_path):
    data = dpc.HankelData.from_csv(written(tmp_path / "a.csv", *recording()), **COLUMNS, **SIZES)
    layer = dpc.DPCLayer(data, Q=1.0, R=0.1, lambda_g=1.0, lambda_s=1e4, u_set=dpc.Box(-1.0, 1.0))
    plan = layer(torch.zeros(2, 1), torch.zeros(2, 2), y_ref=torch.tensor([1.0, 0.0]))
    assert plan.u.shape == (6, 1) and plan.y[-1, 0] > 0.5


HEADER = "time,position,force,speed"


@pytest.mark.parametrize(
    ("lines", "says"),
    [
        ([], "a.csv has no column named 'force'; its header names none"),
        (["time,position,speed"], "no column named 'force'; its header names 'time', 'position', 'speed'"),
        (["time,position,force,speed,force"], "2 columns named 'force'"),
        ([HEADER], "must hold one sample a line under its header, got none"),
        ([HEADER, "0,1,2,3", "1,2,3"], "a.csv, line 3: must have 4 entries like the header, got 3"),
        ([HEADER, "0,1,2,3", "1,2,3,4,5"], "line 3: must have 4 entries like the header, got 5"),
        ([HEADER, "0,1,2,3", "1,2,,4"], "line 3, column 'force': must be a finite number, got ''"),
        ([HEADER, "0,1,2,nan"], "line 2, column 'speed': must be a finite number, got 'nan'"),
        ([HEADER, "0,1,2,1e999"], "line 2, column 'speed': must be a finite number, got '1e999'"),
        ([HEADER, "0,one,2,3"], "line 2, column 'position': must be a finite number, got 'one'"),
        (
            [HEADER, *["0,1,2,3"] * 7],
            r"recording 0 must have at least t_ini \+ horizon = 8 samples for one window, got 7",
        ),
    ],
    ids=lambda v: "" if isinstance(v, list) else v[:30],
)
def test_what_is_wrong_with_a_file_is_named(tmp_path, lines, says):
    path = tmp_path / "a.csv"
    path.write_text("\n".join(lines))
    with pytest.raises(ValueError, match=says):
        dpc.HankelData.from_csv(path, **COLUMNS, **SIZES)


def test_bad_arguments_are_named(tmp_path):
    with pytest.raises(ValueError, match="`inputs` must be a list of column names, got 'force'"):
        dpc.HankelData.from_csv(written(tmp_path / "a.csv", *recording()), inputs="force", outputs=["speed"], **SIZES)
    with pytest.raises(ValueError, match="`path` must be a file or a list of one file or more"):
        dpc.HankelData.from_csv([], **COLUMNS, **SIZES)
    with pytest.raises(FileNotFoundError):
        dpc.HankelData.from_csv(tmp_path / "none.csv", **COLUMNS, **SIZES)
