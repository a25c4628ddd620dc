"""Batches of every id against the single planar env: the same numbers from the same seeds."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium
import numba
import numpy as np
import pytest
from mover_tools import HALL
from varied import RANGES

from acsar_gym import RobotConfig, State, World
from acsar_gym.envs.ids import full_id, make_vec
from acsar_gym.registration import snake_case
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
PATH = World(goal=Region(3.0, 2.0), path=np.array([[0.0, 0.0], [2.0, 0.0], [3.0, 2.0]]))
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
WORN = ACSAR.with_(left_wheel_radius_multiplier=0.97, right_wheel_radius_multiplier=1.01)
UNEVEN = ACSAR.with_(
    motor={
        "gain": [1.0, 0.97, 1.02, 0.95],
        "time_constant": [0.08, 0.12, 0.0, 0.1],
        "deadband": [0.0, 0.3, 0.5, 0.1],
        "acceleration": [60.0, 20.0, 33.0, 1000.0],
    }
)
FITTED = UNEVEN.with_(
    left_wheel_radius_multiplier=1.02,
    encoder={"quantum": 0.095},
    firmware={"command_delay": 0.0082, "feedback_rate": 50.0, "loop_rate": 400.0},
    body={"turn_factor": 1.71},
)
LATE = ACSAR.with_(
    baud_rate=38400, firmware={"processing_time": 0.02}, linear_limits={"max_jerk": 20.0}
)
ONES = np.ones(3)
CASES: dict[str, tuple[str, dict[str, Any], dict[str, Any]]] = {
    "obstacles": ("ObstacleGoal", {"worlds": "clutter:6"}, {}),
    "a polygon": ("ObstacleGoal", {"worlds": "clutter:6", "robot": POINTED}, {}),
    "BARN": ("Barn", {"worlds": "barn:4"}, {}),
    "people": ("Crowd", {"worlds": "crowd_reacting:6"}, {}),
    "movers of both kinds, and none": ("ObstacleGoal", {"worlds": MOVING}, {}),
    "movers without a LiDAR": ("ObstacleGoal", {"worlds": MOVING, "sensors": ()}, {}),
    "DynaBARN": ("DynaBarn", {"worlds": "dynabarn:4"}, {}),
    "smooth path": ("PathFollow", {"worlds": "smooth_path:6"}, {}),
    "open floor": ("PointGoal", {"goal_distance": (0.3, 1.0)}, {}),
    "a goal": ("PointGoal", {}, {"goal": np.array([[1.0, 0.0], [0.5, 0.5], [np.nan, np.nan]])}),
    "a world": ("ObstacleGoal", {"worlds": "open:100-105"}, {"world": [101, 104, 102]}),
    "difficulty": ("ObstacleGoal", {"worlds": "open:100-119"}, {"difficulty": (0.3, 0.7)}),
    "difficulty of each": (
        "PathFollow",
        {"worlds": "smooth_path:20", "difficulty": (0.2, 0.6)},
        {"difficulty": np.column_stack([ONES * 0.3, [0.4, 0.5, 0.6]])},
    ),
}
ROBOTS: dict[str, tuple[str, RobotConfig]] = {
    "odd feedback": ("PointGoal", ACSAR.with_(firmware={"feedback_rate": 30.0})),
    "slow wire": ("PointGoal", ACSAR.with_(baud_rate=38400)),
    "coarse encoders": (
        "PointGoal",
        ACSAR.with_(encoder={"counts_per_revolution": 100, "window": 0.02}),
    ),
    "weak motors": (
        "PointGoal",
        ACSAR.with_(motor={"max_speed": 5.0, "deadband": 1.0, "time_constant": 0.0}),
    ),
    "geofence": ("ObstacleGoal", FENCED),
    "limits on a slow wire": ("PathFollow", LATE),
    "dropouts": ("ObstacleGoal", ACSAR.with_(lidar={"dropouts": 0.1, "rays": 33})),
    "command delay without limits": (
        "PointGoal",
        UNLIMITED.with_(firmware={"command_delay": 0.0371}),
    ),
    "commands that take longer than a step": (
        "PointGoal",
        ACSAR.with_(firmware={"command_delay": 0.2137}),
    ),
    "radii": ("PathFollow", WORN),
    "single motors": ("PointGoal", UNEVEN),
    "grippy sideways": ("ObstacleGoal", ACSAR.with_(body={"turn_factor": 2.0})),
    "everything new": ("PathFollow", FITTED),
    "slow LiDAR": ("ObstacleGoal", ACSAR.with_(lidar={"rate": 7.0, "field_of_view": 4.7})),
}

NAMED = ["acsar", "jackal", "husky"]
FLEETS: dict[str, tuple[str, Any, dict[str, Any]]] = {
    "open floor": ("PointGoal", NAMED, {}),
    "free ones among limited ones": (
        "PointGoal",
        [UNLIMITED, LIMITED, UNEVEN, FITTED.with_(firmware={"loop_rate": 200.0})],
        {},
    ),
    "obstacles": ("ObstacleGoal", [*NAMED, "drawn:3", POINTED], {"worlds": "clutter:6"}),
    "movers": ("ObstacleGoal", [*NAMED, POINTED], {"worlds": MOVING, "max_episode_steps": 40}),
    "paths": ("PathFollow", [*NAMED, "drawn:4"], {"worlds": "smooth_path:6"}),
    "randomized": ("ObstacleGoal", NAMED, {"worlds": "open:6", "randomization": RANGES}),
    "as trained": (
        "PointGoal",
        [ACSAR, "husky", ACSAR.with_(firmware={"delay_samples": [0.01, 0.02, 0.03]})],
        {"randomization": True},
    ),
}
"""Task, robots and options of batches whose robots differ."""
RESETS: dict[str, Any] = {
    "difficulty": {"difficulty": (0.3, 0.7)},
    "a goal": {"world": 12, "goal": (2.0, 1.0)},
}
"""Options of resets of such batches, in worlds of several footprints."""

STEADY = 0
"""A seed with which nobody runs into a robot that stays near the start."""


class Single:
    """The planar env, through the byte-level firmware twin. It resets like a batch's robot.

    Attributes:
        result: What the last reset or step returned.
    """

    def __init__(self, env_id: str, arguments: dict[str, Any], options: Any = None) -> None:
        self.env = gymnasium.make(env_id, link="planar", disable_env_checker=True, **arguments)
        self.options = options
        self.result: Any = None

    def reset(self, seed: int | None = None) -> None:
        observation, info = self.env.reset(seed=seed, options=self.options)
        self.result = (observation, 0.0, False, False, info)

    def step(self, action: Any) -> None:
        if self.result[2] or self.result[3]:
            self.reset()
        else:
            self.result = self.env.step(action)


def compare(
    kind: str,
    arguments: dict[str, Any],
    steps: int,
    robots: Sequence[int] = (1,),
    count: int = 3,
    seed: int = 40,
    options: Any = None,
) -> int:
    """Compare every number of some robots of a batch with single envs; how many episodes ended."""
    env_id = full_id(snake_case(kind))
    arguments = {"max_episode_steps": 60, **arguments}
    fleet = arguments.get("robot")
    batch: Any = make_vec(env_id, count, threads=1, **arguments)
    singles = {}
    for i in robots:
        robot = {"robot": fleet[i % len(fleet)]} if isinstance(fleet, list) else {}
        chosen = {name: row_of(value, i, count) for name, value in (options or {}).items()}
        singles[i] = Single(env_id, arguments | robot, chosen)
        singles[i].reset(seed + i)

    observations, infos = batch.reset(seed=seed, options=options)
    results: Any = (observations, np.zeros(count), np.zeros(count), np.zeros(count), infos)
    rng = np.random.default_rng(0)
    ends = 0
    for step in range(steps):
        for i, single in singles.items():
            compare_results(single.result, results, i)
            ends += single.result[2] or single.result[3]
        actions = rng.uniform(-1.0, 1.0, (count, 2)).astype(np.float32)
        actions[:, 0] = abs(actions[:, 0]) if step % 100 < 70 else actions[:, 0]
        actions *= step % 17 != 0  # a stop is immediate
        results = batch.step(actions)
        for i, single in singles.items():
            single.step(actions[i])
    for env in (batch, *(single.env for single in singles.values())):
        env.close()
    return ends


def compare_results(expected: Any, results: Any, i: int) -> None:
    """Compare every number that robot i of a batch returns with the single env's."""
    observation, reward, *ends, info = expected
    observations, rewards, terminated, truncated, infos = results
    assert observations[i] == pytest.approx(observation, abs=1e-6)  # float32
    assert rewards[i] == pytest.approx(float(reward), abs=1e-9)
    assert [terminated[i], truncated[i]] == ends
    for key, value in info.items():
        assert np.ravel(infos[key][i]) == pytest.approx(np.ravel(value), abs=1e-9, nan_ok=True)


def row_of(value: Any, robot: int, count: int) -> Any:
    """An option's value for one of the robots."""
    rows = np.asarray(value)
    is_for_each = rows.ndim == 2 or (rows.ndim == 1 and len(rows) == count)
    row = rows[robot] if is_for_each else rows
    return int(row) if row.ndim == 0 else tuple(row.tolist())


@pytest.mark.parametrize("name", CASES)
def test_a_robot_of_the_batch_is_the_single_planar_env(name: str) -> None:
    kind, arguments, options = CASES[name]
    assert compare(kind, arguments, 200, options=options) >= 2


@pytest.mark.parametrize("name", ROBOTS)
def test_any_robot_of_a_batch_is_the_single_planar_one(name: str) -> None:
    kind, robot = ROBOTS[name]
    worlds = {"PointGoal": {}, "ObstacleGoal": {"worlds": REGIONS}}.get(kind, {"worlds": PATH})
    assert compare(kind, {"robot": robot, **worlds}, 100) >= 1


def compare_fleet(
    kind: str, fleet: Any, arguments: dict[str, Any], steps: int, options: Any = None
) -> None:
    """Compare all robots of a batch, nearly two of each kind."""
    count = 2 * len(fleet) - 1
    arguments = {"robot": fleet, "max_episode_steps": 25, **arguments}
    compare(kind, arguments, steps, range(count), count, options=options)


@pytest.mark.parametrize("name", FLEETS)
def test_each_robot_of_a_fleet_is_the_single_planar_one(name: str) -> None:
    compare_fleet(*FLEETS[name], 60)


@pytest.mark.parametrize("name", RESETS)
def test_options_of_a_reset_are_for_each_robots_own_worlds(name: str) -> None:
    arguments = {"worlds": "clutter:10-19"}
    compare_fleet("ObstacleGoal", NAMED, arguments, 40, RESETS[name])


FINE = ACSAR.with_(firmware={"loop_rate": 500.0})
WIDE = RANGES | {"latency": (0.0, 0.03), "feedback_rate": (5.0, 90.0)}
DELAYS = {"command_delay": (0.0, 0.3), "delay_samples": (0.0, 0.1), "latency": (0.0, 0.05)}
SLOW = {"firmware": {"processing_time": 0.061}}
EVERYTHING: list[tuple[str, dict[str, Any]]] = [
    ("ObstacleGoal", {"randomization": RANGES, "worlds": REGIONS}),
    *(("PointGoal", {"randomization": WIDE, "robot": r}) for r in (UNLIMITED, LATE, FITTED, FINE)),
    *(("PointGoal", {"randomization": DELAYS, "robot": robot}) for robot in (ACSAR, UNLIMITED)),
    *(
        ("PointGoal", {"policy_rate": 50.0, "robot": robot.with_(**SLOW)})
        for robot in (ACSAR, UNLIMITED)  # a wire that is slower than a step
    ),
]


@pytest.mark.parametrize(("kind", "arguments"), EVERYTHING)
def test_everything_at_once_is_the_single_envs(kind: str, arguments: dict[str, Any]) -> None:
    assert compare(kind, {"max_episode_steps": 25, **arguments}, 100, seed=11) >= 2


def test_people_are_the_same_for_a_whole_episode() -> None:
    """Though crowds are chaotic. The robot drives to and fro, and turns."""
    arguments: dict[str, Any] = {"worlds": PLAZA, "max_episode_steps": 800}
    batch = make_vec("acsar_gym/ObstacleGoal-v1", 3, threads=1, **arguments)
    single = Single("acsar_gym/ObstacleGoal-v1", arguments)
    single.reset(STEADY + 1)
    batch.reset(seed=STEADY)
    rng = np.random.default_rng(1)
    near = 0
    for _ in range(600):
        actions = (rng.uniform(-1.0, 1.0, (3, 2)) * (0.3, 1.0)).astype(np.float32)
        results = batch.step(actions)
        single.step(actions[1])
        compare_results(single.result, results, 1)
        near += results[4]["closest_person"][1] < 0.6
        assert not single.result[2]
    assert near > 20
    batch.close()
    single.env.close()


def test_every_field_of_a_state_is_the_single_envs() -> None:
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
    batch.close()
    single.close()
