"""Make tasks from what users pass, and find mistakes in them before the first episode."""

from __future__ import annotations

import inspect
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError, show_value, suggest_name, translate_errors
from acsar_gym.reading import import_object, object_name
from acsar_gym.sensors import LIDAR, Sensor
from acsar_gym.sensors.lidar import footprint_edges
from acsar_gym.tasks.state import CROWD_INFO, INFO, OPTIONAL_INFO, State
from acsar_gym.tasks.task import Memory, Outcome, Task, info_names, is_compiled, new_memory

NUMBER = (float, int, np.floating, np.integer)
CLASS_ATTRIBUTES = ("compiled", "follows", "id", "memory", "observation", "told")
"""Attributes of a task that are no options."""
METHOD_ARGUMENTS = {
    "begin": ("state", "memory"),
    "outcome": ("state", "memory"),
    "reward": ("state", "memory", "outcome"),
    "observe": ("state", "memory"),
}
"""What the env calls a task's methods with."""


def make_task(task: Any, options: Mapping[str, Any], others: Sequence[str] = ()) -> Task:
    """Make a task from what a user passes, and check its class; `others`: the env's own options."""
    if isinstance(task, str):
        task = import_object("task", task)
    if isinstance(task, type) and issubclass(task, Task):
        names_of_task = list(inspect.signature(task).parameters)
        for name in options:
            if name not in names_of_task:
                raise ConfigError(
                    f"unknown option {show_value(name)} of {task_name(task)}"
                    f"{explain_option(task, str(name)[:40], [*names_of_task, *others])}"
                )
        with translate_errors(ConfigError, lambda: task_name(task)):
            try:
                task = task(**{name: _tupled(value) for name, value in options.items()})
            except TypeError as error:
                raise ConfigError(f"{task_name(task)}: {error}") from error
    elif options:
        names = ", ".join(str(name)[:40] for name in options)
        raise ConfigError(f"{names}: no option of the env, and the task is made already")
    if not isinstance(task, Task):
        raise ConfigError(
            f"task = {show_value(task)}: must be an acsar_gym.Task or a subclass of it"
        )
    _check_class(task)
    return task


def explain_option(task: type[Task], name: str, known: Sequence[str]) -> str:
    """End of the message for an option that a task's class doesn't take."""
    classes = [kind for kind in task.__mro__ if not kind.__module__.startswith("acsar_gym.")]
    is_declared = any(
        name in vars(kind) or name in inspect.get_annotations(kind) for kind in classes
    )
    value = getattr(task, name, None)
    if not is_declared or callable(value):
        return suggest_name(name, known)
    if name in CLASS_ATTRIBUTES:
        return f": every env of the class has the same; make a subclass{class_place(task)}"
    field = f"{name}: {'float' if value is None else type(value).__name__} = {value!r}"
    return (
        f": it is an attribute of the class, but no field: write @dataclass(frozen=True) above the "
        f"class, and {field[:80]} in it{class_place(task)}"
    )


def class_place(kind: type) -> str:
    """Where a user's class is, as " (file:line)" for messages; empty where nobody knows."""
    try:
        return f" ({inspect.getsourcefile(kind)}:{inspect.getsourcelines(kind)[1]})"
    except (OSError, TypeError):
        return ""


def method_place(task: Task, name: str) -> str:
    """Where a method of a task is, as " (file:line)" for messages."""
    code = getattr(inspect.unwrap(getattr(type(task), name)), "__code__", None)
    return "" if code is None else f" ({code.co_filename}:{code.co_firstlineno})"


def _tupled(value: Any) -> Any:
    """Lists of numbers as tuples: JSON, as in an env's spec, has no tuples."""
    numbers = isinstance(value, list) and all(isinstance(number, int | float) for number in value)
    return tuple(value) if numbers else value


def _check_class(task: Task) -> None:  # noqa: C901 - one check after the other
    """Raise ConfigError where methods, bounds, names or types of a task's class are wrong."""
    for name in ("reward", "observe"):
        if getattr(type(task), name) is getattr(Task, name):
            raise ConfigError(f"{task_name(task)}: has no method {name}(){class_place(type(task))}")
    for name, arguments in METHOD_ARGUMENTS.items():
        try:
            inspect.signature(getattr(task, name)).bind(*arguments)
        except TypeError as error:
            signature = f"{name}({', '.join(arguments)})"
            raise ConfigError(
                f"{task_name(task)}: must have {signature}, after self: {error}"
                f"{method_place(task, name)}"
            ) from error
    for name, wanted in (("observation", Mapping), ("memory", Mapping), ("sensors", Sequence)):
        value = getattr(task, name)
        if not isinstance(value, wanted) or isinstance(value, str):
            kind = "mapping" if wanted is Mapping else "tuple"
            raise ConfigError(f"{task_name(task)}: {name} = {show_value(value)}: must be a {kind}")
    if isinstance(task.told, str):
        raise ConfigError(f"{task_name(task)}: told = {task.told!r}: must be a tuple of names")
    for name in task.told or ():
        if name not in task.memory:
            raise ConfigError(f"{task_name(task)}: told {name!r}: isn't in memory")
    for name, bounds in task.observation.items():
        try:
            low, high = (float(bound) for bound in bounds)
        except (TypeError, ValueError):
            low, high = math.nan, math.nan
        if not low <= high:
            raise ConfigError(
                f"{task_name(task)}: observation {name!r}: {show_value(bounds)}: must be "
                "(least, largest)"
            )


def importable_task(task: Any) -> Any:
    """Name a class of tasks in a way that can be stored in a spec."""
    kind = import_object("task", task) if isinstance(task, str) else task
    if not (isinstance(kind, type) and issubclass(kind, Task)):
        raise ConfigError(f"task = {show_value(task)}: must be a subclass of acsar_gym.Task")
    return object_name(kind) or kind


def task_name(task: Task | type[Task]) -> str:
    """The id of a task, or the name of its class, for messages."""
    kind = task if isinstance(task, type) else type(task)
    own: str = vars(task).get("id") or vars(kind).get("id") or kind.__qualname__
    return own


def validate_task(task: Task, config: RobotConfig, sensors: Sequence[Sensor]) -> None:
    """Call all methods of a task once with an example state, to find mistakes early."""
    most = np.concatenate([np.zeros(0), *(sensor.bounds[1] for sensor in sensors)])
    path = np.column_stack([np.linspace(0.0, 1.0, 21), np.zeros((21, 2))])
    rays = sum(sensor.size for sensor in sensors if sensor.name == LIDAR)
    state = State(  # at rest, 1 m from the goal, all sensors at their upper bounds
        ranges=np.full(rays, config.lidar.max_range),
        edges=footprint_edges(config)[:rays],
        sensed=np.where(np.isfinite(most), most, 0.0).astype(np.float32),
        time=0.1,
        path=path if task.follows else path[:0],
        length=1.0,
        max_twist=(config.max_linear, config.max_angular),
    )
    name = task_name(task)
    with translate_errors(ConfigError, lambda: name):
        memory = new_memory(task)
        task.begin(state, memory)
        outcome = ask_outcome(task, state, memory)
        reward = task.reward(state, memory, outcome)
        numbers = task.observe(state, memory)
    if not isinstance(reward, NUMBER):
        raise ConfigError(
            f"{name}.reward returned {show_value(reward)}: must be a number"
            f"{method_place(task, 'reward')}"
        )
    if _shape_of(numbers) != (len(task.observation),):
        raise ConfigError(
            f"{name}.observe returned {_describe_shape(numbers)}: must be "
            f"{len(task.observation)}, as `observation` has names{method_place(task, 'observe')}"
        )
    if is_compiled(task) and not isinstance(numbers, tuple):
        raise ConfigError(
            f"{name}.observe: must return a tuple where the task is compiled"
            f"{method_place(task, 'observe')}"
        )
    for key in info_names(task):
        value = vars(memory)[key]
        if not isinstance(value, NUMBER):
            raise ConfigError(
                f"{name}: memory {key!r} = {show_value(value)}: is told in info, so must be a "
                "number; list those that are to be told in `told`"
            )
        if key in (*INFO, *CROWD_INFO, *OPTIONAL_INFO) or key.startswith("drawn_"):
            raise ConfigError(f"{name}: memory {key!r}: info has that already; rename it")


def _shape_of(numbers: Any) -> tuple[int, ...] | None:
    """Shape of what `observe` returned; None where it has none, as tuples in a tuple."""
    try:
        shape: tuple[int, ...] = np.shape(numbers)
    except Exception:  # noqa: BLE001 - of an object of the user's
        return None
    return shape


def _describe_shape(numbers: Any) -> str:
    shape = _shape_of(numbers)
    return show_value(numbers) if not shape else f"numbers of shape {shape}"


def ask_outcome(task: Task, state: State, memory: Memory) -> Outcome:
    """Ask a task for the outcome of a step; ConfigError where it is no Outcome.

    True and False are none: True would be a success.
    """
    outcome = task.outcome(state, memory)
    try:
        if not isinstance(outcome, bool | np.bool_):
            return Outcome(outcome)
    except (ValueError, TypeError):
        pass
    raise ConfigError(
        f"{task_name(task)}.outcome returned {show_value(outcome)}: must be an Outcome, such as "
        f"Outcome.SUCCESS{method_place(task, 'outcome')}"
    )


def ask_reward(task: Task, state: State, memory: Memory, outcome: Outcome) -> float:
    """Ask a task for the reward of a step; ConfigError where it is no finite number."""
    reward = task.reward(state, memory, outcome)
    try:
        number = float(reward)
    except (TypeError, ValueError):
        number = math.nan
    if not math.isfinite(number):
        raise ConfigError(
            f"{task_name(task)}.reward returned {show_value(reward)}: must be a finite number"
            f"{method_place(task, 'reward')}"
        )
    return number
