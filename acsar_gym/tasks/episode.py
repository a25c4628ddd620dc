"""Draw the world, start and goal of an episode, and call a task's methods for one robot."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from acsar_gym.config import RobotConfig
from acsar_gym.errors import (
    AcsarWarning,
    ConfigError,
    TranslatedErrors,
    WorldError,
    show_value,
)
from acsar_gym.jit import jit
from acsar_gym.tasks.factory import task_name
from acsar_gym.tasks.options import check_distances, check_reset_options, read_number
from acsar_gym.tasks.state import Floats, Goal, Observation, Pose, State
from acsar_gym.tasks.task import (
    Outcome,
    Task,
    info_names,
    new_memory,
    observation_bounds,
    point_in_disc,
    relative_point,
    says_shortest_path,
)
from acsar_gym.worlds import Region, World
from acsar_gym.worlds.generators import Level
from acsar_gym.worlds.pool import Key, Pool, check_world
from acsar_gym.worlds.search import (
    align_with_path,
    footprint_radius,
    lidar_height,
    sample_path,
    world_along,
)
from acsar_gym.worlds.sets import Source

OUTCOMES = tuple(Outcome)
WORLD_DRAWS = 6
"""How many uniform samples an episode in a world takes: world, start (2), heading, goal (2)."""


@dataclass(frozen=True, slots=True)
class Assignment:
    """World, start, goal and path of one episode.

    Example:
        >>> from acsar_gym.tasks import Assignment
        >>> Assignment(goal=(1.0, 0.5)).start
        (0.0, 0.0, 0.0)
    """

    goal: Goal
    """The goal x, y in the odometry frame, in which the robot starts at the origin [m]."""
    world: World | None = None
    """Obstacles. None on an open floor."""
    path: Floats | None = None
    """(samples, 3): x [m], y [m] and direction [rad] of the path to follow, in the odometry
    frame."""
    length: float = math.nan
    """Length of the world's own path from start to goal [m]. NaN if the world has none."""
    world_key: Key = -1
    """Number of the world: its generator's number, or its place in a list or folder. Among several
    sets of worlds its name, such as "clutter 17". -1 for a world that a user gave the reset."""
    start: Pose = (0.0, 0.0, 0.0)
    """Where the robot starts: x [m], y [m], theta [rad] in the frame of the world."""
    key: float = 0.0
    """The episode's draw for the world's movers, see `Scene.key`."""

    @property
    def info(self) -> dict[str, float]:
        """What it adds to info: the world's number. Nothing on an open floor or for a name."""
        if self.world is None or isinstance(self.world_key, str):
            return {}
        return {"world": float(self.world_key)}


class Spawn:
    """Draws the assignments of a task's episodes.

    Attributes:
        pool: The worlds. None on an open floor.
        options: Names that a reset knows.

    Args:
        task: Task of the env.
        worlds: Worlds of the env. None for the task's own.
        difficulty: Difficulty of generated worlds. None for the task's own.
        config: Robot configuration, which has the footprint that has to fit.
    """

    def __init__(
        self, task: Task, worlds: Source | None, difficulty: Level, config: RobotConfig
    ) -> None:
        self._task = task
        check_distances(task.goal_distance)

        # Options of the env replace what the task declares.
        source = task.worlds if worlds is None else worlds
        level = task.difficulty if difficulty is None else difficulty

        if source is None and level is not None:
            raise ConfigError(f"difficulty = {show_value(level)}: {task.id} has no worlds")
        self.pool: Pool | None = None
        self.options: tuple[str, ...] = ("goal",)
        if source is not None:
            height = lidar_height(config)
            self.pool = Pool.of(source, level, footprint_radius(config), height=height)
            self.options = ("world", "difficulty", "path" if task.follows else "goal")

    def draw(self, rng: np.random.Generator, options: Mapping[str, Any]) -> Assignment:
        """Draw the assignment of the next episode.

        Args:
            rng: The env's generator.
            options: Options of the reset: "goal", (x, y) in the odometry frame [m]. In worlds also
                "world", a number, a World, or among several sets a name such as "clutter 17", and
                "difficulty", (low, high) of the worlds to draw from. For tasks that follow "path",
                points (x, y) [m], instead of "goal".

        Raises:
            ConfigError, WorldError: Options are unknown, malformed, out of range, or contradict
                each other.
        """
        options = check_reset_options(options, self.options)
        _refuse_contradictions(options)

        # In the order in which options exclude each other.
        path = options.get("path")
        goal = options.get("goal")
        if path is not None:
            return assign_path(path)
        if self.pool is not None:
            return draw_in_world(self.pool, rng, options, follow=self._task.follows)
        if goal is not None:
            return Assignment(self.check_goal(_check_point(goal)))
        distance = rng.uniform(*self._task.goal_distance)
        return Assignment(goal_at(distance, rng.uniform(-math.pi, math.pi)))

    def check_goal(self, goal: Goal) -> Goal:
        """Return a goal on an open floor [m]. ConfigError if it isn't within `goal_distance`."""
        # A policy has seen no goals outside of these limits.
        nearest, farthest = self._task.goal_distance
        if not nearest <= math.hypot(*goal) <= farthest:
            raise ConfigError(
                f"goal = ({goal[0]:g}, {goal[1]:g}): must lie {nearest:g} to {farthest:g} m from "
                "the start: give the env another goal_distance, run --goal-distance"
            )
        return goal


def _refuse_contradictions(options: Mapping[str, Any]) -> None:
    """Raise ConfigError if two options name the world or the path of the episode."""
    # Each of these chooses what surrounds the robot.
    names = [name for name in ("path", "world", "difficulty") if options.get(name) is not None]
    if len(names) > 1:
        raise ConfigError(
            f"reset options {' and '.join(map(repr, names))} contradict each other, as each "
            "chooses the surroundings: give one of them"
        )


def _check_point(value: Any) -> Goal:
    """Return a goal of two finite numbers. ConfigError for anything else."""
    try:
        x, y = map(read_number, value)
    except (TypeError, ValueError):
        x = y = math.nan
    if not (math.isfinite(x) and math.isfinite(y)):
        raise ConfigError(f"goal = {show_value(value)}: must be two finite numbers (x, y) [m]")
    return (x, y)


@jit
def goal_at(distance: float, bearing: float) -> Goal:
    """The point at a distance [m] and a bearing [rad] from the origin."""
    return (distance * math.cos(bearing), distance * math.sin(bearing))


def choose_world(worlds: Pool, share: float, options: Mapping[str, Any]) -> tuple[Key, World]:
    """Choose the world of an episode, and return its key, -1 for a World object, and the world.

    `share` is a uniform sample of [0, 1), used if the options name no world.
    """
    wanted = options.get("world")
    difficulty = options.get("difficulty")
    if isinstance(wanted, World):
        return -1, check_world(wanted, worlds.radius)

    if wanted is None and difficulty is None:
        # The product may round up to the number of worlds, although the share is below 1.
        key = worlds.key(min(int(share * len(worlds)), len(worlds) - 1))
    elif wanted is None:
        ranks = worlds.ranks(difficulty)
        rank = ranks[min(int(share * len(ranks)), len(ranks) - 1)]
        key = worlds.key(int(worlds.by_difficulty[0][rank]))
    elif isinstance(wanted, str) and worlds.numbers is None:
        key = wanted
    elif isinstance(wanted, int | float | np.number) and read_number(wanted).is_integer():
        key = int(wanted)  # info has it as a float
    else:
        raise ConfigError(
            f"world = {show_value(wanted)}: must be a number, among several sets a name, of the "
            "env's worlds, or a World"
        )
    return key, worlds[key]


def draw_in_world(
    worlds: Pool, rng: np.random.Generator, options: Mapping[str, Any], *, follow: bool = False
) -> Assignment:
    """Draw a world, the start in it and the goal. Takes WORLD_DRAWS numbers, and one for movers."""
    # All numbers are drawn whatever the options are, so later episodes don't depend on these.
    world_share, *start_shares, heading_share, goal_u, goal_v = rng.random(WORLD_DRAWS).tolist()
    world_key, world = choose_world(worlds, world_share, options)
    key = float(rng.random()) if world.movers else 0.0
    ends = align_with_path(world) if follow else world

    # The start, in the frame of the world.
    x, y = point_in_disc(ends.start.x, ends.start.y, ends.start.radius, *start_shares)
    theta = ends.start.theta
    if theta is None:
        theta = (2.0 * heading_share - 1.0) * math.pi

    # The goal and the path, in the odometry frame.
    length = ends.length
    path = None
    if options.get("goal") is not None:
        goal = _check_point(options["goal"])
        length = math.nan  # the world's path leads elsewhere
    else:
        goal_x, goal_y = point_in_disc(ends.goal.x, ends.goal.y, ends.goal.radius, goal_u, goal_v)
        cos = math.cos(theta)
        sin = math.sin(theta)
        goal = relative_point(x, y, cos, sin, other_x=goal_x, other_y=goal_y)
        path = path_from_start(ends) if follow else None
    return Assignment(goal, world, path, length, world_key=world_key, start=(x, y, theta), key=key)


def assign_path(path: Any) -> Assignment:
    """Make an assignment of a path that a user gives as points (x, y) in the odometry frame [m].

    The robot starts at the origin of that frame, wherever the path begins.
    """
    # With its start at the origin, the frame of this world is the odometry frame.
    world = replace(world_along(path), start=Region(0.0, 0.0, 0.0, 0.0), name="given")
    goal = (world.goal.x, world.goal.y)
    return Assignment(goal, world, path_from_start(world), world.length)


def path_from_start(world: World) -> Floats:
    """A world's path in the frame of its start, (samples, 3): x [m], y [m], direction [rad]."""
    start = world.start
    if world.path is None or start.theta is None:
        raise WorldError(f"{world.name or 'the world'}: has no path to follow")
    samples = sample_path(world.path)
    cos = math.cos(start.theta)
    sin = math.sin(start.theta)
    points = (samples[:, :2] - (start.x, start.y)) @ np.array([[cos, -sin], [sin, cos]])
    path: Floats = np.column_stack([points, samples[:, 2] - start.theta])
    path.setflags(write=False)  # tasks get it
    return path


class ObservationCheck:
    """Checks a task's own numbers of observations. Warns once if they leave their bounds."""

    def __init__(self, task: Task) -> None:
        self._task = task
        self._low, self._high = observation_bounds(task)
        self._has_warned = False

    def check(self, numbers: Observation) -> None:
        """Check the observation of a robot, (numbers,), or of each robot, (robots, numbers).

        Raises:
            ConfigError: A number isn't finite.

        Warns:
            AcsarWarning: A number is beyond its bounds, once.
        """
        if self._low.shape != numbers.shape:  # arrays of one shape are compared much faster
            self._low = np.broadcast_to(self._low, numbers.shape).copy()
            self._high = np.broadcast_to(self._high, numbers.shape).copy()

        numbers = np.ascontiguousarray(numbers)

        # One test of all numbers is fast, and nearly always the last.
        is_inside = (numbers >= self._low) & (numbers <= self._high)
        if is_inside.all():
            return
        is_finite = np.isfinite(numbers)
        is_sound = is_inside if is_finite.all() else is_finite
        if is_sound is is_inside and self._has_warned:
            return

        robot, column = np.argwhere(~np.atleast_2d(is_sound))[0]
        name = list(self._task.observation)[column]
        value = np.atleast_2d(numbers)[robot, column]
        whose = f" for robot {robot}" if numbers.ndim > 1 else ""
        source = f"{task_name(self._task)}.observe returned"
        if is_sound is is_finite:
            raise ConfigError(f"{source} {{{name!r}: {value}}}{whose}: must be finite numbers")
        self._has_warned = True
        low, high = self._task.observation[name]
        warnings.warn(
            f"{source} {name!r} = {value:g}{whose}: beyond its bounds ({low:g}, {high:g}): clip "
            "it, or declare wider bounds in `observation`",
            AcsarWarning,
            stacklevel=3,
        )


class RunningEpisode:
    """The running episode of a task.

    Attributes:
        task: Task of the env.
        assignment: World, start and goal.
        memory: What the task remembers.
        steps: Number of steps.
        state: Newest state.
        outcome: Outcome of the newest step.

    Args:
        task: Task of the env.
        assignment: World, start and goal of the episode.
        check: Check of the task's observations, the same for all episodes of an env.
    """

    def __init__(
        self, task: Task, assignment: Assignment, check: ObservationCheck | None = None
    ) -> None:
        self.task = task
        self.assignment = assignment
        self.memory = new_memory(task)
        self.steps = 0
        self.state = State()
        self.outcome = Outcome.GOING
        self._check = check or ObservationCheck(task)
        self._info_names = info_names(task)
        self._user_errors = TranslatedErrors(ConfigError, lambda: task_name(task))

    def begin(self, state: State) -> None:
        """Begin the episode with the state after the reset. ConfigError as for `step`."""
        self.state = state
        with self._user_errors:
            self.task.begin(state, self.memory)

    def step(self, state: State) -> tuple[float, Outcome]:
        """Return the reward and the outcome of the step that led to this state."""
        self.state = state
        with self._user_errors:
            outcome = self.task.outcome(state, self.memory)
            # True and False aren't outcomes: True would be a success.
            if isinstance(outcome, bool | np.bool_) or outcome not in OUTCOMES:
                must = "must be an Outcome, such as Outcome.SUCCESS"
                raise self._error("outcome", f"{show_value(outcome)}: {must}")
            self.outcome = Outcome(outcome)
            reward = self.task.reward(state, self.memory, self.outcome)

        # A reward that isn't a number, such as None, becomes NaN here and is refused.
        number = read_number(reward)
        if not math.isfinite(number):
            raise self._error("reward", f"{show_value(reward)}: must be a finite number")
        return number, self.outcome

    def observe(self, state: State) -> Observation:
        """Return the task's own part of the observation, (numbers,)."""
        with self._user_errors:
            numbers = np.array(self.task.observe(state, self.memory), np.float32)
        # Names of the observation and its numbers have to match.
        shape = (len(self.task.observation),)
        if numbers.shape != shape:
            problem = f"numbers of shape {numbers.shape}: must be {shape}, as `observation` has"
            raise self._error("observe", f"{problem} names")
        self._check.check(numbers)
        return numbers

    def shortest_path(self, pose: Pose) -> Floats | float | None:
        """Ask the task for the shortest way from a pose to success. See `Task.shortest_path`."""
        if not says_shortest_path(self.task):
            return None

        # The method is the user's own, and gets the true pose if it is known.
        with self._user_errors:
            way: Any = self.task.shortest_path(self.state._replace(pose=pose), self.memory)
            if way is None:
                return None
            numbers: Floats = np.array(way, np.float64)
            is_length = numbers.ndim == 0
            places = numbers if is_length else numbers.reshape(len(numbers), 2)
        if not np.isfinite(places).all() or (is_length and places < 0.0):
            problem = "must be places (x, y) [m], a length [m], or None"
            raise self._error("shortest_path", f"{show_value(way)}: {problem}")
        return float(places) if is_length else places

    def info(self) -> dict[str, float]:
        """Return what the task adds to info. The keys are the same at every step."""
        memory = vars(self.memory)
        with self._user_errors:
            numbers = {name: float(memory[name]) for name in self._info_names}
        return numbers | self.assignment.info

    def _error(self, method: str, problem: str) -> ConfigError:
        return ConfigError(f"{task_name(self.task)}.{method} returned {problem}")
