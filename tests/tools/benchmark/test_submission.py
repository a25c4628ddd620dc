"""Submissions: what `--check` computes anew, and what it refuses."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from benchmark_tools import ENV_ID, SET, cell, part, plan

from acsar_gym.errors import ConfigError
from acsar_gym.tools.benchmark import result
from acsar_gym.tools.benchmark.store import Part

Told = dict[str, Any]
CONDITIONS = ("nominal", "dropped-5", "feedback-30")
PARTS = [
    part(),
    part(cell(condition="dropped-5"), (0.5, 0.0)),
    Part(cell(condition="feedback-30"), 0, refused="mine: made for another robot"),
]


@pytest.fixture
def row(tmp_path: Path) -> Path:
    """A sound row."""
    return result.write_row(result.make_result(plan(*CONDITIONS), PARTS), "mine", tmp_path)


def change(row: Path, how: Callable[[Told], object], *, signed: bool = True) -> None:
    """Change a row, and sign it again."""
    told = json.loads(row.read_text())
    how(told)
    if signed:
        told["sha256"] = result.hash_row(told)
    row.write_text(json.dumps(told))


def test_a_submission_is_sound(row: Path) -> None:
    assert row.name == "mine.row.json"
    assert "sound: packaged" in result.check_row(row)
    assert "4 episodes" in result.check_row(row)


def test_a_submission_over_the_port_has_fewer_scenes(tmp_path: Path) -> None:
    told = plan("nominal") | {"links": ["planar", "port"], "port_scenes": 1}
    parts = [part(), part(cell(link="port"), (0.9,))]
    row = result.write_row(result.make_result(told, parts), "mine", tmp_path)
    assert "3 episodes" in result.check_row(row)


def test_a_changed_submission_is_refused(row: Path) -> None:
    change(row, lambda told: told["cells"][0]["summary"].update(spl=1.0), signed=False)
    with pytest.raises(ConfigError, match="hash"):
        result.check_row(row)


@pytest.mark.parametrize(
    ("how", "said"),
    [
        (
            lambda told: told["cells"][0]["summary"].update(spl=1.0),
            r"cells\[0\]\.summary\.spl = 1\.0",
        ),
        (lambda told: told["rows"][0].update(success_rate=0.5), r"rows\[0\]\.success_rate = 0\.5"),
        (lambda told: told["rows"][1]["profile"].reverse(), r"rows\[1\]\.profile\[0\]"),
        (lambda told: told["rows"].pop(), "rows = "),
        (lambda told: told["paired"].append({"agent": "mine"}), "paired = "),
        (lambda told: told.update(award="gold"), "award = "),
        (lambda told: told["header"].update(scenes={}), "scenes"),
        (
            lambda told: told["header"]["scenes"][ENV_ID][SET].update(sha256="0" * 64),
            ENV_ID,
        ),
        (
            lambda told: told["header"]["scenes"][ENV_ID].update(
                mine=told["header"]["scenes"][ENV_ID][SET]
            ),
            ENV_ID,
        ),
        (
            lambda told: told["header"]["scenes"][ENV_ID][SET].update(count=1001),
            ENV_ID,
        ),
        (lambda told: told["header"]["links"].append("warp"), "links"),
        (
            lambda told: told["header"]["conditions"]["dropped-5"].update(faults={}),
            "condition 'dropped-5'",
        ),
        (lambda told: told["cells"][0].update(id="Barn-v1"), "isn't a cell"),
        (lambda told: told["cells"].append(told["cells"][0]), "isn't a cell"),
        (lambda told: told["cells"].pop(1), "planar, dropped-5"),
        (
            lambda told: told["cells"][0]["episodes"].update(scene=[8589934593, 8589934592]),
            "first 2 scenes",
        ),
        (
            lambda told: told["header"]["scenes"][ENV_ID][SET].update(count=3),
            "first 3 scenes",
        ),
        (
            lambda told: told["cells"][0]["episodes"]["score"].__setitem__(0, "gold"),
            "mine.row.json",
        ),
    ],
)
def test_what_is_not_so_is_refused_though_it_is_signed(
    row: Path, how: Callable[[Told], object], said: str
) -> None:
    change(row, how)
    with pytest.raises(ConfigError, match=said) as caught:
        result.check_row(row)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["", "{}", '{"schema": 1, "sha256": 3}', "[" * 100_000])
def test_what_is_no_submission(tmp_path: Path, text: str) -> None:
    path = tmp_path / "row.json"
    path.write_text(text)
    with pytest.raises(ConfigError) as caught:
        result.check_row(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_submission_of_too_many_values_is_refused_before_they_are_made(tmp_path: Path) -> None:
    path = tmp_path / "row.json"
    path.write_text("[" + "[]," * 1_000_000 + "[]]")
    with pytest.raises(ConfigError, match="1,000,000"):
        result.check_row(path)
