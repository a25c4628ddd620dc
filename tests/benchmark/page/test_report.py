"""The HTML report of a benchmark with made-up episodes."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest
from benchmark_tools import cell, part, plan

from acsar_gym.errors import ConfigError
from acsar_gym.tools.benchmark import result
from acsar_gym.tools.benchmark.page import page, write
from acsar_gym.tools.benchmark.page.worst import chosen, films
from acsar_gym.tools.benchmark.plan import Agent
from acsar_gym.tools.benchmark.store import Part
from acsar_gym.tools.evaluation.page import Film

pytest.importorskip("plotly")
KINDS = {"packaged": "learned", "floor": "baseline", "other": "baseline"}
PARTS = [
    part(cell(), (0.9, 0.0, 0.5, 0.7)),
    part(cell(link="bullet"), (0.9, 0.8, 0.0, 0.2)),
    part(cell("floor"), (0.5, 0.4, 0.0, 0.0)),
    part(cell(condition="dropped-5"), (0.5, 0.0)),
    Part(cell("other"), 0, refused="other: needs a LiDAR"),
]


@pytest.fixture(scope="module")
def told() -> dict[str, Any]:
    found: dict[str, Any] = json.loads(json.dumps(result.make_result(plan(**KINDS), PARTS)))
    return found


def test_the_page_has_tables_plots_and_provenance(told: dict[str, Any]) -> None:
    made = page(told)
    titles = [section.title for section in made.sections]
    assert titles == ["PointGoal-v0", "Probability of improvement", "Robustness", "Provenance"]
    html = made.html()
    for words in ("packaged", "75.0%", "other doesn&#x27;t drive PointGoal-v0", "5 % of the lines"):
        assert words in html
    assert told["header"]["scenes"]["PointGoal-v0"]["test"]["sha256"] in html
    assert not re.findall(r"<(?:img|script|link)[^>]+(?:src|href)=", html)


def test_films_are_embedded(told: dict[str, Any]) -> None:
    html = page(told, [Film("scene <1>", b"png", b"mp4")]).html()
    assert 'poster="data:image/png;base64,cG5n"' in html
    assert 'src="data:video/mp4;base64,bXA0"' in html
    assert "scene &lt;1&gt;" in html


def test_the_worst_are_of_the_best_learned_agent_in_pybullet(told: dict[str, Any]) -> None:
    some = chosen(told, 3)
    assert {(each.agent, each.link) for each in some} == {("packaged", "bullet")}
    assert [each.episode.score for each in some] == [0.0, 0.2, 0.8]
    assert chosen(told, 0) == []


def test_an_episode_whose_policy_is_missing_is_noted(told: dict[str, Any]) -> None:
    pytest.importorskip("moviepy")
    made, missing = films(told, [Agent("else", "learned", "PointGoal-v0", "x.onnx")], 1)
    assert made == []
    assert len(missing) == 1
    assert missing[0].endswith("its policy isn't here")


@pytest.mark.slow
def test_the_worst_episodes_are_driven_again_and_drawn(told: dict[str, Any]) -> None:
    pytest.importorskip("moviepy")
    made, missing = films(told, None, 1)
    assert missing == []
    assert made[0].caption.startswith("PointGoal-v0, packaged, bullet, scene 85899345")
    assert made[0].picture.startswith(b"\x89PNG")
    assert b"ftyp" in made[0].video[:12]


def test_a_full_disk_is_one_line(told: dict[str, Any]) -> None:
    if not Path("/dev/full").exists():
        pytest.skip("needs /dev/full")
    with pytest.raises(ConfigError, match="/dev/full: can't be written: No space left"):
        write(told, Path("/dev/full"), episodes=0)
