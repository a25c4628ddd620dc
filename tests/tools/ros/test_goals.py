"""Goals and frames of the policy's node, and what it shows, without ROS."""

from __future__ import annotations

import contextlib
import math
from typing import Any

import gymnasium
import numpy as np
import pytest

import acsar_gym  # noqa: F401 - registers the ids
from acsar_gym.errors import ConfigError
from acsar_gym.tools.ros.frames import Quaternion, Transform
from acsar_gym.tools.ros.policy import (
    Frames,
    Goal,
    GoalError,
    GoalRules,
    is_near,
    move_points,
    take_view,
)
from acsar_gym.worlds import Pose, Region, World
from acsar_gym.worlds.world import to_world

NONE: Quaternion = (0.0, 0.0, 0.0, 1.0)
QUARTER: Quaternion = (0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5))


def make_frames() -> Frames:
    """A localized robot: map, odom, base_footprint, base_link; and its LiDAR."""
    frames = Frames("odom", "base_link")
    frames.add("odom", Transform("map", (1.0, 0.0, 0.0), QUARTER))
    frames.add("base_footprint", Transform("odom", (2.0, 1.0, 0.0), QUARTER))
    frames.add("base_link", Transform("base_footprint", (0.0, 0.0, 0.1), NONE))
    frames.add("laser", Transform("base_link", (0.2, 0.0, 0.1), NONE))
    return frames


@pytest.mark.parametrize(
    ("frame", "place", "there"),
    [
        ("map", (1.0, 3.0), (3.0, 0.0)),  # odom's x axis is map's y axis
        ("/map", (1.0, 3.0), (3.0, 0.0)),
        ("odom", (3.0, -1.0), (3.0, -1.0)),
        ("base_link", (1.0, 0.5), (1.5, 2.0)),
        ("laser", (1.0, 0.5), (1.5, 2.2)),
    ],
)
def test_goals_are_found_over_the_frames_between(
    frame: str, place: tuple[float, float], there: tuple[float, float]
) -> None:
    assert make_frames().find_goal(Goal((*place, 0.0), frame)) == pytest.approx(there)


def test_the_robot_is_found_over_the_frames_between() -> None:
    assert make_frames().find_base() == pytest.approx((2.0, 1.0, math.pi / 2.0))


def test_the_odometrys_topic_counts_where_no_transform_says_where_the_robot_is() -> None:
    frames = Frames("odom", "base_link")
    assert frames.find_base() is None
    frames.add_odometry("base_link", Transform("odom", (3.0, 0.0, 0.0), NONE))
    assert frames.find_base() == pytest.approx((3.0, 0.0, 0.0))
    assert frames.find_goal(Goal((1.0, 0.0, 0.0), "base_link")) == pytest.approx((4.0, 0.0))
    frames.add("base_link", Transform("odom", (5.0, 0.0, 0.0), NONE))
    assert frames.find_base() == pytest.approx((5.0, 0.0, 0.0))


def test_odometry_without_a_child_frame_is_the_base() -> None:
    frames = Frames("odom", "base_link")
    frames.add_odometry("", Transform("/odom", (3.0, 0.0, 0.0), NONE))
    assert frames.find_base() == pytest.approx((3.0, 0.0, 0.0))


def test_news_of_where_the_robot_is_are_counted() -> None:
    frames = make_frames()
    before = frames.heard
    frames.add("odom", Transform("map", (1.0, 0.0, 0.0), QUARTER))
    assert frames.heard == before
    frames.add("base_footprint", Transform("odom", (2.0, 1.0, 0.0), QUARTER))
    frames.add_odometry("base_link", Transform("odom", (3.0, 0.0, 0.0), NONE))
    assert frames.heard == before + 2


def test_odometry_of_another_frame_says_nothing() -> None:
    frames = Frames("odom", "base_link")
    frames.add_odometry("base_link", Transform("robot1/odom", (3.0, 0.0, 0.0), NONE))
    assert frames.find_base() is None


@pytest.mark.parametrize("frame", ["nowhere", "camera"])
def test_a_frame_that_nothing_connects_is_one_line(frame: str) -> None:
    frames = make_frames()
    frames.add("camera", Transform("mast", (0.0, 0.0, 0.0), NONE))
    frames.add("mast", Transform("camera", (0.0, 0.0, 0.0), NONE))  # a circle
    with pytest.raises(GoalError, match=f"goal \\(1, 2\\) in '{frame}': nothing on /tf") as error:
        frames.find_goal(Goal((1.0, 2.0, 0.0), frame))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("goal", "what"),
    [
        (Goal((math.nan, 0.0, 0.0), "map"), "finite numbers"),
        (Goal((0.0, math.inf, 0.0), "map"), "finite numbers"),
        (Goal((1.0, 0.0, 0.0), ""), "names no frame"),
        (Goal((1.0, 0.0, 0.0), "/"), "names no frame"),
    ],
)
def test_goals_that_cant_be_are_refused(goal: Goal, what: str) -> None:
    with pytest.raises(GoalError, match=what):
        goal.check()


def make_env(name: str, **options: Any) -> gymnasium.Env[Any, Any]:
    return gymnasium.make(f"acsar_gym/{name}", link="planar", **options)


def test_the_goals_of_an_open_floor_are_those_of_the_task() -> None:
    with contextlib.closing(make_env("PointGoal-v0", goal_distance=(1.0, 4.0))) as env:
        rules = GoalRules.of(env)
    rules.check((0.0, -4.0), Goal((0.0, 0.0, 0.0)))
    for place in ((0.5, 0.5), (4.0, 0.1)):
        with pytest.raises(GoalError, match="must be 1 to 4 m"):
            rules.check(place, Goal((*place, 0.0), "map"))


def test_goals_among_obstacles_can_be_reached_within_the_time_limit() -> None:
    with contextlib.closing(make_env("ObstacleGoal-v1", max_episode_steps=100)) as env:
        rules, inner = GoalRules.of(env), env.unwrapped
        farthest = 10.0 * inner.robot.config.max_linear  # type: ignore[attr-defined]
    assert rules == pytest.approx((0.3, farthest))


def test_a_task_without_goals_is_refused() -> None:
    env = make_env("PathFollow-v0")
    with contextlib.closing(env), pytest.raises(ConfigError, match="takes no goals"):
        GoalRules.of(env)


@pytest.mark.parametrize("start", [(0.0, 0.0, 0.0), (3.0, -2.0, 2.0)])
def test_points_move_as_poses_do(start: Pose) -> None:
    points = np.array([[1.0, 2.0], [-3.0, 0.5]])
    moved = [to_world(start, (x, y, 0.0))[:2] for x, y in points.tolist()]
    assert move_points(points, start) == pytest.approx(np.array(moved))


def test_a_robot_stands_whose_pose_stays() -> None:
    pose = (1.0, 2.0, math.pi)
    assert is_near(pose, (1.001, 2.0, -math.pi + 0.001))
    assert not is_near(pose, (1.01, 2.0, math.pi))
    assert not is_near(pose, (1.0, 2.0, math.pi - 0.1))


def test_on_an_open_floor_the_plan_is_a_straight_line() -> None:
    start = (5.0, 1.0, math.pi / 2.0)
    with contextlib.closing(make_env("PointGoal-v0")) as env:
        env.reset(seed=0, options={"goal": (2.0, 0.0)})
        for _ in range(3):
            env.step(np.array([1.0, 0.0], np.float32))
        inner: Any = env.unwrapped
        view, pose = take_view(inner, start, stamp=7), inner.robot.odometry.pose
    assert view.goal == pytest.approx((5.0, 3.0))
    assert view.way == pytest.approx(np.array([to_world(start, pose)[:2], (5.0, 3.0)]))
    assert (view.tolerance, view.stamp) == (0.15, 7)
    assert len(view.hits) == len(view.cells) == 0


@pytest.mark.slow
def test_among_obstacles_the_plan_goes_around_and_rays_and_cells_are_on_them() -> None:
    """A wall across the straight way, seen by a robot that began elsewhere in the odometry."""
    wall = np.array([[1.5, -1.0, 1.5, 1.0]])
    world = World(segments=wall, start=Region(0.0, 0.0, 0.0, 0.0), goal=Region(3.0, 0.0))
    start = (5.0, 1.0, math.pi / 2.0)
    with contextlib.closing(make_env("ObstacleGoal-v1", worlds=[world])) as env:
        env.reset(seed=0)
        for _ in range(5):
            env.step(np.zeros(2, np.float32))
        view = take_view(env.unwrapped, start)  # type: ignore[arg-type]
    # the frame of the odometry is turned by a quarter: the wall is at y = 2.5, from x = 4 to 6
    assert view.goal == pytest.approx((5.0, 4.0))
    assert view.way[[0, -1]] == pytest.approx(np.array([[5.0, 1.0], [5.0, 4.0]]), abs=0.1)
    assert any(abs(x - 5.0) > 1.0 for x, _ in view.way.tolist())
    assert len(view.hits) > 10
    assert len(view.cells) > 5
    for points, error in ((view.hits, 0.05), (view.cells, view.side)):
        assert np.abs(points[:, 1] - 2.5).max() < error
        assert np.abs(points[:, 0] - 5.0).max() < 1.0 + error
