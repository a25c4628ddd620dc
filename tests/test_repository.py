"""What the host of the repository runs and asks: workflows, issue forms, hooks."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[1]
GITHUB = ROOT / ".github"
WORKFLOWS = sorted((GITHUB / "workflows").glob("*.yml"))
FORMS = [GITHUB / "ISSUE_TEMPLATE" / f"{name}.yml" for name in ("bug", "feature")]
FIELDS = {"markdown", "textarea", "input", "dropdown", "checkboxes"}
"""Kinds of fields that GitHub's issue forms have."""


def load(path: Path) -> dict[Any, Any]:
    found = yaml.safe_load(path.read_text(encoding="utf-8"))
    assert isinstance(found, dict)
    return found


def jobs(path: Path) -> list[dict[str, Any]]:
    return list(load(path)["jobs"].values())


def make_targets(job: dict[str, Any]) -> set[str]:
    """What a job makes; a target of its matrix stands for all of them."""
    matrix = job.get("strategy", {}).get("matrix", {})
    commands = "\n".join(step.get("run", "") for step in job["steps"])
    commands = commands.replace("${{ matrix.target }}", " ".join(matrix.get("target", ())))
    words = " ".join(re.findall(r"^make (.+)$", commands, re.M)).split()
    return {word for word in words if "=" not in word}


@pytest.fixture(scope="module")
def pinned() -> dict[str, str]:
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    return dict(line.split("==") for line in lines if "==" in line)


def test_there_are_workflows() -> None:
    assert {path.name for path in WORKFLOWS} == {"tests.yml", "weekly.yml"}
    changed = set[str]().union(*map(make_targets, jobs(GITHUB / "workflows" / "tests.yml")))
    assert changed == {"lint", "docs", "test"}


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.name)
def test_workflows_make_what_the_makefile_has(path: Path) -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    known = set(re.findall(r"^([\w-]+):", makefile, re.M))
    for job in jobs(path):
        assert make_targets(job)
        assert make_targets(job) <= known


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.name)
def test_workflows_may_only_read_and_end_by_themselves(path: Path) -> None:
    found = load(path)
    assert found["permissions"] == {"contents": "read"}
    for job in jobs(path):
        assert "permissions" not in job
        assert job["timeout-minutes"] <= 180
        for step in job["steps"]:
            assert ("uses" in step) != ("run" in step)
            assert re.fullmatch(r"actions/[\w-]+@v\d+", step.get("uses", "actions/one@v1"))
            # A branch's or an issue's name in a shell's line would be run by it.
            assert "github." not in step.get("run", "")


def test_every_python_that_is_promised_is_tested() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    promised = re.findall(r":: Python :: (3\.\d+)", "\n".join(project["classifiers"]))
    (job,) = (job for job in jobs(GITHUB / "workflows" / "tests.yml") if "strategy" in job)
    assert job["strategy"]["matrix"]["python-version"] == promised
    assert project["requires-python"] == f">={promised[0]}"


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.name)
def test_torch_comes_without_cuda(path: Path, pinned: dict[str, str]) -> None:
    assert "torch" in pinned
    assert load(path)["env"]["PIP_EXTRA_INDEX_URL"] == "https://download.pytorch.org/whl/cpu"


def test_commits_are_linted_by_the_ruff_of_make_lint(pinned: dict[str, str]) -> None:
    (hooks,) = load(ROOT / ".pre-commit-config.yaml")["repos"]
    assert hooks["rev"] == f"v{pinned['ruff']}"
    assert [hook["id"] for hook in hooks["hooks"]] == ["ruff-check", "ruff-format"]


@pytest.mark.parametrize("path", FORMS, ids=lambda path: path.name)
def test_issue_forms_are_github_s(path: Path) -> None:
    form = load(path)
    assert {"name", "description", "body"} <= set(form) <= {"name", "description", "body", "labels"}
    asked = [field for field in form["body"] if field["type"] != "markdown"]
    names = [field["id"] for field in asked]
    assert len(set(names)) == len(names)
    for field in form["body"]:
        assert field["type"] in FIELDS
        assert field["attributes"]["value" if field["type"] == "markdown" else "label"]
    assert any(field.get("validations", {}).get("required") for field in asked)


@pytest.mark.parametrize("path", FORMS, ids=lambda path: path.name)
def test_links_of_issue_forms_lead_to_files(path: Path) -> None:
    links = re.findall(r"\]\(\.\./(.+?)\)", path.read_text(encoding="utf-8"))
    assert links
    for link in links:
        file = "SECURITY.md" if link == "security/policy" else link.removeprefix("blob/main/")
        assert (ROOT / file).is_file(), link


def test_a_bug_comes_with_what_is_needed_to_see_it() -> None:
    form = load(FORMS[0])
    fields = {field["id"]: field for field in form["body"] if "id" in field}
    required = {name for name, f in fields.items() if f.get("validations", {}).get("required")}
    assert {"happened", "doctor", "versions", "link"} <= required
    assert "--record" in fields["recording"]["attributes"]["description"]
