"""README.md and docs/: links lead to files and headings that exist."""

from __future__ import annotations

from pathlib import Path

import page_tools
import pytest
from page_tools import PAGES, ROOT


def broken(page: Path) -> list[str]:
    """Links of a page to nothing."""
    found = []
    for link in page_tools.links(page):
        if link.startswith(("http://", "https://", "mailto:")):
            continue
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        checked = anchor and target.suffix == ".md" and target.exists()
        known = page_tools.anchors(target) if checked else {anchor}
        if not target.exists() or anchor not in known:
            found.append(link)
    return found


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page: Path) -> None:
    assert broken(page) == []


def test_broken_ones_are_found(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(
        "# A title, here\n[a](#a-title-here) [b](#b) [c](page.md#c) [d](d.md) ![e](e.png)\n\n"
        '<img src="f.png">\n'
    )
    assert broken(page) == ["#b", "page.md#c", "d.md", "e.png", "f.png"]
