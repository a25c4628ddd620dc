"""Batches of every id against the single planar env: the same numbers from the same seeds."""

from __future__ import annotations

from typing import Any

import gymnasium
import numba
import numpy as np
import pytest
from scenes import HALL, RANGES

from acsar_gym import RobotConfig, State, World
from acsar_gym.envs.ids import make_vec
from acsar_gym.sensors import MOVERS
from acsar_gym.vector.kernel.task import state_of
from acsar_gym.worlds import Region
from acsar_gym.worlds.movers import Repeat, walk
from acsar_gym.worlds.world import make_rectangle

ACSAR = RobotConfig.preset("acsar")
REGIONS = World(
    np.array([[0.0, 2.0, 0.3], [1.0, -2.0, 0.4]]),
    np.array([[-6.0, -6.0, 6.0, -6.0]]),
    Region(-3.0, 0.0, 1.0),
    Region(3.0, 0.0, 1.0),
    np.array([[-3.0, 0.0], [3.0, 0.0]]),
)
PLAZA = World(
    np.array([[1.0, 2.0, 0.3], [-1.0, -2.0, 0.2]]),
    make_rectangle(-6.0, -4.0, 6.0, 4.0),
    Region(-3.0, 0.0, 0.5),
    Region(3.0, 0.0, 0.5),
    movers=[
        walk(
            np.random.default_rng(number).uniform((-5, -3), (5, 3), (3, 2)),
            speed=0.5 + 0.1 * number,
            repeat=Repeat(number % 3),
            radius=0.2 + 0.01 * number,
            phase=float(number),
            spread=3.0,
            reacts=number % 3 > 0,
            sees_robot=number % 2 > 0,
        )
        for number in range(12)
    ],
)
"""Where people walk, most of whom react."""
MOVING = [HALL, PLAZA, REGIONS]
LIMITED = ACSAR.with_(
    linear_limits={"max_velocity": 0.4, "max_acceleration": 1.0},
    angular_limits={"max_acceleration": 3.0, "max_jerk": 60.0},
)
UNLIMITED = ACSAR.with_(
    linear_limits={"max_acceleration": None}, angular_limits={"max_acceleration": None}
)
POINTED = ACSAR.with_(
    footprint=[(0.4, 0.2), (-0.2, 0.2), (-0.2, -0.2), (0.4, -0.2), (0.5, 0.0)],
    lidar={"noise": 0.0},
)
FENCED = ACSAR.with_(geofence={"max_x": 0.6, "min_y": -0.3, "max_y": 0.3})
FITTED = ACSAR.with_(
    motor={
        "gain": [1.0, 0.97, 1.02, 0.95],
        "time_constant": [0.08, 0.12, 0.0, 0.1],
        "deadband": [0.0, 0.3, 0.5, 0.1],
        "acceleration": [60.0, 20.0, 33.0, 1000.0],
    },
    left_wheel_radius_multiplier=1.02,
    encoder={"quantum": 0.095},
    firmware={"command_delay": 0.0082, "feedback_rate": 50.0, "loop_rate": 400.0},
    body={"turn_factor": 1.71},
)
LATE = ACSAR.with_(
    baud_rate=38400, firmware={"processing_time": 0.02}, linear_limits={"max_jerk": 20.0}
)
COARSE = ACSAR.with_(
    encoder={"counts_per_revolution": 100, "window": 0.02},
    motor={"max_speed": 5.0, "deadband": 1.0, "time_constant": 0.0},
)
SCANNED = ACSAR.with_(lidar={"rate": 7.0, "field_of_view": 4.7, "dropouts": 0.1, "rays": 33})
NAMED = ["acsar", "jackal", "husky"]


@pytest.mark.parametrize(
    ("kind", "arguments", "options"),
    [
        ("PointGoal", {"robot": COARSE}, {}),
        ("ObstacleGoal", {"worlds": REGIONS, "robot": FENCED}, {}),
        ("ObstacleGoal", {"worlds": REGIONS, "robot": SCANNED}, {}),
        ("ObstacleGoal", {"worlds": MOVING, "robot": "jackal", "sensors": [MOVERS]}, {}),
        ("Barn", {"worlds": "barn:4"}, {}),
        ("Crowd", {"worlds": "crowd_reacting:6"}, {}),
        ("DynaBarn", {"worlds": "dynabarn:4"}, {}),
        ("PointGoal", {}, {"goal": np.array([[1.0, 0.0], [0.5, 0.5], [np.nan, np.nan]])}),
        ("ObstacleGoal", {"worlds": "open:100-105"}, {"world": [101, 104, 102]}),
        (
            "PathFollow",
            {"worlds": "smooth_path:20", "difficulty": (0.2, 0.6)},
            {"difficulty": np.array([[0.3, 0.4], [0.3, 0.5], [0.3, 0.6]])},
        ),
    ],
)
def test_batch_robot_is_the_single_planar_env(
    kind: str, arguments: dict[str, Any], options: dict[str, Any], compare: Any
) -> None:
    assert compare(kind, arguments, 200, options=options) >= 1


@pytest.mark.parametrize(
    ("kind", "fleet", "arguments", "options"),
    [
        ("PointGoal", [UNLIMITED, LIMITED, ACSAR], {}, {}),
        (
            "ObstacleGoal",
            [*NAMED, "drawn:3", POINTED],
            {"worlds": "clutter:6"},
            {"difficulty": (0.3, 0.7)},
        ),
        ("ObstacleGoal", [*NAMED, POINTED], {"worlds": MOVING, "max_episode_steps": 40}, {}),
        (
            "PointGoal",
            [ACSAR, "husky", ACSAR.with_(firmware={"delay_samples": [0.01, 0.02, 0.03]})],
            {"randomization": True},
            {},
        ),
    ],
)
def test_fleet_robots_are_single_planar_ones(
    kind: str, fleet: Any, arguments: dict[str, Any], options: dict[str, Any], compare: Any
) -> None:
    """All robots of a batch, nearly two of each kind."""
    count = 2 * len(fleet) - 1
    arguments = {"robot": fleet, "max_episode_steps": 25, **arguments}
    compare(kind, arguments, 60, range(count), count, options=options)


WIDE = RANGES | {"latency": (0.0, 0.03), "feedback_rate": (5.0, 90.0)}
SLOW = UNLIMITED.with_(firmware={"processing_time": 0.061})
"""With a wire that is slower than a step at 50 Hz."""


@pytest.mark.parametrize(
    ("kind", "arguments"),
    [
        ("ObstacleGoal", {"randomization": RANGES, "worlds": REGIONS}),
        *(("PointGoal", {"randomization": WIDE, "robot": robot}) for robot in (LATE, FITTED)),
        ("PointGoal", {"randomization": {"command_delay": (0.0, 0.3)}, "robot": UNLIMITED}),
        ("PointGoal", {"policy_rate": 50.0, "robot": SLOW}),
    ],
)
def test_randomized_batch_is_the_single_env(
    kind: str, arguments: dict[str, Any], compare: Any
) -> None:
    assert compare(kind, {"max_episode_steps": 25, **arguments}, 100, seed=11) >= 2


def test_batch_has_the_same_people_for_a_whole_episode(compare: Any) -> None:
    """Though crowds are chaotic. The robot drives to and fro, and turns."""
    arguments: dict[str, Any] = {"worlds": PLAZA, "max_episode_steps": 800}
    assert compare("ObstacleGoal", arguments, 600, seed=0, speed=0.3) <= 2


def test_state_of_a_batch_has_every_field_of_the_single_env() -> None:
    """Also those that no task of this package uses."""
    arguments: dict[str, Any] = {"worlds": "smooth_path:3", "sensors": ["lidar"]}
    batch = make_vec("acsar_gym/PathFollow-v0", 2, **arguments)
    single = gymnasium.make("acsar_gym/PathFollow-v0", link="planar", **arguments)
    env: Any = single.unwrapped
    inner: Any = batch.batch
    read_state = numba.njit(
        lambda tables, robot, setup, spawns: state_of(tables, robot, setup[0], spawns)
    )

    batch.reset(seed=4)
    single.reset(seed=5)
    for _ in range(12):
        state = read_state(inner.tables, 1, inner._setups, inner._spawns)
        for name in State._fields:
            value = getattr(state, name)
            tolerance = 1e-6 if name == "sensed" else 1e-9
            expected = getattr(env.episode.state, name)
            assert np.shape(value) == np.shape(expected), name
            assert value == pytest.approx(expected, abs=tolerance), name
            assert type(value) is type(expected), name
        batch.step(np.full((2, 2), 0.75))
        single.step(np.full(2, 0.75, np.float32))
