"""docs/licences.md names every package that users install, and its licence."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from licence_tools import PERMISSIVE, WEAK, licence, parts, rows

PAGE = Path(__file__).resolve().parents[1] / "docs" / "licences.md"


@pytest.fixture(scope="module")
def installed() -> dict[str, str]:
    """The rows of what is installed here."""
    return rows()


def test_every_licence_is_permissive_or_weak_copyleft(installed: dict[str, str]) -> None:
    assert len(installed) > 100
    other = {name: licence(name) for name in installed}
    assert {n: text for n, text in other.items() if not parts(text) <= PERMISSIVE | WEAK} == {}


def test_the_page_lists_what_is_installed(installed: dict[str, str]) -> None:
    listed = re.findall(r"^\| ([a-z0-9-]+) \|.*$", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    assert set(installed) - set(listed) == set(), "run make licences"
    listed.remove("package")
    assert listed == sorted(set(listed))
