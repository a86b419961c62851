"""The shape of the package: arrows down only, files of one responsibility, each idea told once."""

import ast
import configparser
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("importlinter", reason="the contracts are checked by import-linter")

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "torch_dpc"
LINES = 300  # a longer file says in its first lines why


def sources():
    return sorted(PACKAGE.rglob("*.py"))


def lint_imports(folder):
    """Run the contracts of setup.cfg on the packages in a folder; return the exit status and what was printed."""
    program = Path(sys.executable).with_name("lint-imports")
    done = subprocess.run(
        [program, "--no-logo", "--no-cache"], cwd=folder, capture_output=True, text=True, check=False
    )
    return done.returncode, done.stdout + done.stderr


@pytest.fixture
def copy(tmp_path):
    for name in ("torch_dpc", "baselines"):
        shutil.copytree(ROOT / name, tmp_path / name, ignore=shutil.ignore_patterns("__pycache__", "*.so"))
    shutil.copy(ROOT / "setup.cfg", tmp_path)
    return tmp_path


def test_the_contracts_hold():
    status, said = lint_imports(ROOT)
    assert status == 0, said


@pytest.mark.parametrize(
    ("file", "line", "contract"),
    [
        ("data/hankel.py", "from ..layer import DPCLayer", "Rooms import only rooms below them"),
        ("data/recordings.py", "from .hankel import HankelData", "The files of a room form no circle"),
        ("data/recordings.py", "import baselines", "The package does not import its baselines"),
        ("data/recordings.py", "def late():\n    from ..control import log", "Rooms import only rooms below them"),
    ],
)
def test_an_import_that_points_up_is_seen(copy, file, line, contract):
    path = copy / "torch_dpc" / file
    path.write_text(f"{path.read_text()}\n{line}\n")
    status, said = lint_imports(copy)
    assert status != 0
    assert re.search(rf"{contract}.* BROKEN", said)


def test_a_room_without_a_place_is_seen(copy):
    (copy / "torch_dpc" / "attic.py").write_text('"""No room."""\n')
    assert lint_imports(copy)[0] != 0


def test_long_files_say_why():
    for path in sources():
        lines = path.read_text().splitlines()
        said = ast.get_docstring(ast.parse("\n".join(lines))) or ""
        assert len(lines) <= LINES or "long" in said.lower(), f"{path}: {len(lines)} lines without a reason"
    assert len((PACKAGE / "layer.py").read_text().splitlines()) <= 320


def test_sets_that_are_boxes_are_a_matter_of_the_solver():
    rooms = ("solve", "sets")
    knowing = [p for p in sources() if "is_box" in p.read_text() and p.relative_to(PACKAGE).parts[0] not in rooms]
    assert not knowing


def test_few_autograd_functions():
    found = [
        f"{path.name}: {node.name}"
        for path in sources()
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.ClassDef)
        and any(ast.unparse(base).endswith("autograd.Function") for base in node.bases)
    ]
    assert len(found) <= 5, found


def test_scripts_have_names():
    assert not [path.name for path in (ROOT / "scripts").glob("_*") if path.name not in ("__init__.py", "__pycache__")]


def loaded_by(names):
    """Return the top-level modules that an import leaves."""
    code = f"import sys, {names}; print(*{{m.partition('.')[0] for m in sys.modules}})"
    return set(subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True).stdout.split())


def test_extras_are_imported_where_they_are_used():
    """The core imports torch, numpy, scipy and daqp alone when it is loaded."""
    config = configparser.ConfigParser()
    config.read(ROOT / "setup.cfg")
    before, after = loaded_by("torch, scipy, daqp"), loaded_by("torch_dpc")
    extras = {
        re.split(r"[<>=!\[ ;]", line)[0].replace("-", "_")
        for extra in config["options.extras_require"].values()
        for line in extra.splitlines()
        if line
    }
    assert not (after - before) & (extras - {"torch_dpc"})
