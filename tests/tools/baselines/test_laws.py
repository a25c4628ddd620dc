"""Baselines by name, where they can't drive, and the laws without a map."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from acsar_gym import RobotConfig
from acsar_gym.errors import PolicyError
from acsar_gym.tools import baselines
from acsar_gym.tools.baselines import BaselinePolicy
from acsar_gym.tools.baselines.base import RobotUnits, find_constants, read_constants
from acsar_gym.tools.baselines.navfn import NavfnConstants
from acsar_gym.tools.baselines.orca import OrcaConstants
from acsar_gym.tools.evaluation import runs
from acsar_gym.tools.policies.policy import DecodedObservation, PolicyContext

CONFIG = RobotConfig.preset("acsar")
JACKAL = RobotConfig.preset("jackal")
AHEAD = np.column_stack([0.25 * np.arange(1, 5), np.zeros(4)])


def equipped(name: str) -> BaselinePolicy:
    """A baseline for the default robot, at 10 Hz."""
    policy = baselines.load_baseline(name, "acsar_gym/ObstacleGoal-v1")
    setting = PolicyContext(CONFIG, "a task", 0.1, 0.3, {}, scale=10.0, rays=None)
    policy.equip(setting)
    return policy


@pytest.mark.parametrize(("bearing", "wanted"), [(0.2, (0.5, 0.5)), (-3.0, (0.0, -7.5))])
def test_turn_drive(bearing: float, wanted: tuple[float, float]) -> None:
    observation = DecodedObservation(bearing=bearing)
    assert equipped("turn_drive").act(observation) == pytest.approx(wanted)


@pytest.mark.parametrize("offset", [0.0, 0.1])
def test_pure_pursuit_of_a_straight_path(offset: float) -> None:
    """The robot is `offset` to the left of the path."""
    points = AHEAD - (0.0, offset)
    observation = DecodedObservation(cross_track=offset, heading_error=0.0, points=points)
    linear, angular = equipped("pure_pursuit").act(observation)
    assert linear == pytest.approx(CONFIG.max_linear, rel=0.5)
    assert angular == pytest.approx(-2.0 * offset / 0.3**2 * linear, rel=0.1)


def test_load_policy_takes_a_baselines_name() -> None:
    policy = runs.load_policy("turn_drive", trust=False, env="point_goal")
    run = runs.evaluate_policy(policy, "planar", None, range(1))
    assert run.summary.success_rate == 1.0
    assert (policy.about["file"], len(policy.sha256 or "")) == ("turn_drive", 64)


@pytest.mark.parametrize(
    ("name", "env", "message"),
    [
        ("nosuch", "", "policies: barn.*baselines: turn_drive, pure_pursuit, navfn, dwa, "),
        ("dwa", "", "--policy dwa --env obstacle_goal"),
        ("navfn", "point_goal", "needs a LiDAR"),
        ("turn_drive", "path_follow", "needs a goal"),
    ],
)
def test_baselines_report_what_they_cant_drive(name: str, env: str, message: str) -> None:
    with pytest.raises(PolicyError, match=message):
        policy = runs.load_policy(name, trust=False, env=env)
        runs.evaluate_policy(policy, "planar", None, range(1))


def test_is_baseline_prefers_a_file_of_that_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert baselines.is_baseline("dwa")
    Path("dwa").write_text("not a policy")
    with pytest.raises(PolicyError, match="dwa"):
        runs.load_policy("dwa", trust=False, env="point_goal")


def test_find_constants_for_an_id_and_robots_of_a_shape_and_speed() -> None:
    heavy = JACKAL.with_(body={"mass": 30.0})
    assert find_constants("navfn", "acsar_gym:acsar_gym/Barn-v7", heavy)["turn_share"] == 0.924
    assert not find_constants("navfn", "acsar_gym/Barn-v1", JACKAL.with_(max_linear=1.0))
    assert not find_constants("navfn", "mine/Task-v0", JACKAL)


@pytest.mark.parametrize("name", list(read_constants()))
def test_read_constants_of_existing_planners_and_presets(name: str) -> None:
    defaults = baselines.load_baseline(name, "x/Y-v0").constants
    for robots in read_constants()[name].values():
        for robot, constants in robots.items():
            assert RobotConfig.preset(robot)
            assert defaults._replace(**constants) != defaults


def test_constants_are_multiples_of_the_robots_limits() -> None:
    units = RobotUnits.of(CONFIG, 0.1)
    constants = units.scale(NavfnConstants())
    assert constants.min_speed == pytest.approx(0.16 * CONFIG.max_linear)
    assert constants.turn_share == pytest.approx(0.67 * CONFIG.max_angular)
    assert constants.min_carrot == pytest.approx(0.83 * math.hypot(*CONFIG.outline[0]))
    assert (constants.arc_time, units.scale(OrcaConstants()).delay) == pytest.approx((1.0, 0.15))
