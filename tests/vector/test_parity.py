"""Batches of every id against the single planar env: the same numbers from the same seeds."""

from __future__ import annotations

from collections import Counter
from typing import Any

import gymnasium
import numpy as np
import pytest
from mover_tools import HALL
from varied import RANGES

from acsar_gym import RobotConfig, World
from acsar_gym.envs.ids import full_id
from acsar_gym.errors import LinkError
from acsar_gym.registration import snake_case
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
    "lost lines": (
        "PointGoal",
        [*NAMED, ACSAR.with_(feedback_timeout=0.06), FENCED],
        {"faults": {"dropped_lines": 0.5}},
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
SILENT = "silent in the reset"


class Single:
    """The planar env, through the byte-level firmware twin; its reset may fail."""

    def __init__(self, env_id: str, arguments: dict[str, Any], options: Any = None) -> None:
        self._env = gymnasium.make(env_id, link="planar", disable_env_checker=True, **arguments)
        env: Any = self._env.unwrapped
        self.size = sum(sensor.size for sensor in env.sensors)
        self.told: Any = None
        self.options = options
        self.over = False

    def reset(self, seed: int | None = None) -> None:
        try:
            observation, info = self._env.reset(seed=seed, options=self.options)
            self.told = observation, 0.0, False, False, info
        except LinkError:
            self.told = SILENT
        self.over = False

    def step(self, action: Any) -> None:
        """A step, or a reset where the episode is over; one that failed ends the next episode."""
        if self.over:
            self.reset()
        elif self.told is SILENT:
            self.over = True
        else:
            self.told = self._env.step(action)
            self.over = self.told[2] or self.told[3]

    def close(self) -> None:
        self._env.close()


def make_batch(env_id: str, robots: int, **arguments: Any) -> Any:
    return gymnasium.make_vec(
        env_id, robots, vectorization_mode="vector_entry_point", threads=1, **arguments
    )


def compare(
    kind: str, arguments: dict[str, Any], steps: int, seed: int = 41, options: Any = None
) -> Counter[str]:
    """Every number of robot 1 against the single env; how often what happened."""
    env_id, arguments = full_id(snake_case(kind)), {"max_episode_steps": 60, **arguments}
    many = make_batch(env_id, 3, **arguments)
    mine = {name: of_robot_1(value) for name, value in (options or {}).items()}
    one = Single(env_id, arguments, mine)
    one.reset(seed)
    seen, infos = many.reset(seed=seed - 1, options=options)
    rewards, ends, count = np.zeros(3), np.zeros((2, 3)), Counter[str]()
    rng = np.random.default_rng(0)
    for step in range(steps):
        compare_told(one, 1, seen, rewards, ends, infos)
        if one.told is SILENT:
            count["failed"] += one.over
        else:
            *_, end, cut, info = one.told
            count["ends"] += end or cut
            count["cut"] += info.get("fault") == 1.0
            count["stale"] += info["sent_reason"] == 3.0
        actions = rng.uniform(-1.0, 1.0, (3, 2)).astype(np.float32)
        actions[:, 0] = abs(actions[:, 0]) if step % 100 < 70 else actions[:, 0]
        actions *= step % 17 != 0  # a stop is immediate
        seen, rewards, *both, infos = many.step(actions)
        ends = np.array(both)
        one.step(actions[1])
    many.close()
    one.close()
    return count


def compare_told(
    one: Single, i: int, seen: Any, rewards: Any, ends: Any, infos: dict[str, Any]
) -> None:
    """Every number that robot i of a batch is told against the single env's."""
    if one.told is SILENT:
        assert not one.over or (rewards[i], *ends[:, i], infos["fault"][i]) == (0.0, 0, 1, 1.0)
        return
    expected, reward, *end, info = one.told
    assert seen[i] == pytest.approx(expected, abs=1e-6)  # float32
    assert (rewards[i], *ends[:, i]) == (pytest.approx(float(reward), abs=1e-9), *end)
    info = {key: value for key, value in info.items() if key != "fault_reason"}
    got = {key: infos[key][i] for key in info}
    assert numbers(got) == pytest.approx(numbers(info), abs=1e-9, nan_ok=True)


def numbers(info: dict[str, Any]) -> dict[str, float]:
    """Info without arrays: each of their numbers has a name of its own."""
    return {f"{key} {k}": x for key, value in info.items() for k, x in enumerate(np.ravel(value))}


def of_robot_1(value: Any) -> Any:
    """What an option asks of the second robot."""
    rows = np.asarray(value)
    each = rows.ndim == 2 or (rows.ndim == 1 and len(rows) == 3)
    row = rows[1] if each else rows
    return int(row) if row.ndim == 0 else tuple(row.tolist())


@pytest.mark.parametrize("name", CASES)
def test_a_robot_of_the_batch_is_the_single_planar_env(name: str) -> None:
    kind, arguments, options = CASES[name]
    assert compare(kind, arguments, 200, options=options)["ends"] >= 2


@pytest.mark.parametrize("name", ROBOTS)
def test_any_robot_of_a_batch_is_the_single_planar_one(name: str) -> None:
    kind, robot = ROBOTS[name]
    worlds = {"PointGoal": {}, "ObstacleGoal": {"worlds": REGIONS}}.get(kind, {"worlds": PATH})
    assert compare(kind, {"robot": robot, **worlds}, 100)["ends"] >= 1


@pytest.mark.parametrize("name", FLEETS)
def test_each_robot_of_a_fleet_is_the_single_planar_one(name: str) -> None:
    compare_fleet(*FLEETS[name], 60)


@pytest.mark.parametrize("name", RESETS)
def test_options_of_a_reset_are_for_each_robots_own_worlds(name: str) -> None:
    arguments = {"worlds": "clutter:10-19"}
    compare_fleet("ObstacleGoal", NAMED, arguments, 40, RESETS[name])


def compare_fleet(
    kind: str, fleet: Any, arguments: dict[str, Any], steps: int, options: Any = None
) -> None:
    """Every number of all robots of a batch, nearly two of each kind, against single envs."""
    env_id, arguments = full_id(snake_case(kind)), {"max_episode_steps": 25, **arguments}
    robots = 2 * len(fleet) - 1
    many = make_batch(env_id, robots, robot=fleet, **arguments)
    each = [
        Single(env_id, {"robot": fleet[i % len(fleet)], **arguments}, options)
        for i in range(robots)
    ]
    for i, one in enumerate(each):
        one.reset(41 + i)
    seen, infos = many.reset(seed=41, options=options)
    rewards, ends = np.zeros(robots), np.zeros((2, robots))
    rng = np.random.default_rng(0)
    for step in range(steps):
        for i, one in enumerate(each):
            compare_told(one, i, seen, rewards, ends, infos)
        actions = rng.uniform(-1.0, 1.0, (robots, 2)).astype(np.float32)
        actions *= step % 17 != 0
        seen, rewards, *both, infos = many.step(actions)
        ends = np.array(both)
        for action, one in zip(actions, each, strict=True):
            one.step(action)
    many.close()
    for one in each:
        one.close()


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
    arguments = {"max_episode_steps": 25, **arguments}
    assert compare(kind, arguments, 100, 12)["ends"] >= 2


# Lost and late lines


DROPPED: dict[str, Any] = {"dropped_lines": 0.3}
DELAYED: dict[str, Any] = {"dropped_lines": 0.2, "late_lines": 0.2, "lateness": 0.033}
LONG: dict[str, Any] = {"late_lines": 0.05, "lateness": 0.2}
FAULTS: dict[str, tuple[dict[str, Any], RobotConfig]] = {
    "limits": (DROPPED, ACSAR),
    "geofence": (DROPPED, FENCED.with_(feedback_timeout=0.2)),
    "odd feedback": (DELAYED, ACSAR.with_(firmware={"feedback_rate": 30.0})),
    "time-outs": ({"dropped_lines": 0.5}, ACSAR.with_(feedback_timeout=0.06)),
    "some episodes": ({"dropped_lines": 0.7, "episodes": 0.5}, ACSAR),
    "late on a slow wire": (LONG | {"direction": "commands"}, ACSAR.with_(baud_rate=38400)),
    "late and stale": (LONG | {"direction": "feedback"}, ACSAR.with_(feedback_timeout=0.15)),
    "half of 25 Hz": (
        {"dropped_lines": 0.5},
        ACSAR.with_(firmware={"feedback_rate": 25.0}, feedback_timeout=0.06),
    ),
}
VARIED = {"latency": (0.0, 0.03), "feedback_rate": (20.0, 60.0), "mass": (0.9, 1.1)}


@pytest.mark.parametrize("name", FAULTS)
def test_the_same_lines_are_lost(name: str) -> None:
    faults, robot = FAULTS[name]
    count = compare("PointGoal", {"robot": robot, "faults": faults}, 150)
    assert (count["cut"] > 0) == (name in {"time-outs", "late and stale", "half of 25 Hz"})
    assert (count["failed"] > 0) >= (name == "half of 25 Hz")
    assert (count["stale"] > 0) >= (name in {"time-outs", "late and stale"})


@pytest.mark.parametrize(
    ("kind", "more"),
    [
        ("ObstacleGoal", {"worlds": "clutter:6", "randomization": VARIED}),
        ("ObstacleGoal", {"worlds": "clutter:6", "faults": {"dropped_lines": 0.5}}),
        ("ObstacleGoal", {"worlds": MOVING}),
        ("PathFollow", {"worlds": "smooth_path:6"}),
    ],
    ids=["randomized", "noise of scans goes on after a cut", "movers", "path"],
)
def test_the_same_lines_are_lost_with_every_task(kind: str, more: dict[str, Any]) -> None:
    timeout = 0.3 if "randomization" in more else 0.06
    more = {"faults": DELAYED, "robot": ACSAR.with_(feedback_timeout=timeout)} | more
    compare(kind, more, 150)


def batch(**arguments: Any) -> Any:
    return gymnasium.make_vec(
        "acsar_gym/PointGoal-v0", 40, vectorization_mode="vector_entry_point", **arguments
    )


def test_people_are_the_same_for_a_whole_episode() -> None:
    """Though crowds are chaotic; the robot drives to and fro, and turns."""
    arguments: dict[str, Any] = {"worlds": PLAZA, "max_episode_steps": 800}
    many = make_batch("acsar_gym/ObstacleGoal-v1", 3, **arguments)
    one = Single("acsar_gym/ObstacleGoal-v1", arguments)
    one.reset(STEADY + 1)
    seen, infos = many.reset(seed=STEADY)
    rewards, ends, near = np.zeros(3), np.zeros((2, 3)), 0
    rng = np.random.default_rng(1)
    for _ in range(600):
        compare_told(one, 1, seen, rewards, ends, infos)
        near += infos["closest_person"][1] < 0.6
        actions = (rng.uniform(-1.0, 1.0, (3, 2)) * (0.3, 1.0)).astype(np.float32)
        seen, rewards, *both, infos = many.step(actions)
        ends = np.array(both)
        one.step(actions[1])
        assert not one.over
    assert near > 20
    many.close()
    one.close()


def test_what_is_told_of_a_silent_robot_is_what_it_was_told_last() -> None:
    robot = ACSAR.with_(feedback_timeout=0.06)
    env = batch(robot=robot, faults={"dropped_lines": 0.5}, autoreset_mode="SameStep")
    before, told = env.reset(seed=0)
    cut = np.zeros(40, np.bool_)
    for _ in range(20):
        after, rewards, terminated, truncated, info = env.step(np.full((40, 2), 0.5))
        cut = truncated
        if cut.any():
            break
        before, told = after, info
    final, last = info["final_obs"], info["final_info"]
    assert not (terminated & cut).any()
    assert (rewards[cut] == 0.0).all()
    assert (last["fault"] == cut).all()
    for robot_number in np.flatnonzero(cut):
        assert (final[robot_number] == before[robot_number]).all()
        for key in ("odom_x", "true_x", "true_theta", "feedback_age", "sent_linear"):
            assert last[key][robot_number] == told[key][robot_number]
    assert (info["fault"] == 0.0).all()
    assert (last["episode_length"][cut] >= 1).all()
    env.close()
