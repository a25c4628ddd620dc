"""Constants in units of the robot, those found by a search, and the search itself."""

from __future__ import annotations

import json
import math
import runpy
from pathlib import Path

import pytest

from acsar_gym import RobotConfig
from acsar_gym.resources import AGENTS
from acsar_gym.tools import baselines
from acsar_gym.tools.baselines import tuning
from acsar_gym.tools.baselines.navfn import NavfnConstants
from acsar_gym.tools.baselines.tuning import RobotUnits, find_constants

TYPES = {
    name: baselines.load_baseline(name, "x/Y-v0").constants_type for name in baselines.BASELINES
}


@pytest.fixture
def entries(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, object]]:
    """What a search found, for this test alone."""
    found: list[dict[str, object]] = [
        {"planner": "navfn", "id": "Barn", "robot": "jackal", "constants": {"turn_share": 0.4}}
    ]
    monkeypatch.setattr(tuning, "read_tuned", lambda: found)
    return found


@pytest.mark.parametrize(
    ("env_id", "robot", "share"),
    [
        ("acsar_gym/Barn-v1", RobotConfig.preset("jackal"), 0.4),
        ("acsar_gym:acsar_gym/Barn-v7", RobotConfig.preset("jackal"), 0.4),
        ("acsar_gym/Barn-v1", RobotConfig.preset("jackal").with_(body={"mass": 30.0}), 0.4),
        ("acsar_gym/Barn-v1", RobotConfig.preset("jackal").with_(max_linear=1.0), 0.67),
        ("acsar_gym/Barn-v1", RobotConfig.preset("acsar"), 0.67),
        ("acsar_gym/ObstacleGoal-v1", RobotConfig.preset("jackal"), 0.67),
    ],
)
@pytest.mark.usefixtures("entries")
def test_what_was_found_is_for_one_id_and_robots_of_one_shape_and_speed(
    env_id: str, robot: RobotConfig, share: float
) -> None:
    assert find_constants(NavfnConstants, "navfn", env_id, robot).turn_share == share


@pytest.mark.parametrize("entry", tuning.read_tuned(), ids=lambda e: f"{e['planner']}-{e['robot']}")
def test_every_entry_is_of_known_constants_and_a_search(entry: dict[str, object]) -> None:
    constants, search = entry["constants"], entry["search"]
    assert isinstance(constants, dict)
    assert constants.keys() <= TYPES[str(entry["planner"])].ranges().keys()
    assert isinstance(search, dict)
    assert search["worlds"].endswith(":validation")


@pytest.mark.parametrize("name", list(TYPES))
def test_defaults_lie_within_the_ranges_of_the_search(name: str) -> None:
    defaults = TYPES[name]()
    for field, (low, high) in TYPES[name].ranges().items():
        assert low <= getattr(defaults, field) <= high, field


def test_units_are_those_of_the_robot() -> None:
    """The Jackal's command limits allow 20 m/s^2, its wheels 60 rad/s^2 of 9.8 cm."""
    jackal = RobotUnits.of(RobotConfig.preset("jackal"), 0.1)
    assert jackal.radius == pytest.approx(math.hypot(0.254, 0.215))
    assert (jackal.speed, jackal.turning) == (2.0, 4.0)
    assert jackal.acceleration == jackal.braking == pytest.approx(5.88)
    assert jackal.spin == pytest.approx(2.0 * 5.88 / (0.37559 * 1.5))
    assert jackal.stopping == pytest.approx(4.0 / (2.0 * 5.88) + 2.0 * (jackal.lag + 0.1))
    slow = RobotUnits.of(RobotConfig.preset("acsar"), 0.1)
    assert (slow.acceleration, slow.braking) == (2.0, 3.0)


@pytest.mark.slow
def test_a_search_writes_its_entry_and_keeps_the_others(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One trial in two worlds, compared in one."""
    pytest.importorskip("optuna")
    file = tmp_path / "tuned.json"
    other = {"planner": "dwa", "id": "Barn", "robot": "husky", "constants": {}}
    file.write_text(json.dumps([other]))
    tune = runpy.run_path(str(AGENTS / "tune_baselines.py"))["main"]
    tune("turn_drive", "obstacle_goal", "acsar", 1e-3, 100, "913-914", "5000-5000", file)
    first, entry = json.loads(file.read_text())
    assert first == other
    assert (entry["planner"], entry["id"], entry["robot"]) == (
        "turn_drive",
        "ObstacleGoal",
        "acsar",
    )
    assert entry["search"] == {
        "worlds": "clutter:913-914",
        "seeds": "0-1",
        "steps": 100,
        "trials": 1,
        "score": entry["search"]["score"],
    }
    assert 0.2 < entry["search"]["score"] <= 0.5  # it reaches the goal of the first world
    assert entry["comparison"]["worlds"] == "clutter:5000-5000"
    assert entry["comparison"]["defaults"] == entry["comparison"]["tuned"]  # the first trial's
    said = capsys.readouterr().out
    assert said.startswith("trial 0: ")
    assert "\nturn_drive ObstacleGoal acsar: " in said
