"""Make a task from what a user passes as `task`, and check it."""

from __future__ import annotations

import inspect
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError, TaskError, shown, suggestion, translate_errors
from acsar_gym.lidars.base import edges
from acsar_gym.reading.objects import imported, name_of
from acsar_gym.sensors import LIDAR, Sensor
from acsar_gym.tasks.base import (
    INFO,
    Memory,
    Outcome,
    State,
    Task,
    is_compiled,
    remembered,
    told,
)


def made(task: Any, options: Mapping[str, Any], others: Sequence[str] = ()) -> Task:
    """Make a task from what a user passes as `task`, and check its class; see `tried`, too.

    Args:
        task: a Task, a subclass of it, or "module:Class".
        options: fields of the class.
        others: names of the env's own options, for messages.

    Raises:
        ConfigError: for anything else, for options that the class doesn't know, and for methods
            that are missing.
    """
    if isinstance(task, str):
        task = imported("task", task)
    if isinstance(task, type) and issubclass(task, Task):
        task = _built(task, options, others)
    elif options:
        raise ConfigError(f"{_listed(options)}: no option of the env, and the task is made already")
    if not isinstance(task, Task):
        raise ConfigError(f"task = {shown(task)}: must be an acsar_gym.Task or a subclass of it")
    _check_class(task)
    return task


def importable(task: Any) -> Any:
    """Name a class of tasks in a way that can be stored in a spec.

    Args:
        task: a subclass of Task, or "module:Class".

    Returns:
        "module:Class" where other processes can import it so, otherwise the class.

    Raises:
        ConfigError: for anything else.
    """
    kind = imported("task", task) if isinstance(task, str) else task
    if not (isinstance(kind, type) and issubclass(kind, Task)):
        raise ConfigError(f"task = {shown(task)}: must be a subclass of acsar_gym.Task")
    return name_of(kind) or kind


def _built(task: type[Task], options: Mapping[str, Any], others: Sequence[str]) -> Task:
    """Call a class of tasks with its options; ConfigError for unknown ones."""
    known = list(inspect.signature(task).parameters)
    for name in options:
        if name not in known:
            raise ConfigError(
                f"unknown option {shown(name)} of {named(task)}"
                f"{suggestion(str(name)[:40], [*known, *others])}"
            )
    with translate_errors(TaskError, lambda: named(task)):
        try:
            return task(**{name: _tuples(value) for name, value in options.items()})
        except TypeError as error:
            raise ConfigError(f"{named(task)}: {error}") from None


def _tuples(value: Any) -> Any:
    """Lists of numbers as tuples: JSON, as in an env's spec, has no tuples."""
    numbers = isinstance(value, list) and all(isinstance(one, int | float) for one in value)
    return tuple(value) if numbers else value


def _listed(options: Mapping[str, Any]) -> str:
    """The names of options, separated by commas."""
    return ", ".join(str(name)[:40] for name in options)


def named(task: Task | type[Task]) -> str:
    """The id of a task, or the name of its class, for messages."""
    kind = task if isinstance(task, type) else type(task)
    own: str = vars(task).get("id") or vars(kind).get("id") or kind.__qualname__
    return own


def _check_class(task: Task) -> None:
    """Check methods, bounds and names of a task's class; ConfigError where they are wrong."""
    for name in ("reward", "observe"):
        if getattr(type(task), name) is getattr(Task, name):
            raise ConfigError(f"{named(task)}: has no method {name}()")
    _check_types(task)
    for name, bounds in task.observation.items():
        try:
            low, high = (float(bound) for bound in bounds)
        except (TypeError, ValueError):
            low, high = math.nan, math.nan
        if not low <= high:
            raise ConfigError(
                f"{named(task)}: observation {name!r}: {shown(bounds)}: must be (least, largest)"
            )
    for name in task.told or ():
        if name not in task.memory:
            raise ConfigError(f"{named(task)}: told {name!r}: isn't in memory")


def _check_types(task: Task) -> None:
    """Check that a task's attributes are mappings and tuples; ConfigError where they aren't."""
    for name, wanted in (("observation", Mapping), ("memory", Mapping), ("sensors", Sequence)):
        value = getattr(task, name)
        if not isinstance(value, wanted) or isinstance(value, str):
            kind = "mapping" if wanted is Mapping else "tuple"
            raise ConfigError(f"{named(task)}: {name} = {shown(value)}: must be a {kind}")
    if isinstance(task.told, str):
        raise ConfigError(f"{named(task)}: told = {task.told!r}: must be a tuple of names")


def tried(task: Task, config: RobotConfig, sensors: Sequence[Sensor]) -> None:
    """Call all methods of a task once with an example state, to find mistakes early.

    Args:
        task: to try.
        config: of the robot.
        sensors: that the robot has.

    Raises:
        ConfigError: where a method returns something of the wrong type or shape.
        TaskError: where a method raises an error.
    """
    with translate_errors(TaskError, lambda: named(task)):
        state, memory = _example(task, config, sensors), remembered(task)
        task.begin(state, memory)
        outcome = task.outcome(state, memory)
        if outcome not in tuple(Outcome):
            raise ConfigError(
                f"{named(task)}.outcome returned {shown(outcome)}: must be an Outcome"
            )
        reward = task.reward(state, memory, Outcome(outcome))
        if not isinstance(reward, float | int | np.floating | np.integer):
            raise ConfigError(f"{named(task)}.reward returned {shown(reward)}: must be a number")
        numbers = task.observe(state, memory)
        if np.shape(numbers) != (len(task.observation),):
            raise ConfigError(
                f"{named(task)}.observe returned numbers of shape {np.shape(numbers)}: must be "
                f"{len(task.observation)}, as `observation` has names"
            )
        _check_told(task, memory)
        if is_compiled(task) and not isinstance(numbers, tuple):
            raise ConfigError(
                f"{named(task)}.observe: must return a tuple where the task is compiled"
            )


def _check_told(task: Task, memory: Memory) -> None:
    """Check that what a task tells in info is numbers, and none of the env's own."""
    for name in told(task):
        value = vars(memory)[name]
        if not isinstance(value, float | int | np.floating | np.integer):
            raise ConfigError(
                f"{named(task)}: memory {name!r} = {shown(value)}: is told in info, so must be a "
                "number; list those that are to be told in `told`"
            )
        if name in INFO or name.startswith("drawn_"):
            raise ConfigError(f"{named(task)}: memory {name!r}: info has that already; rename it")


def _example(task: Task, config: RobotConfig, sensors: Sequence[Sensor]) -> State:
    """An example state: at rest, 1 m from the goal, all sensors at their upper bounds."""
    rays = sum(sensor.size for sensor in sensors if sensor.name == LIDAR)
    most = np.concatenate([np.zeros(0), *(sensor.bounds[1] for sensor in sensors)])
    path = np.column_stack([np.linspace(0.0, 1.0, 21), np.zeros((21, 2))])
    return State(
        ranges=np.full(rays, config.lidar.max_range),
        edges=edges(config)[:rays],
        sensed=np.where(np.isfinite(most), most, 0.0).astype(np.float32),
        time=0.1,
        path=path if task.follows else path[:0],
        length=1.0,
        max_twist=(config.max_linear, config.max_angular),
    )
