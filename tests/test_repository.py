"""What must be the same in several files of the repository."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import yaml

import acsar_gym

ROOT = Path(__file__).resolve().parents[1]


def read(name: str) -> str:
    return (ROOT / name).read_text(encoding="utf-8")


def test_changelog_and_citation_are_of_this_version() -> None:
    releases = re.findall(r"^## \[([\w.]+)\]", read("CHANGELOG.md"), re.M)
    assert releases[:2] == ["Unreleased", acsar_gym.__version__]
    assert yaml.safe_load(read("CITATION.cff"))["version"] == acsar_gym.__version__


def test_commits_are_linted_by_the_ruff_of_make_lint() -> None:
    (hooks,) = yaml.safe_load(read(".pre-commit-config.yaml"))["repos"]
    assert f"ruff=={hooks['rev'].removeprefix('v')}" in read("constraints.txt").splitlines()


@pytest.mark.parametrize("name", ["tests.yml", "weekly.yml"])
def test_workflows_only_read_and_make_what_the_makefile_has(name: str) -> None:
    workflow = yaml.safe_load(read(f".github/workflows/{name}"))
    assert workflow["permissions"] == {"contents": "read"}
    targets = re.findall(r"^([\w-]+):", read("Makefile"), re.M)
    for job in workflow["jobs"].values():
        for step in job["steps"]:
            # A branch's or an issue's name in a shell's line would be run by it.
            assert "github." not in step.get("run", "")
            assert set(re.findall(r"^make ([a-z-]+)", step.get("run", ""), re.M)) <= {*targets}
