"""Goals of the policy's node without ROS: frames, distances, and goals that move."""

from __future__ import annotations

import contextlib
import math
from types import SimpleNamespace
from typing import Any, cast

import gymnasium
import numpy as np
import pytest

from acsar_gym.errors import ConfigError
from acsar_gym.ros.node import RosSetupError
from acsar_gym.tools.ros.policy import (
    Frames,
    Goal,
    GoalEnv,
    GoalError,
    GoalRules,
    list_headings,
    move_goal,
)
from acsar_gym.worlds import Region, World

QUARTER = math.pi / 2.0


def make_frames() -> Frames:
    """A localized robot: map, odom, base_footprint, base_link and its LiDAR, and a station."""
    frames = Frames("odom", "base_link")
    frames.add("map", "odom", (1.0, 0.0, QUARTER))
    frames.add("odom", "base_footprint", (2.0, 1.0, QUARTER))
    frames.add("base_footprint", "base_link", (0.0, 0.0, 0.0))
    frames.add("base_link", "laser", (0.2, 0.0, 0.0))
    frames.add("map", "station", (0.0, 2.0, 0.0))
    return frames


@pytest.mark.parametrize(
    ("frame", "place", "in_odom"),
    [
        ("map", (1.0, 3.0), (3.0, 0.0)),  # odom's x axis is map's y axis
        ("/map", (1.0, 3.0), (3.0, 0.0)),
        ("odom", (3.0, -1.0), (3.0, -1.0)),
        ("base_link", (1.0, 0.5), (1.5, 2.0)),
        ("laser", (1.0, 0.5), (1.5, 2.2)),
        ("station", (1.0, 1.0), (3.0, 0.0)),  # neither above odom nor below
    ],
)
def test_find_goal_transforms_to_the_odometrys_frame(
    frame: str, place: tuple[float, float], in_odom: tuple[float, float]
) -> None:
    assert make_frames().find_goal(Goal(*place, frame))[:2] == pytest.approx(in_odom)


def test_fix_goal_keeps_only_a_goal_ahead_from_moving() -> None:
    frames = make_frames()
    in_map = frames.fix_goal(Goal(1.0, 3.0, "map"))
    at_station = frames.fix_goal(Goal(1.0, 1.0, "station"))
    ahead = frames.fix_goal(Goal(1.0, 0.0, "base_link"))
    frames.add("map", "odom", (1.0, 1.0, QUARTER))
    frames.add("odom", "base_footprint", (5.0, 5.0, 0.0))
    for goal in (in_map, at_station):
        assert frames.find_goal(goal)[:2] == pytest.approx((2.0, 0.0))
    assert frames.find_goal(ahead)[:2] == pytest.approx((2.0, 2.0))


def test_find_base_uses_the_odometrys_topic_without_a_transform() -> None:
    frames = Frames("odom", "base_link")
    assert frames.find_base() is None
    frames.add_odometry("map", (9.0, 0.0, 0.0))
    assert frames.find_base() is None
    frames.add_odometry("/odom", (3.0, 0.0, 0.0))
    frames.add_odometry("odom", (math.nan, 0.0, 0.0))
    assert frames.find_base() == (3.0, 0.0, 0.0)
    assert frames.find_goal(Goal(1.0, 0.0, "base_link"))[:2] == (4.0, 0.0)
    frames.add("/odom", "/base_link", (5.0, 0.0, 0.0))
    frames.add("odom", "base_link", (math.nan, 0.0, 0.0))
    assert frames.find_base() == (5.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("goal", "reason"),
    [
        (Goal(1.0, 2.0, "nowhere"), r"^goal \(1, 2\) in 'nowhere': no transforms on /tf"),
        (Goal(1.0, 2.0, "camera"), "no transforms on /tf"),
        (Goal(0.0, math.inf, "map"), "must be finite numbers"),
        (Goal(1.0, 0.0, "/"), "names no frame"),
    ],
)
def test_find_goal_refuses_goals_without_a_place(goal: Goal, reason: str) -> None:
    frames = make_frames()
    frames.add("mast", "camera", (0.0, 0.0, 0.0))
    frames.add("camera", "mast", (0.0, 0.0, 0.0))  # a circle
    with pytest.raises(GoalError, match=reason):
        frames.find_goal(goal)


def make_env(name: str, **options: Any) -> gymnasium.Env[Any, Any]:
    return gymnasium.make(f"acsar_gym/{name}", link="planar", **options)


def test_goal_rules_are_those_of_the_task() -> None:
    with contextlib.closing(make_env("PointGoal-v0", goal_distance=(1.0, 4.0))) as env:
        rules = GoalRules.of(env)
        env.reset(seed=0, options={"goal": (2.0, 0.0)})
        inner: Any = env.unwrapped
        move_goal(inner, (0.0, 3.0))
        assert env.step(np.zeros(2, np.float32))[4]["goal_distance"] == pytest.approx(3.0)
    rules.check(Goal(0.0, -4.0), 4.0)
    for distance in (0.5, 4.1):
        with pytest.raises(GoalError, match="must be 1 to 4 m"):
            rules.check(Goal(distance, 0.0, "map"), distance)

    # Among obstacles, goals are as far as the robot gets in its time.
    with contextlib.closing(make_env("ObstacleGoal-v1", max_episode_steps=100)) as env:
        rules = GoalRules.of(env)
        inner = env.unwrapped
    assert rules == pytest.approx((0.3, 10.0 * inner.robot.config.max_linear))
    env = make_env("PathFollow-v0")
    with contextlib.closing(env), pytest.raises(ConfigError, match="has no goals"):
        GoalRules.of(env)


def test_goal_env_stops_if_the_goals_place_is_lost() -> None:
    frames = make_frames()
    node: Any = SimpleNamespace(frames=frames, check=lambda: None)
    env = GoalEnv(make_env("PointGoal-v0"), node)
    with contextlib.closing(env):
        env.reset(seed=0, options={"goal": (2.0, 0.0)})
        env.goal = Goal(1.0, 3.0, "map")
        frames.add("earth", "odom", (0.0, 0.0, 0.0))
        robot = cast("Any", env.unwrapped).robot
        stops: list[int] = []
        robot.stop = lambda: stops.append(1)
        with pytest.raises(GoalError, match="no transforms"):
            env.step(np.zeros(2, np.float32))
        del robot.stop
    assert stops == [1]


def test_goal_env_ends_if_the_nodes_thread_has_failed() -> None:
    """It drove on to the goal, deaf to a cancel."""

    def fail() -> None:
        raise RosSetupError("acsar_policy", "/", RuntimeError("rcl"))

    node: Any = SimpleNamespace(frames=make_frames(), check=fail)
    with contextlib.closing(GoalEnv(make_env("PointGoal-v0"), node)) as env:
        env.reset(seed=0, options={"goal": (2.0, 0.0)})
        with pytest.raises(RosSetupError, match="rcl"):
            env.step(np.zeros(2, np.float32))


def test_list_headings_look_along_the_path() -> None:
    corner = [(0.0, 0.0), (0.0, 2.0), (-1.0, 2.0)]
    assert list_headings(corner) == pytest.approx([QUARTER, math.pi, math.pi])
    assert list_headings(corner[:1]) == [0.0]


def test_move_goal_leads_the_way_over_the_map() -> None:
    """To a nearer and a farther goal with the next step. A small correction keeps the way."""
    open_floor = World(start=Region(0.0, 0.0, 0.0, 0.0), goal=Region(3.0, 0.0))
    with contextlib.closing(make_env("ObstacleGoal-v1", worlds=[open_floor])) as env:
        env.reset(seed=0)
        inner: Any = env.unwrapped
        (map_sensor,) = (sensor for sensor in inner.sensors if sensor.name == "map")
        ends = []
        for place in ((0.0, 2.0), (0.0, -3.5), (0.01, -3.5)):
            move_goal(inner, place)
            env.step(np.zeros(2, np.float32))
            ends.append(map_sensor.way_ahead[-1, :2].tolist())
    assert ends == [[0.0, 2.0], [0.0, -3.5], [0.0, -3.5]]
