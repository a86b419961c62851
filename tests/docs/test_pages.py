"""Every Python block of the README and of the documentation runs as printed, in the order of its page."""

import re
import sys
from pathlib import Path

import pytest
import torch

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
#: A fenced block of Python, as a listing or as the cell of a notebook; {code-cell} may carry options after its name.
BLOCK = re.compile(
    r"^(?P<fence>`{3,}|:{3,})(?:python|\{code-block\} python|\{code-cell\}[^\n]*)\n(?P<code>.*?)^(?P=fence)\s*$",
    re.M | re.S,
)
OPTION = re.compile(r"\A(?:---\n.*?^---\n|(?::[\w-]+:[^\n]*\n)+)", re.M | re.S)


def blocks(page):
    """Return the blocks of a page with the line on which each begins."""
    text = page.read_text()
    for match in BLOCK.finditer(text):
        code = OPTION.sub(lambda options: "\n" * options.group().count("\n"), match["code"])
        yield text.count("\n", 0, match.start("code")), code


@pytest.mark.parametrize("page", [p for p in PAGES if list(blocks(p))], ids=lambda p: str(p.relative_to(ROOT)))
def test_the_blocks_of_a_page_run(page, monkeypatch, request):
    plt = pytest.importorskip("matplotlib.pyplot", reason="the pages draw with matplotlib")
    plt.switch_backend("Agg")
    monkeypatch.chdir(page.parent)
    dtype = torch.get_default_dtype()
    request.addfinalizer(lambda: torch.set_default_dtype(dtype))
    namespace = {"__name__": "__main__"}
    monkeypatch.setitem(sys.modules, "__main__", type(sys)("__main__"))
    for line, code in blocks(page):
        exec(compile("\n" * line + code, str(page), "exec"), namespace)
    plt.close("all")


def test_a_block_that_fails_is_seen(tmp_path, monkeypatch):
    page = tmp_path / "page.md"
    page.write_text("```{code-cell} ipython3\n:tags: [hide-input]\nx = 1\n```\n\n```python\nassert x == 2\n```\n")
    (first, one), (second, two) = blocks(page)
    assert (first, one, second) == (1, "\nx = 1\n", 6)
    with pytest.raises(AssertionError):
        exec(one + two, {})
