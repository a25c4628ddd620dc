"""Version, changelog and citation agree."""

from __future__ import annotations

import re
from pathlib import Path

import yaml

import acsar_gym

ROOT = Path(__file__).resolve().parents[1]
CHANGES = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
KINDS = {"Added", "Changed", "Deprecated", "Removed", "Fixed", "Security"}
"""Of Keep a Changelog."""


def test_the_newest_release_of_the_changelog_is_this_version() -> None:
    releases = re.findall(r"^## \[([\w.]+)\](?: - (\d{4}-\d\d-\d\d))?$", CHANGES, re.M)
    assert releases[0] == ("Unreleased", "")
    assert releases[1][0] == acsar_gym.__version__
    assert all(date for _, date in releases[1:])


def test_changes_are_of_the_known_kinds() -> None:
    assert set(re.findall(r"^### (.+)$", CHANGES, re.M)) <= KINDS


def test_the_citation_is_of_this_version_and_licence() -> None:
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert (cited["version"], cited["license"]) == (acsar_gym.__version__, "MIT")
    assert {"cff-version", "message", "title", "authors"} <= set(cited)
    holder = cited["authors"][0]["name"]
    assert holder.removeprefix("The ") in (ROOT / "LICENSE").read_text(encoding="utf-8")
