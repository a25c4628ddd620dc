"""Make tasks from what users pass, and check their classes."""

from __future__ import annotations

import inspect
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from acsar_gym.errors import ConfigError, TranslatedErrors, show_value
from acsar_gym.reading import import_object, object_name
from acsar_gym.tasks.options import check_finite, check_names
from acsar_gym.tasks.state import INFO_KEYS
from acsar_gym.tasks.task import Task, info_names, new_memory, observation_bounds


def make_task(task: Any, options: Mapping[str, Any], others: Iterable[str] = ()) -> Task:
    """Make a task from what a user passes, and check its class.

    Args:
        task: A task, its class, or "module:Class".
        options: Options of the task. Those of a class include `weights`.
        others: Names of the env's own options, for messages.

    Raises:
        ConfigError: There is no such task, it has no such option, or a value can't be used.
    """
    # Specs of environments name a class by its module.
    if isinstance(task, str):
        task = import_object("task", task)
    if isinstance(task, type) and issubclass(task, Task):
        task = _make_instance(task, options, others)
    elif options:
        names = ", ".join(str(name)[:40] for name in options)
        raise ConfigError(f"{names}: no option of the env, and the task is made already")
    if not isinstance(task, Task):
        raise ConfigError(
            f"task = {show_value(task)}: must be an acsar_gym.Task or a subclass of it"
        )
    _check_class(task)
    return task


def _make_instance(kind: type[Task], options: Mapping[str, Any], others: Iterable[str]) -> Task:
    """Call the class of a task with its options, and change its weights."""
    name = task_name(kind)
    # The parameters of the class are the task's options, as its docstring describes them.
    names = ["weights", *inspect.signature(kind).parameters]
    check_names(f"unknown option {{}} of {name}", options, names, ["link", "robot", *others])
    fields = {key: _tupled(value) for key, value in options.items() if key != "weights"}
    with TranslatedErrors(ConfigError, lambda: name):
        try:
            task = kind(**fields)
        except TypeError as error:
            raise ConfigError(f"{name}: {error}") from error

    # Tasks are frozen dataclasses, but this one isn't used yet.
    changes = options.get("weights")
    if changes is not None:
        object.__setattr__(task, "weights", _change_weights(task, changes))
    return task


def _tupled(value: Any) -> Any:
    """Convert a list of numbers to a tuple: JSON, as in an env's spec, has no tuples."""
    is_numbers = isinstance(value, list) and all(isinstance(n, int | float) for n in value)
    return tuple(value) if is_numbers else value


def _change_weights(task: Task, changes: Any) -> Any:
    """Return a task's weights with some of them replaced."""
    if not isinstance(changes, Mapping):
        raise ConfigError(f"weights = {show_value(changes)}: must be a mapping of names to numbers")
    names = getattr(task.weights, "_fields", ())
    check_names(f"unknown weight {{}} of {task_name(task)}", changes, names)
    numbers = {name: check_finite(f"weight {name}", value) for name, value in changes.items()}
    return task.weights._replace(**numbers)


def _check_class(task: Task) -> None:
    """Raise ConfigError if names or bounds that a task's class declares can't be used."""
    name = task_name(task)

    # What can't be converted fails here, before a robot is made.
    with TranslatedErrors(ConfigError, lambda: name):
        new_memory(task)
        are_pairs = all(np.shape(bounds) == (2,) for bounds in task.observation.values())
        low, high = observation_bounds(task)
    if not (are_pairs and (low <= high).all()):
        raise ConfigError(f"{name}: observation: the bounds of a name must be (least, largest)")
    for sensor in task.needs:
        if sensor not in task.sensors:
            raise ConfigError(f"{name}: sensors = {task.sensors!r}: must name {sensor!r}")
    check_names(f"{name}: told: no memory {{}}", info_names(task), task.memory)
    # A task's number must not replace the robot's under the same key.
    for key in info_names(task):
        if key in INFO_KEYS or key.startswith("drawn_"):
            raise ConfigError(f"{name}: memory {key!r}: info has that already. Rename it")


def importable_task(task: Any) -> Any:
    """Name a class of tasks in a way that can be stored in a spec."""
    kind = import_object("task", task) if isinstance(task, str) else task
    if not (isinstance(kind, type) and issubclass(kind, Task)):
        raise ConfigError(f"task = {show_value(task)}: must be a subclass of acsar_gym.Task")
    return object_name(kind) or kind


def task_name(task: Task | type[Task]) -> str:
    """The id of a task, or the name of its class, for messages."""
    kind = task if isinstance(task, type) else type(task)
    # An inherited id is that of another class, so `getattr` would name the wrong task.
    name: str = vars(task).get("id") or vars(kind).get("id") or kind.__qualname__
    return name
