"""The house of scripts/: entry points on top, rooms beside them, every module importable from the root."""

import re
import runpy
from pathlib import Path

import pytest

from scripts.shared.command import ROOT

ROOMS = {"adversary", "bench", "campaigns", "defence", "experiments", "regularization", "shared"}
FILES = sorted((ROOT / "scripts").rglob("*.py"))
ENTRY_POINTS = sorted(path.stem for path in (ROOT / "scripts").glob("*.py") if path.stem != "__init__")


def test_the_rooms_are_packages_and_nothing_is_hidden_at_the_top():
    folders = {path.name for path in (ROOT / "scripts").iterdir() if path.is_dir() and path.name != "__pycache__"}
    assert folders == ROOMS and all((ROOT / "scripts" / room / "__init__.py").exists() for room in ROOMS)
    assert not [name for name in ENTRY_POINTS if name.startswith("_")]


@pytest.mark.parametrize("path", [*FILES, *sorted((ROOT / "tests").rglob("*.py"))], ids=lambda path: path.stem)
def test_no_file_edits_the_import_path(path):
    assert path == Path(__file__) or not re.search(r"sys\.path\.(insert|append)", path.read_text())


@pytest.mark.parametrize("path", FILES, ids=lambda path: "/".join(path.relative_to(ROOT / "scripts").parts))
def test_rooms_do_not_import_entry_points(path):
    if path.parent != ROOT / "scripts":
        imported = re.findall(r"^\s*from scripts import (.*)$|^\s*from scripts\.(\w+) import", path.read_text(), re.M)
        assert not {name for pair in imported for name in pair if name} - ROOMS


@pytest.mark.parametrize("name", ENTRY_POINTS)
def test_every_entry_point_says_how_it_is_run(name):
    assert f"python -m scripts.{name}" in runpy.run_module(f"scripts.{name}", run_name=name)["__doc__"]


def test_only_the_package_is_installed():
    assert re.search(r"^include = torch_dpc\*$", (ROOT / "setup.cfg").read_text(), re.M)
