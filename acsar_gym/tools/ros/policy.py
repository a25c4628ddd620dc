"""A policy that drives a robot of ROS 2 to goals of others: `acsar-gym ros policy`.

Each goal is an episode as of `run --link ros2`. A node of its own, in a thread of its own, hears
goals and transforms, and publishes what the control loop hands over after a step.
"""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.envs.robot_env import RobotEnv
from acsar_gym.errors import (
    ConfigError,
    EmergencyStopError,
    LidarError,
    escape_unprintable,
    show_value,
)
from acsar_gym.lidar.scan import ray_spec
from acsar_gym.links.ros2 import Ros2Link
from acsar_gym.ros.node import RosNode, make_stamp
from acsar_gym.sensors.lidar import newest_scan
from acsar_gym.sensors.map.sensor import find_map
from acsar_gym.tasks.goal import GoalTask
from acsar_gym.tools.evaluation.episode import Episode
from acsar_gym.tools.evaluation.episodes import run_episodes
from acsar_gym.tools.evaluation.runs import EvaluationRun, drive_to_goals, load_policy
from acsar_gym.tools.policies import FilePolicy
from acsar_gym.tools.ros.frames import Transform, find_transform
from acsar_gym.worlds import Pose
from acsar_gym.worlds.world import to_odometry, to_world

Floats = NDArray[np.float64]
Point = tuple[float, float]
POLICY_NODE = "acsar_policy"
DEFAULT_POLICY = "point_goal"
VIEW_PERIOD = 0.1
"""Plan and markers are published at most so often [s]."""
IDLE_PERIOD = 0.05
"""How soon a goal is noticed while the robot stands [s]."""
CATCH_UP_TIMEOUT = 0.05
"""Longest time for transforms that wait [s]."""
FRAME_TIMEOUT = 2.0
"""Longest wait until a goal's frame is known, while the robot stands [s]."""
CLOSE_TIMEOUT = 1.0
"""Longest wait for the thread's end [s]."""
STILL_PERIOD, STILL_DISTANCE, STILL_TURN = 0.2, 0.002, 0.005
"""The robot stands where its pose differs by less than this after a time [s, m, rad]."""
STILL_TIMEOUT = 5.0
"""Longest wait until it stands, and for the first pose [s]."""
TF_DEPTH = 100
FAR = 1e3
"""Farther than any map reaches [m]."""
MOST_CELLS = 4000
"""Most cells of the map in a marker."""
GOAL_FRAME = "the goal"


class GoalError(ConfigError):
    """A goal that isn't driven to."""


class Goal(NamedTuple):
    """A goal that was asked for."""

    place: tuple[float, float, float]
    """x, y, z [m]."""
    frame: str = ""
    """Of the place; "" for the one that begins where the robot stands."""

    def check(self) -> None:
        """Check a goal of others. GoalError for numbers that aren't finite, or no frame."""
        if not all(map(math.isfinite, self.place)):
            raise GoalError(f"{self}: must be finite numbers")
        if not self.frame.strip("/"):
            raise GoalError(f"{self}: its header names no frame")

    def __str__(self) -> str:
        x, y, _ = self.place
        return f"goal ({x:g}, {y:g})" + (f" in {show_value(self.frame)}" if self.frame else "")


class Frames:
    """Where frames are in that of the odometry, by what is heard. Pure.

    Attributes: `odom`, `base`; `heard`, how often something was heard of where the robot is.

    Args:
        odom: frame of the odometry.
        base: frame of the robot.
    """

    def __init__(self, odom: str, base: str) -> None:
        self.odom, self.base, self.heard = odom, base, 0
        self._transforms: dict[str, Transform] = {}
        self._pose: tuple[str, Transform] | None = None

    def add(self, child: str, transform: Transform) -> None:
        """Take over a transform of /tf or /tf_static."""
        self._transforms[child.lstrip("/")] = transform
        self.heard += transform.parent.lstrip("/") == self.odom

    def add_odometry(self, child: str, transform: Transform) -> None:
        """Take over a pose of the odometry's topic, which counts where no transform says it."""
        self._pose = child.lstrip("/") or self.base, transform
        self.heard += 1

    def find_goal(self, goal: Goal) -> Point:
        """Transform a goal's place into the odometry's frame [m].

        Raises:
            GoalError: nothing connects the frames.
        """
        placed = Transform(goal.frame, goal.place, (0.0, 0.0, 0.0, 1.0))
        found = self._find(GOAL_FRAME, placed)
        if found is None:
            raise GoalError(
                f"{goal}: nothing on /tf and /tf_static connects this frame with "
                f"{show_value(self.odom)}"
            )
        x, y, _ = found[0]
        return x, y

    def find_base(self) -> Pose | None:
        """Find the robot's pose in the odometry's frame; None where it isn't known."""
        found = self._find(self.base)
        if found is None:
            return None
        (x, y, _), (qx, qy, qz, qw) = found
        return x, y, math.atan2(2.0 * (qw * qz + qx * qy), 1.0 - 2.0 * (qy * qy + qz * qz))

    def _find(self, frame: str, placed: Transform | None = None) -> Any:
        """Translation and rotation of a frame in the odometry's; None where they aren't known."""
        transforms = dict(self._transforms)
        if self._pose is not None:
            transforms.setdefault(*self._pose)
        if placed is not None:
            transforms[frame] = placed
        try:
            return find_transform(transforms, frame, self.odom)
        except LidarError:
            return None


def _is_finite(transform: Transform) -> bool:
    return math.isfinite(math.fsum((*transform.translation, *transform.rotation)))


class GoalRules(NamedTuple):
    """How near and how far a task's goals may be [m]."""

    nearest: float
    farthest: float

    @classmethod
    def of(cls, env: gymnasium.Env[Any, Any]) -> GoalRules:
        """Return those of an env: its task's, or what the top speed drives in its time limit.

        Raises:
            ConfigError: its task has other goals than points.
        """
        inner: Any = env.unwrapped
        task = inner.task
        if not isinstance(task, GoalTask) or task.follows:
            raise ConfigError(f"{task.id}: takes no goals; a policy for a task with goals does")
        if inner.pool is None:
            return cls(*task.goal_distance)
        steps = env.spec.max_episode_steps if env.spec is not None else None
        config = inner.robot.config
        seconds = math.inf if steps is None else steps * inner.ticks_per_step * config.period
        return cls(task.goal_tolerance, config.max_linear * seconds)

    def check(self, place: Point, goal: Goal) -> None:
        """Check a goal's place in the frame that begins at the robot [m]. GoalError otherwise."""
        distance = math.hypot(*place)
        if not self.nearest <= distance <= self.farthest:
            raise GoalError(
                f"{goal}: is {distance:.3g} m away: must be {self.nearest:g} to "
                f"{self.farthest:g} m, by the policy's task; see --goal-distance"
            )


@dataclass(frozen=True)
class View:
    """What there is to see after a step, in the frame of the odometry [m]."""

    goal: Point
    tolerance: float
    way: Floats
    """(n, 2): from the robot to the goal."""
    origin: Point
    """Of the rays."""
    hits: Floats
    """(n, 2): ends of the rays that met something."""
    cells: Floats
    """(n, 2): centres of the map's cells in which something was met."""
    side: float
    """Of a cell."""
    stamp: int = 0
    """Time of ROS [ns]."""


def take_view(env: RobotEnv, start: Pose, stamp: int = 0) -> View:
    """Note what an env's robot sees.

    Args:
        env: in an episode.
        start: pose in the frame of the odometry at which the episode began.
        stamp: time of ROS [ns].
    """
    robot = env.robot
    pose, goal = robot.odometry.pose, env.episode.assignment.goal
    way, cells, side = np.array([pose[:2], goal]), np.empty((0, 2)), 0.0
    seen = find_map(robot.sensors)
    if seen is not None:
        ahead = seen.way_ahead[:, :2]
        way = np.vstack([pose[:2], ahead]) if len(ahead) else way
        side = seen.cell_side
        cells = seen.centres_of(seen.cells_met(FAR)[:MOST_CELLS])
    scan, config = newest_scan(robot.sensors), robot.config
    origin = (config.lidar_x_offset, config.lidar_y_offset)
    hits = np.empty((0, 2))
    if scan is not None:
        met = scan.ranges < config.lidar.max_range
        bearings, ranges = ray_spec(config).angles()[met], scan.ranges[met]
        ends = np.column_stack([np.cos(bearings), np.sin(bearings)]) * ranges[:, None]
        hits = move_points(ends + origin, to_world(start, pose))
    x, y, _ = to_world(to_world(start, pose), (*origin, 0.0))
    goal_x, goal_y, _ = to_world(start, (*goal, 0.0))
    return View(
        (goal_x, goal_y),
        env.task.goal_tolerance,
        move_points(way, start),
        (x, y),
        hits,
        move_points(cells, start),
        side,
        stamp,
    )


def move_points(points: Floats, start: Pose) -> Floats:
    """Transform points (n, 2) from the frame that begins at a pose into that of the pose."""
    x, y, theta = start
    cos, sin = math.cos(theta), math.sin(theta)
    moved: Floats = points @ np.array([[cos, sin], [-sin, cos]]) + (x, y)
    return moved


class PolicyNode:
    """The node of a policy. What it hears is handled while the robot stands, or ticks.

    Goals and the service arrive at the link's node, which spins in every tick; transforms and
    poses at the policy's own, which spins only while the robot stands, as they come often. Plan
    and markers are published in a thread.

    Attributes: `frames`, where they are; `find_base`, says where the robot is now; `goal`, the
    newest that nobody took yet; `is_cancelled`, whether the running episode shall end;
    `is_driving`, whether one runs; `rules`, which goals may be, None for all.

    Args:
        node: of ROS.
        config: of the robot.
    """

    def __init__(self, node: RosNode, config: RobotConfig) -> None:
        self._node, self._ros = node, node.ros
        self.frames = Frames(config.odom_frame, config.base_frame)
        self.find_base: Callable[[], Pose | None] = self.frames.find_base
        self.rules: GoalRules | None = None
        self.goal: Goal | None = None
        self.is_cancelled = self.is_driving = False
        self._heard = 0
        ros = self._ros
        if ros.TFMessage is None:
            self.warn("tf2_msgs isn't installed: goals must be in the frame of the odometry")
        else:
            node.subscribe("/tf", ros.TFMessage, self._take_tf, TF_DEPTH)
            node.subscribe("/tf_static", ros.TFMessage, self._take_tf, TF_DEPTH, latched=True)
        node.subscribe(config.ros2.odom_topic, ros.Odometry, self._take_pose, best_effort=True)
        self._plan = node.publish("plan", ros.Path)
        self._markers = node.publish("~/markers", ros.MarkerArray)
        self._view: View | None = None
        self._points: dict[Point, Any] = {}
        self._wake = threading.Event()
        self._running = True
        self._thread = threading.Thread(target=self._publish, name=POLICY_NODE, daemon=True)
        self._thread.start()

    def listen(self, link_node: RosNode) -> None:
        """Hear goals, and offer the service, by the node of the link."""
        own, ros = self._node, self._ros
        link_node.subscribe(own.resolve("goal_pose"), ros.PoseStamped, self._take_goal)
        name = f"{own.namespace.rstrip('/')}/{own.name}/cancel"
        link_node.node.create_service(ros.Trigger, name, self._cancel)

    def catch_up(self) -> None:
        """Handle the transforms and poses that wait."""
        end = time.monotonic() + CATCH_UP_TIMEOUT
        before = -1
        while before != self._heard and time.monotonic() < end:
            before = self._heard
            self._node.spin(0.0)

    def close(self) -> None:
        """End thread and node."""
        self._running = False
        self._wake.set()
        self._thread.join(CLOSE_TIMEOUT)
        self._node.close()

    def say(self, text: str) -> None:
        """Log a line about what goes well."""
        self._node.node.get_logger().info(escape_unprintable(text))

    def warn(self, text: str) -> None:
        """Log a line."""
        self._node.node.get_logger().warning(escape_unprintable(text))

    # What arrives

    def _take_tf(self, message: Any) -> None:
        self._heard += 1
        for one in message.transforms:
            at, turn = one.transform.translation, one.transform.rotation
            placed = _make_transform(one.header.frame_id, at, turn)
            if _is_finite(placed):
                self.frames.add(one.child_frame_id, placed)

    def _take_pose(self, message: Any) -> None:
        self._heard += 1
        pose = message.pose.pose
        placed = _make_transform(message.header.frame_id, pose.position, pose.orientation)
        if _is_finite(placed):
            self.frames.add_odometry(message.child_frame_id, placed)

    def _take_goal(self, message: Any) -> None:
        """Take over a goal, which ends the one before, unless it is sure not to be driven to."""
        at, base = message.pose.position, self.find_base()
        goal = Goal((at.x, at.y, at.z), message.header.frame_id)
        try:
            goal.check()
            if not self.is_driving:  # transforms may still come
                self.goal = goal
                return
            place = self.frames.find_goal(goal)
            if base is not None and self.rules is not None:
                self.rules.check(to_odometry(base, (*place, 0.0))[:2], goal)
        except GoalError as error:
            self.warn(f"refused: {error}")
        else:
            self.goal = goal

    def _cancel(self, _: Any, response: Any) -> Any:
        response.success = self.is_driving or self.goal is not None
        response.message = "cancelled" if response.success else "nothing is driven"
        self.is_cancelled, self.goal = self.is_driving, None
        return response

    @property
    def is_interrupted(self) -> bool:
        """Whether the running episode shall end, or another goal has come."""
        return self.is_cancelled or self.goal is not None

    def describe_end(self, episode: Episode) -> str:
        """Say how the episode ended that has just ended."""
        if episode.fault or episode.success:
            return episode.fault or f"reached in {episode.time:.1f} s"
        if self.is_cancelled:
            return "cancelled"
        return "replaced by another goal" if self.goal is not None else "not reached"

    # What is published

    @property
    def has_viewers(self) -> bool:
        """Whether somebody subscribes plan or markers."""
        publishers = (self._plan, self._markers)
        return any(publisher.get_subscription_count() for publisher in publishers)

    def show(self, view: View) -> None:
        """Hand over a view; doesn't wait."""
        self._view = view
        self._wake.set()

    def _publish(self) -> None:
        """Publish what is handed over, in a thread of its own."""
        while self._running:
            self._wake.wait()
            self._wake.clear()
            view, self._view = self._view, None
            if view is None:
                continue
            stamp, frame = make_stamp(self._ros, view.stamp), self.frames.odom
            if self._plan.get_subscription_count():
                self._plan.publish(make_plan(self._ros, view, frame, stamp))
            if self._markers.get_subscription_count():
                self._markers.publish(make_markers(self._ros, view, frame, stamp, self._points))


def _make_transform(frame: str, at: Any, turn: Any) -> Transform:
    """Return a transform of a geometry_msgs/Point or Vector3, and a Quaternion."""
    return Transform(frame, (at.x, at.y, at.z), (turn.x, turn.y, turn.z, turn.w))


def make_plan(ros: Any, view: View, frame: str, stamp: Any) -> Any:
    """Return a nav_msgs/Path along the way, whose poses look ahead."""
    plan = ros.Path()
    plan.header.frame_id, plan.header.stamp = frame, stamp
    ahead = np.diff(view.way, axis=0)
    headings = np.arctan2(ahead[:, 1], ahead[:, 0]).tolist() or [0.0]
    headings.append(headings[-1])
    for (x, y), heading in zip(view.way.tolist(), headings, strict=False):
        pose = ros.PoseStamped(header=plan.header)
        pose.pose.position.x, pose.pose.position.y = x, y
        pose.pose.orientation.z = math.sin(heading / 2.0)
        pose.pose.orientation.w = math.cos(heading / 2.0)
        plan.poses.append(pose)
    return plan


def make_markers(ros: Any, view: View, frame: str, stamp: Any, points: dict[Point, Any]) -> Any:
    """Return a visualization_msgs/MarkerArray: goal, rays, and cells of the map.

    Args:
        ros: of `load_ros`.
        view: to show.
        frame: of the odometry.
        stamp: of the header.
        points: of cells, which are made once; kept by the caller.
    """
    kinds = ros.Marker
    goal = _make_marker(ros, "goal", kinds.CYLINDER, frame, stamp, (0.1, 0.8, 0.1, 0.5))
    goal.pose.position.x, goal.pose.position.y = view.goal
    goal.scale.x = goal.scale.y = 2.0 * view.tolerance
    goal.scale.z = 0.02
    rays = _make_marker(ros, "rays", kinds.LINE_LIST, frame, stamp, (0.9, 0.2, 0.1, 0.4))
    rays.scale.x = 0.01
    begin = ros.Point(x=view.origin[0], y=view.origin[1])
    rays.points = [point for x, y in view.hits.tolist() for point in (begin, ros.Point(x=x, y=y))]
    cells = _make_marker(ros, "map", kinds.CUBE_LIST, frame, stamp, (0.1, 0.3, 0.9, 0.6))
    cells.scale.x = cells.scale.y = view.side
    cells.scale.z = 0.02
    if len(points) > MOST_CELLS:  # of other episodes
        points.clear()
    for x, y in view.cells.tolist():
        if (x, y) not in points:
            points[x, y] = ros.Point(x=x, y=y)
        cells.points.append(points[x, y])
    markers = [goal, rays, cells]
    for marker in markers[1:]:
        if not marker.points:
            marker.action = kinds.DELETE
    return ros.MarkerArray(markers=markers)


def _make_marker(
    ros: Any, name: str, kind: int, frame: str, stamp: Any, color: Sequence[float]
) -> Any:
    marker = ros.Marker(ns=name, type=kind, action=ros.Marker.ADD)
    marker.header.frame_id, marker.header.stamp = frame, stamp
    marker.pose.orientation.w = 1.0
    marker.color.r, marker.color.g, marker.color.b, marker.color.a = color
    return marker


class WatchedEnv(gymnasium.Wrapper[Any, Any, Any, Any]):
    """An env that shows each step, and whose episode ends where another goal or a cancel came."""

    def __init__(self, env: gymnasium.Env[Any, Any], node: PolicyNode, link: Ros2Link) -> None:
        super().__init__(env)
        self._node, self._link = node, link
        self._due = 0.0
        self.start: Pose | None = None
        """Where the episode began, in the frame of the odometry."""

    def find_base(self) -> Pose | None:
        """Find the robot's pose in the frame of the odometry."""
        inner: Any = self.env.unwrapped
        return None if self.start is None else to_world(self.start, inner.robot.odometry.pose)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Do a step."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        node, inner = self._node, self.env.unwrapped
        assert isinstance(inner, RobotEnv)  # noqa: S101 - `run_episodes` has no other
        if node.is_interrupted:
            inner.robot.stop()
            truncated = True
        elif self.start is not None and time.monotonic() >= self._due and node.has_viewers:
            self._due = time.monotonic() + 0.9 * VIEW_PERIOD  # a step isn't exact
            node.show(take_view(inner, self.start, self._link.ros_time()))
        return observation, float(reward), terminated, truncated, info


class GoalDriver:
    """Drives a policy's robot to one goal after the other.

    Args:
        node: that hears the goals.
        policy: to drive with.
        first: a goal that there is at once.
        count: how many episodes there are; None for no end.
        how: keyword arguments of `run_episodes`.
    """

    def __init__(
        self,
        node: PolicyNode,
        policy: FilePolicy,
        first: Goal | None = None,
        count: int | None = None,
        how: Mapping[str, Any] = {},
    ) -> None:
        self._node, self._policy, self._how = node, policy, how
        node.goal = first
        self._count = count

    def drive(self, env: gymnasium.Env[Any, Any]) -> Iterator[Episode]:
        """Drive, and yield each episode, until enough have ended, or one by a fault.

        Raises:
            GoalError: the first goal can't be driven to; those that were heard are refused.
            LinkError: the robot can't be reached, or is silent while it waits.
            EmergencyStopError: its emergency stop was used.
        """
        node, inner = self._node, env.unwrapped
        assert isinstance(inner, RobotEnv)  # noqa: S101
        node.rules = GoalRules.of(env)
        robot = inner.robot
        robot.connect()
        link = robot.link.ros
        assert link is not None  # noqa: S101
        assert link.node is not None  # noqa: S101 - it is open
        link.places_robot = False
        node.listen(link.node)
        node.say(f"{self._policy.path}: waits for goals")
        watched, driven = WatchedEnv(env, node, link), 0
        while self._count is None or driven < self._count:
            goal = self._wait_for_goal(robot, link)
            try:
                watched.start = start = self._wait_until_still(robot, link)
                if node.goal is not None:  # meanwhile
                    goal, node.goal = node.goal, None
                place = self._place(goal, start, robot, link)
                node.find_base = watched.find_base
                node.say(f"drives to {goal}")
                (episode,) = run_episodes(
                    watched, self._policy, 1, seed=driven, goal=place, **self._how
                )
                is_replaced = node.goal is not None and not node.is_cancelled
                is_over = episode.success or bool(episode.fault) or not node.is_interrupted
                end = node.describe_end(episode)
            except GoalError as error:
                if not goal.frame:  # of the command line
                    raise
                node.warn(f"refused: {error}")
                continue
            finally:
                node.is_driving = node.is_cancelled = False
                node.find_base = node.frames.find_base
            node.say(f"{goal}: {end}")
            driven += is_over or not is_replaced
            if is_over:
                yield episode
            if episode.fault:
                return

    def _wait_for_goal(self, robot: Any, link: Ros2Link) -> Goal:
        """Let time pass until there is a goal."""
        node = self._node
        while node.goal is None:
            self._idle(robot, link, IDLE_PERIOD)
        goal, node.goal = node.goal, None
        node.is_driving = True
        return goal

    def _idle(self, robot: Any, link: Ros2Link, duration: float) -> None:
        robot.check_estop()
        if robot.safety.stopped:
            raise EmergencyStopError
        link.idle(duration)
        self._node.catch_up()

    def _wait_until_still(self, robot: Any, link: Ros2Link) -> Pose | None:
        """Wait until the robot stands; return where, None where nothing says it.

        Raises:
            GoalError: it keeps moving, though nothing is commanded.
        """
        frames, before, heard = self._node.frames, None, 0
        for _ in range(round(STILL_TIMEOUT / STILL_PERIOD)):
            pose = frames.find_base() if frames.heard > heard else None
            if pose is not None and before is not None and is_near(pose, before):
                return pose
            before, heard = pose, frames.heard
            self._idle(robot, link, STILL_PERIOD)
        if before is None:  # or nothing new
            return None
        raise GoalError(
            f"the robot moves in {show_value(frames.odom)}, though it is commanded to stand"
        )

    def _place(self, goal: Goal, start: Pose | None, robot: Any, link: Ros2Link) -> Point:
        """Return a goal in the frame that begins where the robot stands [m]."""
        frames, rules = self._node.frames, self._node.rules
        place = goal.place[:2]
        if goal.frame:
            place = self._wait_for_frame(goal, robot, link)
            if start is None:
                raise GoalError(
                    f"{goal}: neither /tf nor the odometry's topic says where "
                    f"{show_value(frames.base)} is in {show_value(frames.odom)}"
                )
            place = to_odometry(start, (*place, 0.0))[:2]
        if rules is not None:
            rules.check(place, goal)
        if self._node.is_cancelled:
            raise GoalError(f"{goal}: was cancelled")
        return place

    def _wait_for_frame(self, goal: Goal, robot: Any, link: Ros2Link) -> Point:
        """Wait until a goal's frame is known; return the goal in that of the odometry [m]."""
        end = time.monotonic() + FRAME_TIMEOUT
        while True:
            try:
                return self._node.frames.find_goal(goal)
            except GoalError:
                if time.monotonic() > end:
                    raise
            self._idle(robot, link, IDLE_PERIOD)


def is_near(one: Pose, other: Pose) -> bool:
    """Return whether two poses are those of a robot that stands."""
    turned = abs(math.remainder(one[2] - other[2], math.tau))
    return math.dist(one[:2], other[:2]) < STILL_DISTANCE and turned < STILL_TURN


def drive_policy(
    options: Mapping[str, str],
    ready: Callable[[FilePolicy, str], Mapping[str, Any]],
    namespace: str = "",
    arguments: Sequence[str] = (),
    goal: Point | None = None,
    count: int | None = None,
    how: Mapping[str, Any] = {},
    *,
    trust: bool = False,
) -> tuple[str, str, EvaluationRun]:
    """Drive the robot of a namespace to goals that others give, or to one, as a node of ROS.

    Args:
        options: "policy", "env", "robot" and "lidar", as of `run`; where one is empty, the node's
            parameter of that name counts.
        ready: is called with policy and link before anything is opened; returns more options of
            the env.
        namespace: of the node and the robot.
        arguments: ROS's own, after "--ros-args".
        goal: x, y of the first goal, from where the robot stands [m].
        count: how many episodes there are; None for no end.
        how: keyword arguments of `episodes.run_episodes`.
        trust: whether the policy may be a file that can run code.

    Returns:
        The policy's name as it was given, the link's URL, and the results.

    Raises:
        MissingRosError: ROS 2 isn't installed.
        PolicyError, ConfigError: an option can't be used.
        LinkError: the robot can't be reached.
    """
    node = RosNode(
        POLICY_NODE,
        namespace,
        arguments,
        dict(options),
    )
    with contextlib.ExitStack() as ours:
        ours.callback(node.close)
        given = {name: value or str(node.read_parameter(name)) for name, value in options.items()}
        name = given["policy"] or DEFAULT_POLICY
        policy = load_policy(name, trust=trust, env=given["env"])
        config = RobotConfig.of(given["robot"] or None)
        link = "ros2" if node.namespace == "/" else f"ros2:{node.namespace}"
        more = ready(policy, link)
        own = PolicyNode(node, config)
        ours.callback(own.close)
        first = None if goal is None else Goal((*goal, 0.0))
        driver = GoalDriver(own, policy, first, count, how)
        farthest = (more.get("goal_distance") or (0.0, math.hypot(*(goal or (0.0, 0.0)))))[1]
        done = drive_to_goals(
            policy, link, config, driver.drive, farthest, how, lidar=given["lidar"] or None, **more
        )
        return name, link, done
