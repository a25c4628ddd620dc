"""Makes the bundle of a policy from its environment, and compares it with other environments.

What must match is what its numbers mean: names, ranges and scale of the observation, the layout of
its sensors, the action, and the policy rate. A robot may differ, because actions and observed
speeds are relative to its own limits. That is told where its limits, its footprint or its LiDAR
differ, or its physics lies outside of the ranges of the training.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Any

from acsar_gym.config import RobotConfig
from acsar_gym.config.footprint import outline_radius
from acsar_gym.config.robot import hash_calibration, hash_config
from acsar_gym.config.section import Section
from acsar_gym.envs.ids import full_id, strip_module
from acsar_gym.envs.robot_env import RobotEnv
from acsar_gym.errors import AcsarError, PolicyError, escape_unprintable, shorten_text
from acsar_gym.physics import Randomization
from acsar_gym.physics.model import turn_factor
from acsar_gym.recording.messages import to_plain_json
from acsar_gym.sensors import LIDAR, Sensor
from acsar_gym.tasks import Task
from acsar_gym.tasks.factory import task_name
from acsar_gym.tools.policies.bundle import (
    ActionLayout,
    Bundle,
    EnvSummary,
    ObservationLayout,
    PolicyRates,
    RobotSummary,
    SensorLayout,
    StateLayout,
    TrainingSummary,
    Value,
)
from acsar_gym.vector.env import RobotVectorEnv

AnyEnv = RobotEnv | RobotVectorEnv
Range = tuple[float, float]
RANGE_MARGIN = 0.01
"""Relative width by which a range of the training is widened."""
FLEET_NUMBERS = ("footprint_length", "footprint_width", "max_linear", "max_angular")
"""Of a policy that was trained on several robots, the file has the ranges of these numbers."""
RETRAIN_HINT = "train it again, or choose the robot of its training with --robot"
ARGUMENTS_HINT = "give the env the arguments that the policy was trained with"
TURN_FACTOR_SOURCE = (
    "body.turn_factor of the robot's file, measured by 'acsar-gym calibrate DEVICE turn'; without "
    "it 1 + (wheelbase / wheel_separation)^2"
)
MAX_QUOTED_CHARS = 100
"""Longest text from a file in a message [characters]."""


@dataclass(frozen=True, slots=True)
class RobotField:
    """A number of a robot: what a policy's file says of it, and what is checked before a drive."""

    name: str
    """Dotted name in the config, unless `read` is given."""
    read: Callable[[RobotConfig], Any] | None = None
    lidar: bool = False
    """Whether only policies that observe a LiDAR have it."""
    equal: bool = False
    """Whether it must be the same, as the observation is made with it."""
    apart: float | None = None
    """It is told where it differs by more [m]; None: it isn't told for that."""
    factor: str = ""
    """Parameter of the randomization that it is multiplied by; where the robot lies outside of the
    training's range, it is told."""
    inverse: bool = False
    """Whether it is divided by it instead."""
    replaced: str = ""
    """Parameter that replaces it."""
    added: tuple[str, ...] = ()
    """Parameters that are added to it."""
    least: bool = True
    """Whether less than in the training is worse, too."""
    most: bool = True
    """Whether more than in the training is worse."""
    source: str = ""
    """Where a robot's number comes from, if its name doesn't say that."""

    def value(self, config: RobotConfig) -> Value:
        """Read it from a robot."""
        read = self.read or attrgetter(self.name)
        value: Value = read(config)
        return value

    @property
    def varied(self) -> bool:
        """Whether a randomization changes it."""
        return bool(self.factor or self.replaced)


def _limits(axis: str) -> list[RobotField]:
    """The command limits of an axis."""
    names = ("min_acceleration", "max_deceleration", "max_velocity", "max_jerk")
    limits = [RobotField(f"{axis}_limits.{name}") for name in names]
    return [RobotField(f"{axis}_limits.max_acceleration", apart=0.0), *limits]


ROBOT_FIELDS = {
    one.name: one
    for one in (
        RobotField("max_linear", apart=0.0),
        RobotField("max_angular", apart=0.0),
        RobotField("max_wheel_speed"),
        *_limits("linear"),
        *_limits("angular"),
        RobotField("wheel_radius"),
        RobotField("wheel_separation"),
        RobotField("wheelbase"),
        # this and the turn factor decide together how far the robot turns
        RobotField("wheel_separation_multiplier", factor="turn_factor", inverse=True),
        RobotField("turn_factor", turn_factor, factor="turn_factor", source=TURN_FACTOR_SOURCE),
        RobotField("body.mass", factor="mass"),
        RobotField("body.friction", factor="friction"),
        RobotField("motor.gain", factor="motor_gain"),
        RobotField("motor.time_constant", factor="motor_lag"),
        RobotField("motor.deadband", replaced="deadband", added=("deadband_offset",), least=False),
        RobotField("motor.max_speed"),
        RobotField(
            "firmware.command_delay",
            replaced="command_delay",
            added=("latency", "delay_samples"),
            least=False,
        ),
        RobotField("feedback_rate", replaced="feedback_rate", most=False),
        RobotField("footprint.radius", lambda config: outline_radius(config.outline), apart=0.01),
        RobotField("lidar.rays", lidar=True, equal=True),
        RobotField("lidar.field_of_view", lidar=True, equal=True),
        RobotField("lidar.min_range", lidar=True, apart=0.01),
        RobotField("lidar.max_range", lidar=True, equal=True),
        RobotField("lidar.rate", lidar=True, apart=0.0),
        RobotField("lidar_x_offset", lidar=True, apart=0.01),
        RobotField("lidar_y_offset", lidar=True, apart=0.01),
    )
}
"""What a policy's file says of the robot of its training, and what `check_bundle` and
`robot_differences` check of another one."""
OUTLINE_NUMBERS: Mapping[str, Callable[[RobotConfig], float]] = {
    "footprint_length": lambda config: _extent(config, 0),
    "footprint_width": lambda config: _extent(config, 1),
    "footprint_radius": lambda config: outline_radius(config.outline),
}
"""Numbers of a robot's footprint [m], for ranges of robots."""


def describe_policy(
    env: AnyEnv,
    env_id: str,
    *,
    randomization: Randomization | None = None,
    training: TrainingSummary | None = None,
    metrics: Mapping[str, Mapping[str, float | None]] | None = None,
    state: Sequence[StateLayout] = (),
    width: int | None = None,
    robots: Mapping[str, Range] | None = None,
) -> Bundle:
    """Describe a policy that was trained in an environment."""
    config, spec, task = robot_config(env), env.spec, env.task
    options: Any = dataclasses.fields(task) if dataclasses.is_dataclass(task) else ()
    ranges, sensors = None, take_sensors(task, env.sensors, width)
    if robots is None and isinstance(env, RobotVectorEnv) and len(env.fleet) > 1:
        robots = {name: measure_range(env.fleet, name) for name in FLEET_NUMBERS}
    if randomization is not None:
        ranges = {name: tuple(getattr(randomization, name)) for name in randomization.names}
    try:
        return Bundle(
            env=EnvSummary(
                id=strip_module(full_id(env_id)),
                options={one.name: to_plain_json(getattr(task, one.name)) for one in options},
                worlds="" if env.pool is None else str(env.pool),
                max_episode_steps=None if spec is None else spec.max_episode_steps,
            ),
            observation=describe_observation(task, sensors),
            state=tuple(state),
            rates=PolicyRates(policy=env_policy_rate(env), control=config.control_rate),
            robot=RobotSummary(
                name=config.name,
                sha256=hash_config(config),
                calibration_sha256=hash_calibration(config),
                values=robot_values(config, sensors),
            ),
            robots=dict(robots or {}),
            randomization=ranges,
            training=training,
            metrics={
                occasion: {name: finite_or_none(value) for name, value in figures.items()}
                for occasion, figures in (metrics or {}).items()
            },
        )
    except AcsarError as error:
        raise PolicyError(f"the policy can't be described: {error}") from error


def take_sensors(task: Task, sensors: Sequence[Sensor], width: int | None) -> Sequence[Sensor]:
    """The sensors whose numbers a policy takes."""
    ends = list(itertools.accumulate((s.size for s in sensors), initial=len(task.observation)))
    if width is None:
        return sensors
    if width not in ends:
        raise PolicyError(
            f"the policy takes {width} numbers, the observation has {' or '.join(map(str, ends))}"
        )
    return sensors[: ends.index(width)]


def robot_config(env: AnyEnv) -> RobotConfig:
    """Return the config of an env's robot."""
    return env.robot.config if isinstance(env, RobotEnv) else env.config


def env_policy_rate(env: AnyEnv) -> float:
    """Return the policy steps per second of an env [Hz]."""
    return robot_config(env).control_rate / env.ticks_per_step


def describe_observation(task: Task, sensors: Iterable[Sensor]) -> ObservationLayout:
    """Describe the observation of a task and its sensors, before any normalization."""
    return ObservationLayout(
        names=tuple(task.observation),
        low=tuple(finite_or_none(low) for low, _ in task.observation.values()),
        high=tuple(finite_or_none(high) for _, high in task.observation.values()),
        sensors=tuple(
            SensorLayout(
                name=sensor.name,
                size=sensor.size,
                low=finite_or_none(sensor.bounds[0].min()),
                high=finite_or_none(sensor.bounds[1].max()),
                layout=sensor.layout,
            )
            for sensor in sensors
        ),
        scale=observation_scale(task),
    )


def observation_scale(task: Task) -> float | None:
    """Return the length that a task divides observed distances by [m]; None if it has none."""
    scale: float | None = getattr(task, "scale", getattr(task, "max_cross_track", None))
    return None if scale is None else float(scale)


def finite_or_none(value: float | None) -> float | None:
    """Return a number as JSON has it: None for infinity and NaN."""
    return None if value is None or not math.isfinite(value) else float(value)


def robot_values(config: RobotConfig, sensors: Iterable[Sensor]) -> dict[str, Value]:
    """Return a robot's values by name: `ROBOT_FIELDS`, those of a LiDAR where there is one."""
    sees = any(sensor.name == LIDAR for sensor in sensors)
    fields = (one for one in ROBOT_FIELDS.values() if sees or not one.lidar)
    return {one.name: one.value(config) for one in fields}


def check_bundle(
    bundle: Bundle,
    task: Task,
    sensors: Sequence[Sensor],
    config: RobotConfig | None = None,
    rate: float | None = None,
) -> None:
    """Check that a policy can drive in an env."""

    def require(equal: bool, name: str, said: str, wanted: str, where: str) -> None:
        if not equal:
            raise PolicyError(f"{name} is {_quote(said)} in the file and {wanted} {where}")

    task_text, file = task_name(task), bundle.observation
    sensors = sensors[: max(len(file.sensors), 1)]  # a policy may leave out the last ones
    own = describe_observation(task, sensors)
    here, in_this = f"in {task_text}: {RETRAIN_HINT}", f"in this {task_text}: {ARGUMENTS_HINT}"
    robot = {} if config is None else robot_values(config, sensors)
    for name in (one.name for one in ROBOT_FIELDS.values() if one.equal):
        if name in bundle.robot.values and name in robot and name not in bundle.robots:
            was, now = bundle.robot.values[name], robot[name]
            on_robot = f"on this robot: {RETRAIN_HINT}"
            require(equal_values(was, now), name, format_value(was), format_value(now), on_robot)
    parts = [[*seen.names, *(one.layout for one in seen.sensors)] for seen in (file, own)]
    for number, (said, wanted) in enumerate(itertools.zip_longest(*parts, fillvalue="nothing")):
        require(said == wanted, f"observation[{number}]", said, wanted, here)
    ends = [list(zip(seen.low, seen.high, strict=True)) for seen in (file, own)]
    for name, *spans in zip(file.names, *ends, strict=False):
        said, wanted = (" to ".join(map(format_value, span)) for span in spans)
        require(spans[0] == spans[1], f"observation.{_quote(name)}", said, wanted, here)
    was_sizes, sizes = (tuple(sensor.size for sensor in seen.sensors) for seen in (file, own))
    require(was_sizes == sizes, "observation.sensors", f"{was_sizes} numbers", str(sizes), here)
    said, wanted = format_value(file.scale), format_value(own.scale)
    require(equal_values(file.scale, own.scale), "observation.scale", said, wanted, in_this)
    said, wanted = (
        ", ".join(
            f"{name} {low:g} to {high:g} {of}"
            for name, low, high, of in zip(one.names, one.low, one.high, one.units, strict=False)
        )
        for one in (bundle.action, ActionLayout())
    )
    require(said == wanted, "action", said, wanted, here)
    if rate is not None:
        was = bundle.rates.policy
        require(equal_values(was, rate), "rates.policy", f"{was:g}", f"{rate:g}", in_this)


def _quote(text: str) -> str:
    """Return text from a file as one short line without control characters."""
    return escape_unprintable(shorten_text(text, MAX_QUOTED_CHARS))


def robot_number(config: RobotConfig, name: str) -> Value:
    """Return a number of a robot.

    Returns:
        The number, one for each wheel, or None where the robot has none.
    """
    if name in OUTLINE_NUMBERS:
        return OUTLINE_NUMBERS[name](config)
    if name in ROBOT_FIELDS:
        return ROBOT_FIELDS[name].value(config)
    value: Any = config
    for part in name.split("."):
        if not isinstance(value, Section) or part not in type(value).model_fields:
            raise PolicyError(
                f"robots {_quote(name)}: a robot has no such number: export the policy again with "
                "this acsar_gym"
            )
        value = getattr(value, part)
    numbers = value if isinstance(value, tuple) else (value,)
    if value is not None and not all(type(one) in (int, float) for one in numbers):
        raise PolicyError(f"robots {_quote(name)}: isn't a number: export the policy again")
    plain: Value = value
    return plain


def measure_range(fleet: Iterable[RobotConfig], name: str) -> Range:
    """Return the least and the largest value of some robots' numbers, see `robot_number`."""
    values = [one for config in fleet for one in as_numbers(robot_number(config, name))]
    return min(values), max(values)


def _extent(config: RobotConfig, axis: int) -> float:
    """Return the size of a footprint along x (0) or y (1) [m]."""
    ends = [corner[axis] for corner in config.outline]
    return max(ends) - min(ends)


def robots_outside(bundle: Bundle, config: RobotConfig) -> list[str]:
    """Say where a robot lies outside of those of the training, a line for each number."""
    lines = []
    for name, (low, high) in bundle.robots.items():
        value = robot_number(config, name)
        margin = 1e-6 * max(abs(low), abs(high))
        inside = [low - margin <= one <= high + margin for one in as_numbers(value)]
        if not (inside and all(inside)):
            span = f"{low:.4g} to {high:.4g}"
            lines.append(
                f"{_quote(name)} of this robot is {format_value(value)}, the policy is for {span}"
            )
    return lines


def robot_differences(bundle: Bundle, sensors: Sequence[Sensor], config: RobotConfig) -> list[str]:
    """Say how a robot differs from those of the training, one line for each field."""
    own = robot_values(config, sensors) | {"rates.control": config.control_rate}
    file = bundle.robot.values | {"rates.control": bundle.rates.control}
    lines = []
    for field in (*ROBOT_FIELDS.values(), RobotField("rates.control", apart=0.0)):
        name = field.name
        if field.apart is None or name not in file or name not in own:
            continue
        if bundle.robots and name != "rates.control":  # `robots_outside` tells about them
            continue
        if not equal_values(file[name], own[name], field.apart):
            was, now = format_value(file[name]), format_value(own[name])
            lines.append(f"{name} was {was} in the training and is {now} on this robot")
    ranges = None if bundle.robots else bundle.randomization
    for field in (one for one in ROBOT_FIELDS.values() if one.varied):
        values = as_numbers(own.get(field.name))
        trained = as_numbers(bundle.robot.values.get(field.name))
        if ranges is None or not (values and trained):
            continue
        low, high = trained_range(field, trained, ranges)
        margin = RANGE_MARGIN * max(abs(low), abs(high))
        under = field.least and min(values) < low - margin
        if under or (field.most and max(values) > high + margin):
            was = f"{low:.4g} to {high:.4g}" if high > low else f"{low:.4g}"
            now = f"{format_value(own[field.name])} on this robot"
            now += f" ({field.source})" if field.source else ""
            lines.append(f"{field.name} was {was} in the training and is {now}")
    return [f"{line}: it may drive worse than it was measured to" for line in lines]


def trained_range(
    field: RobotField, values: Sequence[float], ranges: Mapping[str, Sequence[float]]
) -> Range:
    """Return the least and the largest number that a value had in the training."""
    base = ranges.get(field.replaced, values)
    factors = ranges.get(field.factor, (1.0,))
    least, most = min(factors), max(factors)
    if field.inverse:
        least, most = 1.0 / most, 1.0 / least
    added = [ranges.get(name, (0.0,)) for name in field.added]
    return min(base) * least + sum(map(min, added)), max(base) * most + sum(map(max, added))


def as_numbers(value: Value) -> tuple[float, ...]:
    """Return a value as numbers: none, one, or one for each wheel."""
    if value is None:
        return ()
    return value if isinstance(value, tuple) else (value,)


def format_value(value: Value) -> str:
    """Format a value in a few digits."""
    return ", ".join(f"{one:.4g}" for one in as_numbers(value)) or "none"


def equal_values(one: Value, other: Value, length: float = 0.0) -> bool:
    """Return whether two values are the same but for rounding, or differ by `length` at most."""
    pairs = as_numbers(one), as_numbers(other)
    return len(pairs[0]) == len(pairs[1]) and all(
        math.isclose(a, b, rel_tol=1e-6, abs_tol=max(length, 1e-9))
        for a, b in zip(*pairs, strict=True)
    )


def bundle_rows(bundle: Bundle) -> Iterator[tuple[str, str]]:
    """Yield what a bundle says, as names and values."""
    env, robot, seen, action = bundle.env, bundle.robot, bundle.observation, bundle.action
    yield "environment", env.id
    yield "options", _format_mapping(env.options)
    yield "worlds", env.worlds or "none"
    yield "observation", ", ".join(map(_format_span, seen.names, seen.low, seen.high))
    yield "sensors", ", ".join(sensor.layout for sensor in seen.sensors) or "none"
    yield "distances", "not scaled" if seen.scale is None else f"divided by {seen.scale:g} m"
    said = "none"
    if seen.normalizer is not None:
        said = f"{seen.normalizer.kind}, part of the network"
        for name in ("mean", "std"):
            ends = getattr(seen.normalizer, name)
            said += "" if ends is None else f", {name} {ends[0]:.3g} to {ends[1]:.3g}"
        clip = seen.normalizer.clip
        said += "" if clip is None else f", clipped to {clip:g}"
    yield "normalizer", said
    names = [f"{name} (x {unit})" for name, unit in zip(action.names, action.units, strict=False)]
    yield "action", ", ".join(map(_format_span, names, action.low, action.high))
    yield "state", ", ".join(f"{one.input} {list(one.shape)}" for one in bundle.state) or "none"
    yield "rates", f"policy {bundle.rates.policy:g} Hz, control {bundle.rates.control:g} Hz"
    yield "robot", f"{robot.name or 'unnamed'}, config {robot.sha256[:16]}"
    yield "calibration", (robot.calibration_sha256 or "none")[:16]
    known = {name: format_value(one) for name, one in robot.values.items() if one is not None}
    yield "", _format_mapping(known)
    if bundle.robots:
        spans = {name: f"{low:.4g} to {high:.4g}" for name, (low, high) in bundle.robots.items()}
        yield "robots", _format_mapping(spans)
    ranges = bundle.randomization
    if ranges is None:
        yield "randomization", "not known"
    else:
        spans = {name: f"{min(one):.4g} to {max(one):.4g}" for name, one in ranges.items()}
        yield "randomization", _format_mapping(spans)
    training = {} if bundle.training is None else bundle.training.model_dump(mode="json")
    for name, value in training.items():
        if value not in (None, "", {}):
            yield name, _format_mapping(value) if isinstance(value, dict) else str(value)
    for name, figures in bundle.metrics.items():
        yield name, _format_mapping({key: format_value(value) for key, value in figures.items()})


def _format_span(name: str, low: float | None, high: float | None) -> str:
    ends = ("-inf" if low is None else f"{low:g}", "inf" if high is None else f"{high:g}")
    return f"{name} {ends[0]} to {ends[1]}"


def _format_mapping(values: Mapping[str, Any]) -> str:
    """Format a mapping on one line."""
    parts = [f"{k} {v if isinstance(v, str) else json.dumps(v)}" for k, v in values.items()]
    return ", ".join(parts) or "none"
