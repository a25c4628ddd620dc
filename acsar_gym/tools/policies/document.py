"""The document of a policy file: what its network observes, and on what it was trained.

`PolicyDocument` is one JSON text in the metadata of an ONNX network. `describe_policy` makes it,
`check_observation` refuses an env with another observation, and `list_differences` and
`list_outside` compare task and robot.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Annotated, Any, Literal

from pydantic import Field, JsonValue, StringConstraints

from acsar_gym import reading
from acsar_gym.config import RobotConfig
from acsar_gym.config.section import Section
from acsar_gym.envs.ids import full_id, strip_module
from acsar_gym.envs.robot_env import RobotEnv
from acsar_gym.errors import ConfigError, PolicyError, escape_unprintable
from acsar_gym.physics import Randomization
from acsar_gym.physics.model import turn_factor
from acsar_gym.physics.randomization import TABLE, Rule
from acsar_gym.recording.messages import to_plain_json
from acsar_gym.sensors import LIDAR, Sensor
from acsar_gym.tasks import Task
from acsar_gym.tasks.factory import task_name
from acsar_gym.vector.env import RobotVectorEnv

DOCUMENT_KEY = "acsar_gym.policy"
"""Key of the document among the metadata of an ONNX file, and attribute of a model of SB3."""
MAX_DOCUMENT_BYTES = 500_000
MAX_QUOTED_CHARS = 100
"""Longest text from a file in a message."""
MARGIN = 0.2
"""A robot differs if a number is outside of the range of the training by more than this share."""
ABSOLUTE_MARGIN = 0.01
"""The same for ranges around zero, in the unit of the number."""
LIMIT_MARGIN = 0.01
"""The share for size and speed on real wheels: what remains of rounding and of measuring."""
SIZE_AND_SPEED = ("footprint.length ", "footprint.width ", "max_linear ", "max_angular ")
"""Numbers for which a policy for other robots can hurt: it judges gaps and distances by them."""
UNRELATED = (
    *("baud_rate", "late_after", "connect_timeout", "reconnect_timeout", "feedback_timeout"),
    *("watchdog_timeout", "geofence", "wheels", "ros2", "encoder", "measured", "motor_fit_logs"),
    *("footprint", "lidar_yaw", "lidar_z_offset", "lidar.timeout", "body.length", "body.width"),
    *("body.height", "body.slip_speed", "firmware.loop_rate", "firmware.processing_time"),
    *("firmware.delay_samples", "firmware.command_timeout"),
)
"""Fields of a robot that don't change how it drives, and their sections."""
RANDOMIZED_FIELDS = {
    "latency": "firmware.command_delay",
    "delay_samples": "firmware.command_delay",
    "deadband": "motor.deadband",
    "feedback_rate": "firmware.feedback_rate",
    "track_width": "wheel_separation",
}
"""Fields that randomization varies, but that can't be measured."""
NOT_COMPARED = ("weights", "distance_scale", "goal_distance")
"""Options of tasks that don't change how a policy drives. `scale` contains what the last two change
in the observation."""
RETRAIN_HINT = "train it again, or choose the robot of its training with --robot"

AnyEnv = RobotEnv | RobotVectorEnv
Range = tuple[float, float]


class PolicyDocument(Section):
    """What a policy file contains besides its network."""

    section = "policy"
    version: Literal[2] = 2
    env: Annotated[str, StringConstraints(min_length=1, max_length=200, pattern="^[^:]*$")]
    """Id without a module, as in "module:id": Gymnasium would import one that the file chooses."""
    options: dict[str, JsonValue] = Field({})
    """Options of the task."""
    worlds: str = ""
    """Worlds of the training, such as "clutter 1000 to 1399 (train split)"."""
    observation: tuple[str, ...]
    """A line for each number of the task, such as "goal_distance 0 to 2", then the layouts of the
    sensors."""
    width: Annotated[int, Field(gt=0, le=100_000)]
    """How many numbers an observation has."""
    scale: Annotated[float, Field(gt=0.0)] | None = None
    """Length that distances are divided by [m]. None: the task has none."""
    rate: Annotated[float, Field(gt=0.0)]
    """Decisions per second [Hz]."""
    robot: dict[str, Range] = Field({})
    """Least and largest value of the training by dotted field, in SI units."""
    training: dict[str, JsonValue] = Field({})
    """How it was trained: recipe, steps, seed, command, versions, held-out score."""

    def as_json(self) -> str:
        """Return the document."""
        return json.dumps(self.model_dump(mode="json"), allow_nan=False)

    def rows(self) -> Iterator[tuple[str, str]]:
        """Yield names and values, for a table."""
        for name, value in self.model_dump(mode="json").items():
            items = value.items() if isinstance(value, dict) else [("", value)]
            yield from ((f"{name} {key}".rstrip(), _show(item)) for key, item in items)


def _show(value: Any) -> str:
    """Format a value, numbers and ranges in few digits."""
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list | tuple):
        is_range = len(value) == 2 and all(isinstance(end, float) for end in value)
        if is_range:
            return " to ".join(f"{end:.4g}" for end in sorted({*value}))
        return ", ".join(map(str, value))
    return value if isinstance(value, str) else json.dumps(value)


def _quote(value: Any) -> str:
    """Format a value of a file for a message."""
    return escape_unprintable(_show(value), MAX_QUOTED_CHARS)


def parse_document(metadata: Mapping[str, str]) -> PolicyDocument:
    """Parse the document among the metadata of a file.

    Raises:
        PolicyError: There is none, or it is damaged.
    """
    # A foreign network, or a file of an older version.
    text = metadata.get(DOCUMENT_KEY)
    if text is None:
        raise PolicyError(
            "contains no document of this version of acsar_gym, which says what it was trained "
            "for: export it again with 'acsar-gym policy MODEL.zip --out FILE --trust' or "
            "acsar_gym.tools.policies.save"
        )
    if len(text) > MAX_DOCUMENT_BYTES:
        raise PolicyError(f"its document is larger than {MAX_DOCUMENT_BYTES:,} bytes")
    try:
        return PolicyDocument.model_validate(reading.parse_json(text))
    except ConfigError as error:
        problem = escape_unprintable(str(error), 300)
        raise PolicyError(f"its document is damaged: {problem}: export it again") from error


def describe_policy(
    env: AnyEnv,
    env_id: str,
    *,
    width: int | None = None,
    randomization: Any = None,
    training: Mapping[str, Any] | None = None,
) -> PolicyDocument:
    """Describe a policy that was trained in an env.

    Args:
        env: The env or batch.
        env_id: Its id.
        width: Size of the policy's observation, if it leaves out the last sensors.
        randomization: As for the env.
        training: How it was trained.

    Raises:
        PolicyError: The width isn't one of whole sensors.
        ConfigError: A name is too long.
    """
    sensors = take_sensors(env.task, env.sensors, width)
    # A batch may have a robot of its own in each place.
    robots = set(env.fleet) if isinstance(env, RobotVectorEnv) else {env.robot.config}
    sees_lidar = any(sensor.name == LIDAR for sensor in sensors)

    # An id with a module would make a file import that module.
    return PolicyDocument(
        env=strip_module(full_id(env_id)),
        options=task_options(env.task),
        worlds="" if env.pool is None else str(env.pool),
        observation=tuple(describe_observation(env.task, sensors)),
        width=len(env.task.observation) + sum(sensor.size for sensor in sensors),
        scale=observation_scale(env.task),
        rate=env_policy_rate(env),
        robot=robot_ranges(robots, randomization, lidar=sees_lidar),
        training=to_plain_json(dict(training or {})),
    )


def take_sensors(task: Task, sensors: Sequence[Sensor], width: int | None) -> Sequence[Sensor]:
    """Return the sensors whose numbers a policy takes, which may leave out the last ones."""
    # A sensor is taken as a whole: a layout describes all of its numbers.
    ends = list(itertools.accumulate((s.size for s in sensors), initial=len(task.observation)))
    if width is None:
        return sensors
    if width not in ends:
        sizes = " or ".join(map(str, ends))
        raise PolicyError(f"the policy takes {width} numbers, the observation has {sizes}")
    return sensors[: ends.index(width)]


def task_options(task: Task) -> dict[str, Any]:
    """Return the options of a task by name, as JSON has them."""
    if not dataclasses.is_dataclass(task):
        return {}
    options: dict[str, Any] = to_plain_json(dataclasses.asdict(task))
    return options


def describe_observation(task: Task, sensors: Iterable[Sensor]) -> list[str]:
    """Return the lines of an observation: the task's numbers, and the layouts of sensors."""
    numbers = [f"{name} {low:g} to {high:g}" for name, (low, high) in task.observation.items()]
    return numbers + [sensor.layout for sensor in sensors]


def observation_scale(task: Task) -> float | None:
    """Return the length that a task divides observed distances by [m]. None if it has none."""
    scale = getattr(task, "scale", getattr(task, "max_cross_track", None))
    return None if scale is None else float(scale)


def env_policy_rate(env: AnyEnv) -> float:
    """Return the policy steps per second of an env [Hz]."""
    config = env.robot.config if isinstance(env, RobotEnv) else env.config
    return config.control_rate / env.ticks_per_step


# Robots


def robot_numbers(config: RobotConfig) -> dict[str, list[float]]:
    """Return the numbers of a robot that matter for driving, by dotted field.

    A field of four wheels has four numbers, and a limit of None has none.
    """
    numbers = {
        name: values
        for name, values in _flatten(config.model_dump())
        if not name.startswith(UNRELATED)
    }
    # Derived numbers: the fields that they are made of may be missing.
    for axis, name in enumerate(("footprint.length", "footprint.width")):
        ends = [corner[axis] for corner in config.outline]
        numbers[name] = [max(ends) - min(ends)]
    numbers["firmware.feedback_rate"] = [config.feedback_rate]
    numbers["body.turn_factor"] = [turn_factor(config)]
    return numbers


def _flatten(section: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, list[float]]]:
    """Yield the numbers of a config by dotted name."""
    for name, value in section.items():
        values = value if isinstance(value, tuple) else (value,)
        if isinstance(value, dict):
            yield from _flatten(value, f"{prefix}{name}.")
        elif values and all(type(number) in (int, float) for number in values):
            yield f"{prefix}{name}", [float(number) for number in values]


def robot_ranges(
    robots: Iterable[RobotConfig], randomization: Any = None, *, lidar: bool = True
) -> dict[str, Range]:
    """Return the range of every number of some robots, widened by their randomization.

    Args:
        robots: The robots.
        randomization: As for an env.
        lidar: Whether the policy observes the LiDAR's ranges.
    """
    trained: dict[str, list[float]] = {}
    for config in robots:
        numbers = robot_numbers(config)
        # What an episode can draw counts as seen in the training.
        for parameter, drawn in Randomization.of(randomization, config):
            row = TABLE[parameter]
            field = row.measured[0] if row.measured else RANDOMIZED_FIELDS.get(parameter)
            if drawn is not None and field in numbers:
                pairs = itertools.product(numbers[field], drawn)
                numbers[field] = [_change(row.rule, number, change) for number, change in pairs]
        for name, values in numbers.items():
            trained.setdefault(name, []).extend(values)

    return {
        name: (min(values), max(values))
        for name, values in trained.items()
        if lidar or not name.startswith("lidar")
    }


def _change(rule: Rule, number: float, drawn: float) -> float:
    """Return what a drawn number makes of a number of the robot."""
    if rule in (Rule.OFFSET, Rule.LATENCY):
        return max(number + drawn, 0.0)
    return drawn if rule in (Rule.VALUE, Rule.RATE) else number * drawn


# Comparison with an env


def check_observation(
    document: PolicyDocument, task: Task, sensors: Sequence[Sensor], rate: float | None = None
) -> None:
    """Raise PolicyError if an env gives another observation, or decides at another rate.

    A policy may leave out the last sensors, but not all of them.
    """
    # Texts are compared, so that every difference can be named.
    kept = sensors[: max(len(document.observation) - len(task.observation), 1)]
    lines = describe_observation(task, kept)
    pairs = itertools.zip_longest(document.observation, lines, fillvalue="nothing")
    facts: dict[str, tuple[Any, Any]] = {
        **{f"observation[{place}]": pair for place, pair in enumerate(pairs)},
        "width": (document.width, len(task.observation) + sum(sensor.size for sensor in kept)),
        "scale": (document.scale, observation_scale(task)),
        "rate": (document.rate, rate or document.rate),
    }

    for field, (trained, current) in facts.items():
        are_numbers = isinstance(trained, float) and isinstance(current, float)
        are_close = are_numbers and math.isclose(trained, current, rel_tol=1e-6)
        if trained != current and not are_close:
            raise PolicyError(
                f"{field} is {_quote(trained)} in the file and {_show(current)} in "
                f"{task_name(task)}: give the env the arguments of the training, or {RETRAIN_HINT}"
            )


def list_differences(document: PolicyDocument, task: Task, config: RobotConfig) -> list[str]:
    """Return how a task and a robot differ from those of the training, as lines for people."""
    # An option that only one of the two versions has can't be compared.
    options = task_options(task)
    lines = [
        f"{name} was {_quote(trained)} in the training and is {_show(options[name])} in this task"
        for name, trained in document.options.items()
        if name in options and name not in NOT_COMPARED and options[name] != trained
    ]
    if numbers := _list_outside(document, config, MARGIN, ABSOLUTE_MARGIN):
        lines.append(
            f"this robot differs from the training: {', '.join(numbers)}: it may drive worse than "
            "it was measured to"
        )
    return lines


def list_outside(document: PolicyDocument, config: RobotConfig) -> list[str]:
    """Return in which size or speed a robot is outside of the training."""
    lines = _list_outside(document, config, LIMIT_MARGIN, 0.0)
    return [line for line in lines if line.startswith(SIZE_AND_SPEED)]


def _list_outside(
    document: PolicyDocument, config: RobotConfig, relative: float, absolute: float
) -> list[str]:
    """Return the numbers of a robot that are outside of the training, such as "max_linear is 1"."""
    numbers = robot_numbers(config)
    lines = []
    for name, (low, high) in document.robot.items():
        # A share of zero would be no margin.
        margin = max(relative * max(abs(low), abs(high)), absolute)
        values = numbers.get(name, [])
        if any(not low - margin <= value <= high + margin for value in values):
            current = ", ".join(f"{value:.4g}" for value in values)
            lines.append(f"{name} is {current}, was {_show((low, high))}")
    return lines
