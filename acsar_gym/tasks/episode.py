"""Draw the world, start and goal of an episode, and call a task's methods for one robot."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from acsar_gym.config import RobotConfig
from acsar_gym.errors import AcsarWarning, ConfigError, WorldError, show_value, translate_errors
from acsar_gym.jit import jit
from acsar_gym.tasks.factory import ask_outcome, ask_reward, method_place, task_name
from acsar_gym.tasks.options import check_distances, check_reset_options
from acsar_gym.tasks.state import Goal, Info, Observation, State
from acsar_gym.tasks.task import (
    Outcome,
    Task,
    info_names,
    new_memory,
    point_in_disc,
    relative_point,
    says_shortest_path,
)
from acsar_gym.worlds import Pose, Region, World
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
from acsar_gym.worlds.world import Floats

WORLD_DRAWS = 6
"""How many uniform samples an episode in a world takes: world, start (2), heading, goal (2)."""


@dataclass(frozen=True, slots=True)
class Assignment:
    """World, start, goal and path of one episode."""

    goal: Goal
    """The goal x, y in the odometry frame, in which the robot starts at the origin [m]."""
    world: World | None = None
    """Obstacles; None on an open floor."""
    path: Floats | None = None
    """(samples, 3): x [m], y [m] and direction [rad] of the path to follow, in the odometry
    frame."""
    length: float = math.nan
    """Length of the world's own path from start to goal [m]; NaN where there is none."""
    world_key: Key = -1
    """Number of the world: its generator's number, or its place in a list or folder. Among several
    sets of worlds its name, such as "clutter 17". -1 for a world that a user gave the reset."""
    start: Pose = (0.0, 0.0, 0.0)
    """Where the robot starts: x [m], y [m], theta [rad] in the frame of the world."""
    key: float = 0.0
    """The episode's draw for the world's movers, see `Scene.key`."""

    @property
    def info(self) -> Info:
        """What it adds to info: the world's number; nothing on an open floor or for a name."""
        if self.world is None or isinstance(self.world_key, str):
            return {}
        return {"world": float(self.world_key)}


class Spawn:
    """Draws the assignments of a task's episodes.

    Attributes: `pool`, the worlds, or None on an open floor; `options`, the names that a reset
    knows.
    """

    def __init__(
        self, task: Task, worlds: Source | None, difficulty: Level, config: RobotConfig
    ) -> None:
        """Make the pool of worlds; the task's own where none are given."""
        self._task = task
        source = task.worlds if worlds is None else worlds
        level = task.difficulty if difficulty is None else difficulty
        if source is None and level is not None:
            raise ConfigError(f"difficulty = {show_value(level)}: {task.id} has no worlds")
        self.pool = None
        if source is not None:
            radius, height = footprint_radius(config), lidar_height(config)
            self.pool = Pool.of(source, level, radius, height=height)
        check_distances(task.goal_distance)
        self.options: tuple[str, ...] = ("goal",)
        if self.pool is not None:
            self.options = ("world", "difficulty", "path" if task.follows else "goal")

    def draw(self, rng: np.random.Generator, options: Mapping[str, Any]) -> Assignment:
        """Draw the assignment of the next episode.

        Args:
            rng: the env's generator.
            options: of the reset: "goal", (x, y) in the odometry frame [m]; in worlds "world", a
                number, a World, or among several sets a name such as "clutter 17", and
                "difficulty", (low, high) of the worlds to draw from; for tasks that follow "path",
                points (x, y) [m], instead of "goal".

        Raises:
            ConfigError, WorldError: for unknown options, options that contradict each other, or
                values that are malformed or out of range.
        """
        options = check_reset_options(options, self.options)
        _refuse_contradictions(options)
        if options.get("path") is not None:
            return assign_path(options["path"])
        if self.pool is not None:
            return draw_in_world(self.pool, rng, options, follow=self._task.follows)
        if options.get("goal") is not None:
            return Assignment(self.check_goal(_check_point(options["goal"])))
        distance = rng.uniform(*self._task.goal_distance)
        return Assignment(goal_at(distance, rng.uniform(-math.pi, math.pi)))

    def check_goal(self, goal: Goal) -> Goal:
        """Return a goal on an open floor [m]; ConfigError where it isn't within `goal_distance`."""
        nearest, farthest = self._task.goal_distance
        if not nearest <= math.hypot(*goal) <= farthest:
            raise ConfigError(
                f"goal = ({goal[0]:g}, {goal[1]:g}): must lie {nearest:g} to {farthest:g} m from "
                "the start: give the env another goal_distance, run --goal-distance"
            )
        return goal


def _refuse_contradictions(options: Mapping[str, Any]) -> None:
    """ConfigError where two options name the world or the path of the episode."""
    given = [name for name in ("path", "world", "difficulty") if options.get(name) is not None]
    if len(given) > 1:
        raise ConfigError(
            f"reset options {' and '.join(map(repr, given))} contradict each other, as each "
            "chooses the surroundings: give one of them"
        )


def _check_point(value: Any) -> Goal:
    """Return a goal of two finite numbers; ConfigError for anything else."""
    try:
        x, y = (float(number) for number in value)
        sound = math.isfinite(x) and math.isfinite(y)
    except (TypeError, ValueError, OverflowError):
        sound = False
    if not sound:
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
    wanted, difficulty = options.get("world"), options.get("difficulty")
    if isinstance(wanted, World):
        return -1, check_world(wanted, worlds.radius)
    if wanted is None and difficulty is None:
        key = worlds.key(min(int(share * len(worlds)), len(worlds) - 1))
    elif wanted is None:
        ranks = worlds.ranks(difficulty)
        rank = ranks[min(int(share * len(ranks)), len(ranks) - 1)]
        key = worlds.key(int(worlds.by_difficulty[0][rank]))
    elif isinstance(wanted, str):
        key = wanted
    elif isinstance(wanted, int | np.integer) or (
        isinstance(wanted, float | np.floating) and float(wanted).is_integer()  # as in info
    ):
        key = int(wanted)
    else:
        raise ConfigError(
            f"world = {show_value(wanted)}: must be a number or a name of the env's worlds, or a "
            "World"
        )
    return key, worlds[key]


def draw_in_world(
    worlds: Pool, rng: np.random.Generator, options: Mapping[str, Any], *, follow: bool = False
) -> Assignment:
    """Draw a world, the start in it and the goal; takes WORLD_DRAWS numbers, and one for movers."""
    u = rng.random(WORLD_DRAWS).tolist()
    world_key, world = choose_world(worlds, u[0], options)
    key = float(rng.random()) if world.movers else 0.0
    ends = align_with_path(world) if follow else world
    x, y = point_in_disc(ends.start.x, ends.start.y, ends.start.radius, u[1], u[2])
    theta = ends.start.theta
    theta = (2.0 * u[3] - 1.0) * math.pi if theta is None else theta
    start: Pose = (x, y, theta)
    if options.get("goal") is not None:  # without the world's path, which leads elsewhere
        goal = _check_point(options["goal"])
        return Assignment(goal, world, world_key=world_key, start=start, key=key)
    goal_x, goal_y = point_in_disc(ends.goal.x, ends.goal.y, ends.goal.radius, u[4], u[5])
    goal = relative_point(x, y, math.cos(theta), math.sin(theta), goal_x, goal_y)
    path = path_from_start(ends) if follow else None
    return Assignment(goal, world, path, ends.length, world_key=world_key, start=start, key=key)


def assign_path(path: Any) -> Assignment:
    """Make an assignment of a path that a user gives as points (x, y) in the odometry frame [m].

    The robot starts at the origin of that frame, wherever the path begins.
    """
    world = replace(world_along(path), start=Region(0.0, 0.0, 0.0, 0.0), name="given")
    return Assignment((world.goal.x, world.goal.y), world, path_from_start(world), world.length)


def path_from_start(world: World) -> Floats:
    """A world's path in the frame of its start, (samples, 3): x [m], y [m], direction [rad]."""
    if world.path is None or world.start.theta is None:
        raise WorldError(f"{world.name or 'the world'}: has no path to follow")
    samples, start, theta = sample_path(world.path), world.start, world.start.theta
    cos, sin = math.cos(theta), math.sin(theta)
    points = (samples[:, :2] - (start.x, start.y)) @ np.array([[cos, -sin], [sin, cos]])
    seen: Floats = np.column_stack([points, samples[:, 2] - theta])
    seen.setflags(write=False)  # tasks are told it
    return seen


class ObservationCheck:
    """Checks a task's own numbers of observations; warns once where they leave their bounds."""

    def __init__(self, task: Task) -> None:
        self._task = task
        bounds = np.array(list(task.observation.values()), np.float64).reshape(-1, 2).T
        with np.errstate(over="ignore"):
            self._low, self._high = bounds.astype(np.float32)  # as in the space
        self._warns = True

    def check(self, numbers: Observation) -> None:
        """Check an observation.

        Warns (AcsarWarning) of the first number beyond its bounds.
        """
        if self._warns:
            if self._low.shape != numbers.shape:  # arrays of one shape are compared much faster
                self._low, self._high = (
                    np.broadcast_to(bound, numbers.shape).copy()
                    for bound in (self._low, self._high)
                )
            given = np.ascontiguousarray(numbers)
            if ((given >= self._low) & (given <= self._high)).all():
                return
        is_finite = np.isfinite(numbers)
        if not is_finite.all():
            values, robot = self._row_of_first(numbers, ~is_finite)
            wrong = {name: number for name, number in values.items() if not math.isfinite(number)}
            raise ConfigError(
                f"{task_name(self._task)}.observe returned {show_value(wrong)}{robot}: must be "
                f"finite numbers{method_place(self._task, 'observe')}"
            )
        if self._warns:
            self._warns = False
            self._warn(numbers)

    def _warn(self, numbers: Observation) -> None:
        """Warn of the first number that is beyond its bounds."""
        is_beyond = np.atleast_2d((numbers < self._low) | (numbers > self._high))
        values, robot = self._row_of_first(numbers, is_beyond)
        column = int(is_beyond[is_beyond.any(axis=1).argmax()].argmax())
        name, number = list(values.items())[column]
        low, high = self._task.observation[name]
        warnings.warn(
            f"{task_name(self._task)}.observe returned {name!r} = {number:g}{robot}: beyond its "
            f"bounds ({low:g}, {high:g}), and a policy gets it as it is: clip it, or declare wider "
            f"bounds in `observation`{method_place(self._task, 'observe')}",
            AcsarWarning,
            stacklevel=3,
        )

    def _row_of_first(self, numbers: Observation, wrong: Any) -> tuple[dict[str, float], str]:
        """The numbers, by name, of the first robot with a wrong one, and what names the robot."""
        robot = int(np.atleast_2d(wrong).any(axis=1).argmax())
        values = np.atleast_2d(numbers)[robot].tolist()
        whose = f" for robot {robot}" if numbers.ndim > 1 else ""
        return dict(zip(self._task.observation, values, strict=True)), whose


class RunningEpisode:
    """The running episode of a task: its assignment (world, start, goal) and its memory.

    Attributes: `task`, `assignment`, `memory`; `steps` so far; `state` and `outcome` of the last.

    Args:
        task: of the env.
        assignment: of the episode.
        check: of the task's observations, the same for all episodes of an env.
    """

    def __init__(
        self, task: Task, assignment: Assignment, check: ObservationCheck | None = None
    ) -> None:
        self.task, self.assignment = task, assignment
        self._check = ObservationCheck(task) if check is None else check
        self.memory = new_memory(task)
        self.steps = 0
        self.state = State()
        self.outcome = Outcome.GOING
        self._told = info_names(task)

    def begin(self, state: State) -> None:
        """Begin the episode with the state after the reset. ConfigError as for `step`."""
        self.state = state
        with translate_errors(ConfigError, lambda: task_name(self.task)):
            self.task.begin(state, self.memory)

    def step(self, state: State) -> tuple[float, Outcome]:
        """Return the reward and the outcome of the step that led to this state."""
        self.state = state
        with translate_errors(ConfigError, lambda: task_name(self.task)):
            self.outcome = ask_outcome(self.task, state, self.memory)
            return ask_reward(self.task, state, self.memory, self.outcome), self.outcome

    def observe(self, state: State) -> Observation:
        """Return the task's own part of the observation, (numbers,)."""
        name, size = task_name(self.task), len(self.task.observation)
        with translate_errors(ConfigError, lambda: name):
            given = self.task.observe(state, self.memory)
        try:
            numbers = np.array(given, np.float32)
        except (TypeError, ValueError) as error:
            raise ConfigError(
                f"{name}.observe returned {show_value(given)}: must be numbers"
                f"{method_place(self.task, 'observe')}"
            ) from error
        if numbers.shape != (size,):
            raise ConfigError(
                f"{name}.observe returned numbers of shape {numbers.shape}: must be ({size},)"
                f"{method_place(self.task, 'observe')}"
            )
        self._check.check(numbers)
        return numbers

    def shortest_path(self, pose: Pose) -> Floats | float | None:
        """Ask the task for the shortest way from a pose to success; see `Task.shortest_path`."""
        if not says_shortest_path(self.task):
            return None
        name = task_name(self.task)
        with translate_errors(ConfigError, lambda: name):
            way = self.task.shortest_path(self.state._replace(pose=pose), self.memory)
        if way is None:
            return None
        try:
            numbers = np.array(way, np.float64)
            places = numbers.reshape(-1, 2) if numbers.size == 0 else numbers
            sound = np.isfinite(places).all() and (
                places >= 0.0 if places.ndim == 0 else places.shape == (len(places), 2)
            )
        except (TypeError, ValueError):
            sound = False
        if not sound:
            raise ConfigError(
                f"{name}.shortest_path returned {show_value(way)}: must be places (x, y) [m], a "
                "length [m], or None"
            )
        return float(places) if places.ndim == 0 else places

    def info(self) -> Info:
        """Return what the task adds to info; the keys are the same at every step."""
        memory = vars(self.memory)
        return {name: float(memory[name]) for name in self._told} | self.assignment.info
