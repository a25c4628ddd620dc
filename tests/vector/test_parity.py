"""Batches of every id against the single planar env: the same numbers from the same seeds."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
from varied import RANGES

from acsar_gym import RobotConfig, World
from acsar_gym.envs import (
    BarnVectorEnv,
    ObstacleGoalVectorEnv,
    PathFollowVectorEnv,
    PointGoalVectorEnv,
)
from acsar_gym.envs.ids import full_id
from acsar_gym.errors import ConfigError, WorldError
from acsar_gym.registration import snake_case
from acsar_gym.vector.kernel import layout
from acsar_gym.worlds import Region, generators

ACSAR = RobotConfig.preset("acsar")
REGIONS = World(
    np.array([[0.0, 2.0, 0.3], [1.0, -2.0, 0.4]]),
    np.array([[-6.0, -6.0, 6.0, -6.0]]),
    Region(-3.0, 0.0, 1.0),
    Region(3.0, 0.0, 1.0),
    np.array([[-3.0, 0.0], [3.0, 0.0]]),
)
PATH = World(goal=Region(3.0, 2.0), path=np.array([[0.0, 0.0], [2.0, 0.0], [3.0, 2.0]]))
LIMITED = ACSAR.with_(
    linear_limits={"max_velocity": 0.4, "max_acceleration": 1.0},
    angular_limits={"max_acceleration": 3.0, "max_jerk": 60.0},
)
UNLIMITED = ACSAR.with_(
    linear_limits={"max_acceleration": None}, angular_limits={"max_acceleration": None}
)
FORK = ACSAR.with_(
    footprint=[(0.4, 0.2), (-0.2, 0.2), (-0.2, -0.2), (0.4, -0.2), (0.05, 0.0)],
    lidar={"noise": 0.0},
)
FENCED = ACSAR.with_(geofence={"max_x": 0.6, "min_y": -0.3, "max_y": 0.3})
FREE = {"max_acceleration": None}
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
    "a polygon": ("ObstacleGoal", {"worlds": "clutter:6", "robot": FORK}, {}),
    "regions": ("ObstacleGoal", {"worlds": REGIONS}, {}),
    "BARN": ("Barn", {"worlds": "barn:4"}, {}),
    "smooth path": ("PathFollow", {"worlds": "smooth_path:6"}, {}),
    "waypoints": ("PathFollow", {"worlds": "waypoint_path:6"}, {}),
    "open floor": ("PointGoal", {"goal_distance": (0.3, 1.0)}, {}),
    "a goal": ("PointGoal", {}, {"goal": np.array([[1.0, 0.0], [0.5, 0.5], [np.nan, np.nan]])}),
    "a goal for all": ("Barn", {"worlds": "barn:100-102"}, {"goal": (3.0, -1.0)}),
    "a world": ("ObstacleGoal", {"worlds": "open:100-105"}, {"world": [101, 104, 102]}),
    "a world and a goal": ("ObstacleGoal", {"worlds": REGIONS}, {"world": 0, "goal": (1.0, 1.0)}),
    "difficulty": ("ObstacleGoal", {"worlds": "open:100-119"}, {"difficulty": (0.3, 0.7)}),
    "difficulty of each": (
        "PathFollow",
        {"worlds": "smooth_path:20", "difficulty": (0.2, 0.6)},
        {"difficulty": np.column_stack([ONES * 0.3, [0.4, 0.5, 0.6]])},
    ),
}
ROBOTS: dict[str, tuple[str, RobotConfig]] = {
    "slow feedback": ("PointGoal", ACSAR.with_(firmware={"feedback_rate": 20.0})),
    "odd feedback": ("PointGoal", ACSAR.with_(firmware={"feedback_rate": 30.0})),
    "fast feedback": ("PointGoal", ACSAR.with_(firmware={"feedback_rate": 200.0})),
    "slow wire": ("PointGoal", ACSAR.with_(baud_rate=38400)),
    "fine loop": ("PointGoal", ACSAR.with_(firmware={"loop_rate": 500.0})),
    "coarse encoders": (
        "PointGoal",
        ACSAR.with_(encoder={"counts_per_revolution": 100, "window": 0.02}),
    ),
    "weak motors": (
        "PointGoal",
        ACSAR.with_(motor={"max_speed": 5.0, "deadband": 1.0, "time_constant": 0.0}),
    ),
    "fast robot": (
        "PointGoal",
        ACSAR.with_(max_linear=1.5, max_angular=4.0, max_wheel_speed=20.0),
    ),
    "no limits": ("PointGoal", UNLIMITED),
    "limits": ("PointGoal", LIMITED),
    "geofence": ("ObstacleGoal", FENCED),
    "limits on a slow wire": ("PathFollow", LATE),
    "no noise": ("ObstacleGoal", ACSAR.with_(lidar={"noise": 0.0})),
    "dropouts": ("ObstacleGoal", ACSAR.with_(lidar={"dropouts": 0.1, "rays": 33})),
    "quantum": ("PointGoal", ACSAR.with_(encoder={"quantum": 0.25})),
    "quantum of half a hundredth": ("PointGoal", ACSAR.with_(encoder={"quantum": 0.025})),
    "command delay": ("PointGoal", ACSAR.with_(firmware={"command_delay": 0.0123})),
    "command delay without limits": (
        "PointGoal",
        UNLIMITED.with_(firmware={"command_delay": 0.0371}),
    ),
    "commands that take longer than a step": (
        "PointGoal",
        ACSAR.with_(firmware={"command_delay": 0.2137}),
    ),
    "the same without limits": ("PathFollow", UNLIMITED.with_(firmware={"command_delay": 0.12})),
    "radii": ("PathFollow", WORN),
    "radii without limits": ("PathFollow", WORN.with_(linear_limits=FREE, angular_limits=FREE)),
    "single motors": ("PointGoal", UNEVEN),
    "single motors without limits": (
        "PointGoal",
        UNEVEN.with_(linear_limits=FREE, angular_limits=FREE),
    ),
    "slippery sideways": ("PointGoal", ACSAR.with_(body={"turn_factor": 1.2})),
    "grippy sideways": ("ObstacleGoal", ACSAR.with_(body={"turn_factor": 2.0})),
    "everything new": ("PathFollow", FITTED),
    "slow LiDAR": ("ObstacleGoal", ACSAR.with_(lidar={"rate": 7.0, "field_of_view": 4.7})),
    "near LiDAR": ("ObstacleGoal", ACSAR.with_(lidar={"noise": 0.02, "min_range": 0.3})),
}


def assert_robot_1_is_the_single_env(
    kind: str, arguments: dict[str, Any], options: dict[str, Any], steps: int, seed: int = 41
) -> int:
    """Every number, through the byte-level firmware twin on the single side; ends of episodes."""
    env_id, limits = full_id(snake_case(kind)), {"max_episode_steps": 60, **arguments}
    many: Any = gymnasium.make_vec(env_id, 3, vectorization_mode="vector_entry_point", **limits)
    one = gymnasium.make(env_id, link="planar", **limits)
    mine = {name: of_robot_1(value) for name, value in options.items()}
    expected, info = one.reset(seed=seed, options=mine)
    seen, infos = many.reset(seed=seed - 1, options=options)
    reward, end, ends = 0.0, [False, False], 0
    rewards, terminated, truncated = np.zeros(3), np.zeros(3, np.bool_), np.zeros(3, np.bool_)
    rng = np.random.default_rng(0)
    for step in range(steps):
        assert seen[1] == pytest.approx(expected, abs=1e-6)  # float32
        assert rewards[1] == pytest.approx(reward, abs=1e-9)
        assert [terminated[1], truncated[1]] == end
        got = {key: infos[key][1] for key in info}
        assert numbers(got) == pytest.approx(numbers(info), abs=1e-9, nan_ok=True)
        acts = rng.uniform(-1.0, 1.0, (3, 2)).astype(np.float32)
        acts[:, 0] = abs(acts[:, 0]) if step % 100 < 70 else acts[:, 0]
        acts *= step % 50 != 0  # a stop is immediate
        seen, rewards, terminated, truncated, infos = many.step(acts)
        if any(end):
            expected, info = one.reset(options=mine)
            reward, end, ends = 0.0, [False, False], ends + 1
        else:
            expected, value, *end, info = one.step(acts[1])
            reward = float(value)
    many.close()
    one.close()
    return ends


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
    assert assert_robot_1_is_the_single_env(*CASES[name], 200) >= 2


@pytest.mark.parametrize("name", ROBOTS)
def test_any_robot_of_a_batch_is_the_single_planar_one(name: str) -> None:
    kind, robot = ROBOTS[name]
    worlds = {"PointGoal": {}, "ObstacleGoal": {"worlds": REGIONS}}.get(kind, {"worlds": PATH})
    assert assert_robot_1_is_the_single_env(kind, {"robot": robot, **worlds}, {}, 100) >= 1


@pytest.mark.parametrize("name", RANGES)
def test_each_randomized_parameter_is_the_single_envs(name: str) -> None:
    """Nine episodes; the values that were drawn are compared as everything else in info."""
    arguments = {"randomization": {name: RANGES[name]}, "max_episode_steps": 5}
    assert assert_robot_1_is_the_single_env("PointGoal", arguments, {}, 54) == 9


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
    assert assert_robot_1_is_the_single_env(kind, arguments, {}, 100, 12) >= 2


def test_options_hold_until_the_next_reset_of_the_robot() -> None:
    env = ObstacleGoalVectorEnv(40, worlds="open:8", max_episode_steps=2, threads=1)
    everything = set(range(8))

    def worlds(robots: slice = slice(None), episodes: int = 6) -> set[float]:
        found: set[float] = set()
        for _ in range(3 * episodes):
            found |= set(env.step(np.zeros((40, 2)))[4]["world"][robots].tolist())
        return found

    env.reset(seed=0, options={"world": 5})
    assert worlds() == {5}
    env.reset(options={"world": 3, "reset_mask": np.arange(40) < 20})
    assert (worlds(slice(0, 20)), worlds(slice(20, 40))) == ({3}, {5})
    env.reset(options={"reset_mask": np.arange(40) < 20})
    assert (worlds(slice(0, 20)), worlds(slice(20, 40))) == (everything, {5})
    env.reset(seed=1)
    assert worlds() == everything
    again = env.reset(seed=1)[1]["world"]
    env.reset(seed=1, options={"world": 5})
    assert (env.reset(seed=1)[1]["world"] == again).all()
    env.close()


def test_a_curriculum_goes_on_without_ending_episodes() -> None:
    env = ObstacleGoalVectorEnv(40, worlds="open:30", max_episode_steps=3, threads=1)
    levels = {number: generators.draw_difficulty("open", number) for number in range(30)}
    env.reset(seed=0, options={"difficulty": (0.0, 0.3)})
    for low, high in ((0.2, 0.5), (0.5, 1.0)):
        before = env.batch.state.copy()
        env.set_options({"difficulty": (low, high)})
        assert (env.batch.state[: layout.WISHED_WORLD] == before[: layout.WISHED_WORLD]).all()
        for _ in range(4):
            *_, info = env.step(np.zeros((40, 2)))
        drawn = [levels[int(number)] for number in info["world"]]
        assert low <= min(drawn) <= max(drawn) <= high
        assert len(set(drawn)) > 3
    env.close()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"world": 8}, "world of robot 0 = 8: must be 0 to 7 \\(open\\)"),
        ({"world": [0, 0.5]}, "world of robot 1 = 0.5"),
        ({"world": [0, 1, 2]}, "world: must be a number, or an array of shape \\(2,\\)"),
        ({"world": World()}, "world: must be"),
        ({"goal": [1.0, 2.0, 3.0]}, "goal: must be \\(2,\\), or"),
        ({"goal": [[1.0, 2.0], [np.nan, 1.0]]}, "goal of robot 1"),
        ({"goal": "there"}, "goal: must be"),
        ({"difficulty": 0.5}, "difficulty: must be"),
        ({"difficulty": (0.9, 0.1)}, "must be from 0 to 1"),
        ({"difficulty": (0.999, 1.0)}, "none of the env's worlds; theirs are"),
        ({"wrld": 3}, "did you mean 'world'"),
        ({"reset_mask": [True]}, "reset_mask"),
        (3, "must be a mapping"),
    ],
)
def test_bad_options_are_one_clear_error_and_change_nothing(options: Any, message: str) -> None:
    env = ObstacleGoalVectorEnv(2, worlds="open:8", threads=1)
    env.reset(seed=0)
    before = env.batch.state.copy()
    for call in (lambda: env.reset(options=options), lambda: env.set_options(options)):
        with pytest.raises(ConfigError, match=message):
            call()
    assert (env.batch.state == before).all()
    env.close()


@pytest.mark.parametrize(
    ("make", "options", "named"),
    [
        (PointGoalVectorEnv, {"world": 3}, "'world'"),
        (PointGoalVectorEnv, {"goal": (9.0, 9.0)}, "goal"),
        (PathFollowVectorEnv, {"goal": (1.0, 1.0)}, "'goal'"),
        (PathFollowVectorEnv, {"difficulty": (0.0, 1.0)}, "difficulty"),
    ],
)
def test_options_are_those_of_the_task(make: Any, options: Any, named: str) -> None:
    env = make(2, **({} if make is PointGoalVectorEnv else {"worlds": PATH}))
    with pytest.raises(ConfigError, match=named):
        env.reset(options=options)
    env.close()


def test_robots_of_a_batch_are_in_different_worlds() -> None:
    env = BarnVectorEnv(30, worlds="barn:4")
    _, infos = env.reset(seed=0)
    assert set(infos["world"].tolist()) == {0.0, 1.0, 2.0, 3.0}
    env.close()


def test_a_world_that_cannot_be_driven_is_one_clear_error() -> None:
    with pytest.raises(WorldError, match="the start"):
        ObstacleGoalVectorEnv(2, worlds=World(np.array([[0.0, 0.0, 1.0]]), goal=Region(5.0, 0.0)))


def test_too_many_worlds_are_refused_before_any_is_made() -> None:
    with pytest.raises(WorldError, match="10,001 of open are too many for a batch"):
        ObstacleGoalVectorEnv(2, worlds="open:10001")
