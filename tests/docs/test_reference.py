"""The reference has a page for every public object."""

import re
from pathlib import Path
from types import ModuleType

import pytest

import torch_dpc as dpc

REFERENCE = Path(__file__).resolve().parents[2] / "docs" / "reference" / "index.rst"
ROOMS = [dpc, *(room for name in dpc.__all__ if isinstance(room := getattr(dpc, name), ModuleType))]


def described():
    names = re.findall(r"^   ([A-Za-z_][\w.]*)$", REFERENCE.read_text(), flags=re.M)
    assert len(names) == len(set(names))
    objects = []
    for name in names:
        thing = dpc
        for part in name.split("."):
            thing = getattr(thing, part)
        objects.append(thing)
    return objects


@pytest.mark.parametrize("room", ROOMS, ids=lambda room: room.__name__)
def test_every_public_object_has_a_page(room):
    pages = {id(thing) for thing in described()}
    public = {name: getattr(room, name) for name in room.__all__}
    missing = [name for name, thing in public.items() if not isinstance(thing, ModuleType) and id(thing) not in pages]
    assert not missing


def test_every_study_has_a_question():
    """The table of studies names every page of its list."""
    table, toctree = (REFERENCE.parents[1] / "studies.md").read_text().split("```{toctree}")
    listed = [line for line in toctree.splitlines() if re.fullmatch(r"[a-z_]+", line)]
    assert listed and re.findall(r"\{doc\}`(\w+)`", table) == listed
