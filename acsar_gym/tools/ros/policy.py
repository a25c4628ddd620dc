"""A policy that drives a robot in ROS 2 to the goals of other nodes: `acsar-gym ros policy`.

Each goal is an episode, as in `run --link ros2`. The policy's own node receives goals and
transforms in a thread, while the control loop drives with the node of the link.
"""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

import gymnasium

from acsar_gym.config import RobotConfig
from acsar_gym.envs.robot_env import RobotEnv
from acsar_gym.errors import ConfigError, EmergencyStopError, show_value
from acsar_gym.ros.node import SPIN_PERIOD, RosNode, make_stamp
from acsar_gym.sensors.map.sensor import find_map
from acsar_gym.tasks.goal import GoalTask
from acsar_gym.tools.evaluation.episode import Episode
from acsar_gym.tools.evaluation.episodes import run_episodes
from acsar_gym.tools.evaluation.runs import EvaluationRun, drive_episodes, load_policy
from acsar_gym.tools.policies import FilePolicy
from acsar_gym.worlds import Pose
from acsar_gym.worlds.world import to_odometry, to_world

POLICY_NODE = "acsar_policy"
DEFAULT_POLICY = "point_goal"
IDLE_PERIOD = 0.05
"""How soon a goal is noticed while the robot is at rest [s]."""
FRAME_TIMEOUT = 2.0
"""Longest wait until a goal's place is known, while the robot is at rest [s]."""


class GoalError(ConfigError):
    """A goal to which the policy doesn't drive."""


class UnknownPlaceError(GoalError):
    """A goal or a robot whose place isn't known, perhaps only not yet."""


class Goal(NamedTuple):
    """A goal that was given."""

    x: float
    y: float
    frame: str = ""
    """Frame of the goal. Empty for the frame that starts where the robot is."""

    def __str__(self) -> str:
        return f"goal ({self.x:g}, {self.y:g})" + (
            f" in {show_value(self.frame)}" if self.frame else ""
        )


class Frames:
    """Poses of frames in the plane, from /tf, /tf_static and the odometry's topic.

    Args:
        odom: Frame of the odometry.
        base: Frame of the robot.
    """

    def __init__(self, odom: str, base: str) -> None:
        self._odom = odom
        self._base = base
        self._placed: dict[str, tuple[str, Pose]] = {}
        self._pose: Pose | None = None

    def add(self, parent: str, child: str, pose: Pose) -> None:
        """Store the newest pose of a frame in its parent, unless it isn't finite."""
        # A filter that diverged publishes NaN. The pose before it still holds.
        if all(map(math.isfinite, pose)):
            self._placed[child.lstrip("/")] = (parent.lstrip("/"), pose)

    def add_odometry(self, parent: str, pose: Pose) -> None:
        """Store the newest pose of the odometry's topic, for robots without transforms.

        Poses in another frame, such as a localization's map, are ignored.
        """
        if parent.lstrip("/") in ("", self._odom) and all(map(math.isfinite, pose)):
            self._pose = pose

    def find_base(self) -> Pose | None:
        """Return the robot's pose in the odometry's frame. None if it isn't known."""
        return self._find(self._base) or self._pose

    def find_goal(self, goal: Goal) -> Pose:
        """Return the place of a goal in the odometry's frame, as a pose.

        Raises:
            GoalError: It has no finite numbers, no frame, or a frame that no transforms connect
                with the odometry's.
        """
        frame = goal.frame.lstrip("/")
        if not math.isfinite(goal.x + goal.y):
            raise GoalError(f"{goal}: must be finite numbers")
        if not frame:
            raise GoalError(f"{goal}: its header names no frame")

        pose = self.find_base() if frame == self._base else self._find(frame)
        if pose is None:
            raise UnknownPlaceError(
                f"{goal}: no transforms on /tf and /tf_static connect this frame with "
                f"{show_value(self._odom)}"
            )
        return to_world(pose, (goal.x, goal.y, 0.0))

    def fix_goal(self, goal: Goal) -> Goal:
        """Return a goal in a frame that doesn't move with the robot, such as map or odom."""
        # A goal ahead of the robot must not move with it.
        frame = goal.frame.lstrip("/")
        ancestors = self._list_ancestors(frame)
        moves = self._base in ancestors or (self._odom in ancestors and frame != self._odom)
        return Goal(*self.find_goal(goal)[:2], self._odom) if moves else goal

    def _find(self, frame: str) -> Pose | None:
        """Return the pose of a frame in the odometry's. None if transforms don't connect them."""
        ancestors = self._list_ancestors(frame)
        for ancestor, odom_pose in self._list_ancestors(self._odom).items():
            if ancestor in ancestors:
                return to_odometry(odom_pose, ancestors[ancestor])
        return None

    def _list_ancestors(self, frame: str) -> dict[str, Pose]:
        """Return the poses of a frame in itself, in its parent, and so on, by their names."""
        poses: dict[str, Pose] = {frame: (0.0, 0.0, 0.0)}
        while frame in self._placed:
            parent, placed = self._placed[frame]
            if parent in poses:  # the transforms form a circle
                break
            poses[parent] = to_world(placed, poses[frame])
            frame = parent
        return poses


class GoalRules(NamedTuple):
    """How near and how far the goals of a task may be [m]."""

    nearest: float
    farthest: float

    @classmethod
    def of(cls, env: gymnasium.Env[Any, Any]) -> GoalRules:
        """Return the rules of an env's task, or what the top speed reaches in its time limit.

        Raises:
            ConfigError: Its task has no goals that are points.
        """
        inner: Any = env.unwrapped
        task = inner.task
        if not isinstance(task, GoalTask) or task.follows:
            raise ConfigError(f"{task.id}: has no goals to drive to; use a policy for such a task")

        # Tasks without worlds have their own distances.
        if inner.pool is None:
            return cls(*task.goal_distance)
        config = inner.robot.config
        steps = env.spec.max_episode_steps if env.spec is not None else None
        seconds = math.inf if steps is None else steps * inner.ticks_per_step * config.period
        return cls(task.goal_tolerance, config.max_linear * seconds)

    def check(self, goal: Goal, distance: float) -> None:
        """Raise GoalError unless a goal may be so far away [m]."""
        if not self.nearest <= distance <= self.farthest:
            raise GoalError(
                f"{goal}: is {distance:.3g} m away: must be {self.nearest:g} to "
                f"{self.farthest:g} m, by the policy's task (see --goal-distance)"
            )


class PolicyNode(RosNode):
    """The node of a policy, in a thread.

    Args:
        options: Parameters of the node, with their defaults.
        namespace: Namespace of the node.
        arguments: Arguments of ROS, which follow "--ros-args".

    Attributes:
        frames: Poses of frames.
        rules: How near and how far goals may be.
        goal: Newest goal that hasn't been taken. None if there is none.
        is_driving: Whether an episode runs.
        is_cancelled: Whether the running episode must end.
    """

    def __init__(
        self, options: Mapping[str, str], namespace: str, arguments: Sequence[str]
    ) -> None:
        super().__init__(POLICY_NODE, namespace, arguments, dict(options))
        self.frames = Frames("odom", "base_link")
        self.rules = GoalRules(0.0, math.inf)
        self.goal: Goal | None = None
        self._waiting: tuple[Goal, float] | None = None
        self.is_driving = False
        self.is_cancelled = False

    def start(self, config: RobotConfig) -> None:
        """Receive the robot's poses from now on."""
        self.frames = Frames(config.odom_frame, config.base_frame)
        self._odom_frame = config.odom_frame
        if not self.subscribe_transforms(self._take_transforms):
            self.warn("tf2_msgs isn't installed: goals must be in the frame of the odometry")
        kind = self.ros.Odometry
        self.subscribe(config.ros2.odom_topic, kind, self._take_odometry, best_effort=True)
        self._plan = self.publish("plan", self.ros.Path)
        self.start_threads(partial(self.spin, SPIN_PERIOD))

    def listen(self, rules: GoalRules, about: str) -> None:
        """Receive goals and offer the service from now on."""
        self.rules = rules
        # Only now, when the robot can be driven.
        self.subscribe("goal_pose", self.ros.PoseStamped, self._take_goal)
        self.node.create_service(self.ros.Trigger, "~/cancel", self._cancel)
        self.say(f"{about}: waits for goals")

    def retry_goal(self) -> None:
        """Take the goal that was given, as soon as its place is known. Refuse it after a while."""
        waiting = self._waiting
        if waiting is None:
            return

        goal, deadline = waiting
        try:
            # A goal that can't be reached doesn't end the previous one.
            self.find_place(goal)
            self.goal = self.frames.fix_goal(goal)
        except GoalError as error:
            is_unknown = isinstance(error, UnknownPlaceError)
            if is_unknown and not self.is_driving and time.monotonic() < deadline:
                return
            self.warn(f"refused: {error}")

        # The thread may have got another goal meanwhile.
        if self._waiting is waiting:
            self._waiting = None

    def take_goal(self) -> Goal:
        """Take the newest goal, to drive to it."""
        goal = self.goal
        assert goal is not None  # noqa: S101 - the caller has waited for it
        self.goal = None
        self.is_cancelled = False
        self.is_driving = True
        return goal

    def find_place(self, goal: Goal) -> tuple[float, float]:
        """Return a goal in the frame that starts where the robot is [m].

        Raises:
            GoalError: It is too near or too far, or its place isn't known.
        """
        # A goal of the command line is relative to the robot already.
        place = goal[:2]
        if goal.frame:
            in_odom = self.frames.find_goal(goal)
            base = self.frames.find_base()
            if base is None:
                raise UnknownPlaceError(
                    f"{goal}: neither /tf nor the odometry's topic has the robot's pose in "
                    f"{show_value(self._odom_frame)}"
                )
            place = to_odometry(base, in_odom)[:2]
        self.rules.check(goal, math.hypot(*place))
        return place

    def describe_end(self, episode: Episode) -> str:
        """Describe how the episode ended."""
        if episode.fault or episode.success:
            return episode.fault or f"reached in {episode.time:.1f} s"
        if self.is_cancelled:
            return "cancelled"
        return "replaced by another goal" if self.goal is not None else "not reached"

    @property
    def is_interrupted(self) -> bool:
        """Whether the running episode must end, or another goal has come."""
        return self.is_cancelled or self.goal is not None

    def show_plan(self, points: Sequence[Sequence[float]], nanoseconds: int) -> None:
        """Publish a path through points of the odometry's frame, if it has subscribers."""
        if not self._plan.get_subscription_count():
            return
        ros = self.ros
        plan = ros.Path()
        plan.header.frame_id = self._odom_frame
        plan.header.stamp = make_stamp(ros, nanoseconds)
        for (x, y), heading in zip(points, list_headings(points), strict=True):
            pose = ros.PoseStamped(header=plan.header)
            pose.pose.position.x = x
            pose.pose.position.y = y
            pose.pose.orientation.z = math.sin(heading / 2.0)
            pose.pose.orientation.w = math.cos(heading / 2.0)
            plan.poses.append(pose)
        self._plan.publish(plan)

    # In the thread

    def _take_transforms(self, message: Any) -> None:
        for stamped in message.transforms:
            place = stamped.transform
            pose = _read_pose(place.translation, place.rotation)
            self.frames.add(stamped.header.frame_id, stamped.child_frame_id, pose)

    def _take_odometry(self, message: Any) -> None:
        pose = message.pose.pose
        place = _read_pose(pose.position, pose.orientation)
        self.frames.add_odometry(message.header.frame_id, place)

    def _take_goal(self, message: Any) -> None:
        """Take a goal, which ends the previous one. Its yaw isn't used."""
        place = message.pose.position
        goal = Goal(place.x, place.y, message.header.frame_id)
        # A node that has just started may not have the transforms yet.
        self._waiting = (goal, time.monotonic() + FRAME_TIMEOUT)
        self.retry_goal()

    def _cancel(self, _: Any, response: Any) -> Any:
        has_goal = self.goal is not None or self._waiting is not None
        response.success = self.is_driving or has_goal
        response.message = "cancelled" if response.success else "nothing is driven"
        self.is_cancelled = self.is_driving
        self.goal = None
        self._waiting = None
        return response


def list_headings(points: Sequence[Sequence[float]]) -> list[float]:
    """Return the directions in which the points of a path look ahead [rad]."""
    headings = [math.atan2(y - v, x - u) for (u, v), (x, y) in pairwise(points)]
    # The last point has nothing ahead.
    return [*headings, *(headings[-1:] or [0.0])]


def _read_pose(place: Any, turn: Any) -> Pose:
    """Return the planar pose of a geometry_msgs/Point or Vector3, and a Quaternion."""
    # The yaw of any rotation, tilted ones included.
    sin = 2.0 * (turn.w * turn.z + turn.x * turn.y)
    cos = 1.0 - 2.0 * (turn.y * turn.y + turn.z * turn.z)
    return place.x, place.y, math.atan2(sin, cos)


def move_goal(env: RobotEnv, place: tuple[float, float]) -> None:
    """Move the goal of the running episode, x and y in its odometry frame [m]."""
    episode = env.episode
    episode.assignment = replace(episode.assignment, goal=place)
    if (map_sensor := find_map(env.sensors)) is not None:
        map_sensor.move_goal(place)


class GoalEnv(gymnasium.Wrapper[Any, Any, Any, Any]):
    """An env whose goal follows the transforms, and whose episode ends by a new goal or a cancel.

    Args:
        env: Env whose link is one to a robot in ROS 2.
        node: Node that receives goals.

    Attributes:
        goal: Goal of the episode.
    """

    def __init__(self, env: gymnasium.Env[Any, Any], node: PolicyNode) -> None:
        super().__init__(env)
        self._inner: Any = env.unwrapped
        self._node = node
        self._start: Pose | None = None
        self.goal = Goal(0.0, 0.0)

    def reset(self, **options: Any) -> tuple[Any, dict[str, Any]]:
        """Start an episode. Its odometry frame starts where the robot is at rest now."""
        result = self.env.reset(**options)
        # Places of the episode are relative to this pose.
        self._start = self._node.frames.find_base()
        return result

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Do a step."""
        # Without its thread the node would hear neither a cancel nor a new goal.
        self._node.check()

        # The map may have been corrected since the last step.
        if self.goal.frame and self._start is not None:
            self._follow_goal(self._start)
        observation, reward, terminated, truncated, info = self.env.step(action)

        # The wheels stop at once, also if a new goal follows.
        if self._node.is_interrupted:
            self._inner.robot.stop()
            truncated = True
        elif self._start is not None:
            self._show_plan(self._start)
        return observation, float(reward), terminated, truncated, info

    def _follow_goal(self, start: Pose) -> None:
        try:
            in_odom = self._node.frames.find_goal(self.goal)
        except GoalError:
            # Frames got other parents. The wheels must not turn while the next goal is awaited.
            self._inner.robot.stop()
            raise
        move_goal(self._inner, to_odometry(start, in_odom)[:2])

    def _show_plan(self, start: Pose) -> None:
        robot = self._inner.robot
        map_sensor = find_map(robot.sensors)
        # Without a map, or a way over it, the way is a straight line.
        ahead = [] if map_sensor is None else map_sensor.way_ahead.tolist()
        ahead = ahead or [self._inner.episode.assignment.goal]
        places = [robot.odometry.pose, *((x, y, 0.0) for x, y, *_ in ahead)]
        points = [to_world(start, place)[:2] for place in places]
        self._node.show_plan(points, robot.link.ros.ros_time())


def drive_goals(
    env: gymnasium.Env[Any, Any],
    policy: FilePolicy,
    node: PolicyNode,
    count: int | None,
    options: Mapping[str, Any],
) -> Iterator[Episode]:
    """Drive to one goal after another, and yield each episode.

    Args:
        env: Env of the policy, with a link to a robot in ROS 2.
        policy: The policy.
        node: Node that receives the goals.
        count: Number of episodes. None for no end.
        options: Keyword arguments of `run_episodes`.

    Raises:
        GoalError: A goal of the command line can't be driven to. Goals of other nodes are refused.
        LinkError: The robot can't be reached, or is silent while it waits.
        EmergencyStopError: Its emergency stop was used.
    """
    inner: Any = env.unwrapped
    robot = inner.robot
    robot.connect()
    link = robot.link.ros
    # Goals are places of the world in which the robot is, so it stays there.
    link.places_robot = False
    node.listen(GoalRules.of(env), str(policy.path))
    # Wrapped once: episodes come and go, the robot and its links stay.
    watched = GoalEnv(env, node)
    driven = 0
    while count is None or driven < count:
        # The robot is at rest, and its link goes on, so that failures and stops are noticed.
        while node.goal is None:
            node.check()
            node.retry_goal()
            robot.check_estop()
            if robot.safety.stopped:
                raise EmergencyStopError
            link.advance(IDLE_PERIOD)

        watched.goal = goal = node.take_goal()
        try:
            place = node.find_place(goal)
            node.say(f"drives to {goal}")
            (episode,) = run_episodes(watched, policy, 1, seed=driven, goal=place, **options)
        except GoalError as error:
            if not goal.frame:
                raise
            node.warn(f"refused: {error}")
            continue
        finally:
            node.is_driving = False

        # A goal that was replaced isn't an episode of the results.
        is_over = episode.success or bool(episode.fault) or not node.is_interrupted
        node.say(f"{goal}: {node.describe_end(episode)}")
        driven += is_over or node.is_cancelled
        if is_over:
            yield episode
        if episode.fault:
            return


def drive_policy(
    options: Mapping[str, str],
    ready: Callable[[FilePolicy, str], Mapping[str, Any]],
    *,
    namespace: str = "",
    arguments: Sequence[str] = (),
    goal: tuple[float, float] | None = None,
    count: int | None = None,
    how: Mapping[str, Any] = {},
    trust: bool = False,
) -> tuple[str, str, EvaluationRun]:
    """Drive the robot of a namespace to goals, as a node of ROS.

    Args:
        options: "policy", "env", "robot" and "lidar", as of `run`. If one is empty, the node's
            parameter of that name is used.
        ready: Is called with policy and link before anything is opened, and returns more options
            of the env.
        namespace: Namespace of the node and the robot.
        arguments: Arguments of ROS, which follow "--ros-args".
        goal: Place x, y of the first goal, from where the robot is [m].
        count: Number of episodes. None for no end.
        how: Keyword arguments of `run_episodes`.
        trust: Whether the policy may be a file that can run code.

    Returns:
        The policy's name, the link's URL, and the results.

    Raises:
        MissingRosError: ROS 2 isn't installed.
        PolicyError, ConfigError: An option has a wrong value.
        LinkError: The robot can't be reached.
    """
    with contextlib.closing(PolicyNode(options, namespace, arguments)) as node:
        # Options have precedence over parameters.
        chosen = {name: value or str(node.read_parameter(name)) for name, value in options.items()}
        name = chosen["policy"] or DEFAULT_POLICY
        policy = load_policy(name, trust=trust, env=chosen["env"])
        config = RobotConfig.of(chosen["robot"] or None)
        link = "ros2" if node.namespace == "/" else f"ros2:{node.namespace}"
        more = ready(policy, link)
        node.start(config)
        node.goal = None if goal is None else Goal(*goal)
        farthest = (more.get("goal_distance") or (0.0, math.hypot(*(goal or (0.0, 0.0)))))[1]

        def drive(env: gymnasium.Env[Any, Any]) -> Iterator[Episode]:
            return drive_goals(env, policy, node, count, how)

        results = drive_episodes(
            policy,
            link,
            config,
            drive,
            farthest=farthest,
            about=how,
            lidar=chosen["lidar"] or None,
            **more,
        )
        return name, link, results
