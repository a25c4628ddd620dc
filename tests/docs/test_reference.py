"""docs/reference: what it shows of docstrings is what they say."""

from __future__ import annotations

import pytest

pytest.importorskip("griffe")  # of the extra "docs"

import reference_tools


def test_pages_are_as_the_script_writes_them() -> None:
    pages = reference_tools.pages()
    old = [page.name for page, text in pages.items() if page.read_text(encoding="utf-8") != text]
    assert old == [], "run make reference"
