"""docs/reference: what it shows of docstrings is what they say."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

pytest.importorskip("griffe")  # of the extra "docs"

import reference_tools


@pytest.fixture(scope="module")
def pages() -> dict[Path, str]:
    return reference_tools.pages()


def test_pages_are_as_the_script_writes_them(pages: dict[Path, str]) -> None:
    old = [page.name for page, text in pages.items() if page.read_text(encoding="utf-8") != text]
    assert old == [], "run make reference"


def test_a_reader_of_the_files_finds_every_name(pages: dict[Path, str]) -> None:
    names = 0
    for page in sorted(reference_tools.REFERENCE.glob("*.md")):
        visible = re.sub(r"<!--.*?-->", "", page.read_text(encoding="utf-8"), flags=re.S)
        assert ":::" not in visible
        rows = re.findall(r"^\| `[\w.]+` \| (.*) \|$", visible, re.M)
        assert all(rows), page
        names += len(rows)
    assert names > 60
    assert (
        "distance to the goal / largest goal distance"
        in pages[reference_tools.REFERENCE / "ids.md"]
    )
