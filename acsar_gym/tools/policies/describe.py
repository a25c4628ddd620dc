"""Makes the bundle of a policy from its environment.

And compares a bundle with another environment.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from acsar_gym.config import RobotConfig
from acsar_gym.config.footprint import outline_radius
from acsar_gym.config.robot import hash_calibration, hash_config
from acsar_gym.envs.base import RobotEnv
from acsar_gym.envs.ids import full_id, strip_module
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
    NormalizerSummary,
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
_LIMITS = ("max_acceleration", "min_acceleration", "max_deceleration", "max_velocity", "max_jerk")


def _field(name: str) -> Callable[[RobotConfig], Any]:
    """Return a function that reads a dotted field of a robot."""

    def read(config: RobotConfig) -> Any:
        value: Any = config
        for part in name.split("."):
            value = getattr(value, part)
        return value

    return read


def _fields(*names: str) -> dict[str, Callable[[RobotConfig], Any]]:
    return {name: _field(name) for name in names}


ROBOT_FIELDS: Mapping[str, Callable[[RobotConfig], Any]] = {
    **_fields("max_linear", "max_angular", "max_wheel_speed"),
    **_fields(*(f"{axis}_limits.{name}" for axis in ("linear", "angular") for name in _LIMITS)),
    **_fields("wheel_radius", "wheel_separation", "wheelbase", "wheel_separation_multiplier"),
    "turn_factor": turn_factor,
    **_fields("body.mass", "body.friction"),
    **_fields("motor.gain", "motor.time_constant", "motor.deadband", "motor.max_speed"),
    **_fields("firmware.command_delay"),
    "feedback_rate": lambda c: c.feedback_rate,
    "footprint.radius": lambda c: outline_radius(c.outline),
}
"""What a bundle says of every robot: names, and how they are read from its config."""
LIDAR_FIELDS: Mapping[str, Callable[[RobotConfig], Any]] = {
    **_fields("lidar.rays", "lidar.field_of_view", "lidar.min_range", "lidar.max_range"),
    **_fields("lidar.rate", "lidar_x_offset", "lidar_y_offset"),
}
"""What it also says where the policy observes a LiDAR."""


def describe_policy(
    env: AnyEnv,
    env_id: str,
    *,
    randomization: Randomization | None = None,
    training: TrainingSummary | None = None,
    metrics: Mapping[str, Mapping[str, float | None]] | None = None,
    state: Sequence[StateLayout] = (),
) -> Bundle:
    """Describe a policy that was trained in an environment.

    Args:
        env: the environment, one robot or a batch, with the arguments of the training.
        env_id: its id, such as "acsar_gym/PointGoal-v0" or "point_goal".
        randomization: what the training randomized; None where that isn't known.
        training: how it was trained; None where that isn't known.
        metrics: figures of the policy by occasion; NaN becomes null.
        state: the states of a recurrent policy.

    Raises:
        PolicyError: something of it can't be written in a bundle.
    """
    config, rate = robot_config(env), env_policy_rate(env)
    seen = describe_observation(env.task, env.sensors)
    try:
        return Bundle(
            env=_env(env, env_id),
            observation=seen,
            action=ActionLayout(),
            state=tuple(state),
            rates=PolicyRates(policy=rate, control=config.control_rate),
            robot=describe_robot(config, env.sensors),
            randomization=None if randomization is None else randomization_ranges(randomization),
            training=training,
            metrics={name: _finite(figures) for name, figures in (metrics or {}).items()},
        )
    except AcsarError as error:
        raise PolicyError(f"the policy can't be described: {error}") from None


def robot_config(env: AnyEnv) -> RobotConfig:
    """Return the config of an env's robot."""
    return env.robot.config if isinstance(env, RobotEnv) else env.config


def env_policy_rate(env: AnyEnv) -> float:
    """Return the policy steps per second of an env [Hz]."""
    return robot_config(env).control_rate / env.ticks_per_step


def describe_observation(
    task: Task, sensors: Iterable[Sensor], normalizer: NormalizerSummary | None = None
) -> ObservationLayout:
    """Describe the observation of a task and its sensors."""
    ends = [(_bound(low), _bound(high)) for low, high in task.observation.values()]
    return ObservationLayout(
        names=tuple(task.observation),
        low=tuple(low for low, _ in ends),
        high=tuple(high for _, high in ends),
        sensors=tuple(_sensor(sensor) for sensor in sensors),
        scale=observation_scale(task),
        normalizer=normalizer,
    )


def observation_scale(task: Task) -> float | None:
    """Return the length that a task divides observed distances by [m]; None if it has none."""
    scale: float | None = getattr(task, "scale", getattr(task, "max_cross_track", None))
    return None if scale is None else float(scale)


def describe_robot(config: RobotConfig, sensors: Iterable[Sensor]) -> RobotSummary:
    """Describe a robot: its hashes, and the values that decide how it answers a policy."""
    return RobotSummary(
        name=config.name,
        sha256=hash_config(config),
        calibration_sha256=hash_calibration(config),
        values=robot_values(config, sensors),
    )


def robot_values(config: RobotConfig, sensors: Iterable[Sensor]) -> dict[str, Value]:
    """Return a robot's values by name: those of FIELDS, and with a LiDAR of LIDAR_FIELDS."""
    sees = any(sensor.name == LIDAR for sensor in sensors)
    readers = {**ROBOT_FIELDS, **(LIDAR_FIELDS if sees else {})}
    return {name: read(config) for name, read in readers.items()}


def randomization_ranges(randomization: Randomization) -> dict[str, tuple[float, ...]]:
    """Return the ranges of a randomization by name."""
    return {name: tuple(getattr(randomization, name)) for name in randomization.names}


def _env(env: AnyEnv, env_id: str) -> EnvSummary:
    """Describe the task and the worlds of an env."""
    spec, task = env.spec, env.task
    fields: Any = dataclasses.fields(task) if dataclasses.is_dataclass(task) else ()
    return EnvSummary(
        id=strip_module(full_id(env_id)),
        options={one.name: to_plain_json(getattr(task, one.name)) for one in fields},
        worlds="" if env.pool is None else str(env.pool),
        max_episode_steps=None if spec is None else spec.max_episode_steps,
    )


def _sensor(sensor: Sensor) -> SensorLayout:
    low, high = sensor.bounds
    return SensorLayout(
        name=sensor.name,
        size=sensor.size,
        low=_bound(low.min()),
        high=_bound(high.max()),
        layout=sensor.layout,
    )


def _bound(value: float) -> float | None:
    """Return one end of a range; None for infinity."""
    return float(value) if math.isfinite(value) else None


def _finite(figures: Mapping[str, float | None]) -> dict[str, float | None]:
    """Return figures with null for NaN and infinity."""
    return {
        name: None if value is None or not math.isfinite(value) else float(value)
        for name, value in figures.items()
    }


Range = tuple[float, float]
RANGE_MARGIN = 0.01
"""Relative width by which a range of the training is widened."""


@dataclass(frozen=True, slots=True)
class RandomizedValue:
    """How a randomization changes one value of a robot."""

    factor: str = ""
    """Parameter of the randomization that it is multiplied by."""
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


TURN_FACTOR_SOURCE = (
    "body.turn_factor of the robot's file, measured by 'acsar-gym calibrate DEVICE turn'; "
    "without it 1 + (wheelbase / wheel_separation)^2"
)
RANDOMIZED_VALUES: Mapping[str, RandomizedValue] = {
    "body.mass": RandomizedValue("mass"),
    "body.friction": RandomizedValue("friction"),
    "turn_factor": RandomizedValue("turn_factor", source=TURN_FACTOR_SOURCE),
    "wheel_separation_multiplier": RandomizedValue("turn_factor", inverse=True),
    "motor.gain": RandomizedValue("motor_gain"),
    "motor.time_constant": RandomizedValue("motor_lag"),
    "motor.deadband": RandomizedValue(replaced="deadband", added=("deadband_offset",), least=False),
    "firmware.command_delay": RandomizedValue(
        replaced="command_delay", added=("latency", "delay_samples"), least=False
    ),
    "feedback_rate": RandomizedValue(replaced="feedback_rate", most=False),
}
"""Values of a robot that are compared with the training's ranges. The multiplier and the turn
factor decide together how far the robot turns, so the multiplier has the range of that one."""


def find_out_of_range(bundle: Bundle, own: Mapping[str, Value]) -> Iterator[str]:
    """Yield a line for each value of a robot that lies outside of the training's ranges.

    Args:
        bundle: of the policy; without known ranges nothing is outside.
        own: values of the robot by name.
    """
    if bundle.randomization is None:
        return
    for name, varied in RANDOMIZED_VALUES.items():
        values, trained = as_numbers(own.get(name)), as_numbers(bundle.robot.values.get(name))
        if values and trained:
            low, high = trained_range(varied, trained, bundle.randomization)
            slack = RANGE_MARGIN * max(abs(low), abs(high))
            under = varied.least and min(values) < low - slack
            if under or (varied.most and max(values) > high + slack):
                was = f"{low:.4g} to {high:.4g}" if high > low else f"{low:.4g}"
                source = f" ({varied.source})" if varied.source else ""
                now = f"{format_value(own[name])} on this robot{source}"
                yield f"{name} was {was} in the training and is {now}"


def trained_range(
    varied: RandomizedValue, values: Sequence[float], ranges: Mapping[str, Sequence[float]]
) -> Range:
    """Return the least and the largest number that a value had in the training.

    Args:
        varied: how the randomization changes it.
        values: of the robot of the training: one, or one for each wheel.
        ranges: of the randomization, by name.
    """
    low, high = _ends(ranges.get(varied.replaced, values))
    least, most = _ends(ranges.get(varied.factor, (1.0,)))
    if varied.inverse:
        least, most = 1.0 / most, 1.0 / least
    low, high = low * least, high * most
    for name in varied.added:
        least, most = _ends(ranges.get(name, (0.0,)))
        low, high = low + least, high + most
    return low, high


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


def _ends(values: Sequence[float]) -> Range:
    return min(values), max(values)


LAYOUT_FIELDS = ("lidar.rays", "lidar.field_of_view", "lidar.max_range")
"""Values of a robot that an observation is made with."""
REPORTED_FIELDS = {
    "max_linear": 0.0,
    "max_angular": 0.0,
    "linear_limits.max_acceleration": 0.0,
    "angular_limits.max_acceleration": 0.0,
    "lidar.min_range": 0.01,
    "lidar.rate": 0.0,
    "lidar_x_offset": 0.01,
    "lidar_y_offset": 0.01,
    "footprint.radius": 0.01,
}
"""Values of a robot that are told where they differ, and by how much they may [m]."""
RETRAIN_HINT = "train it again, or choose the robot of its training with --robot"
MAX_QUOTED_CHARS = 100
"""Longest text from a file in a message [characters]."""
ARGUMENTS_HINT = "give the env the arguments that the policy was trained with"


def check_bundle(
    bundle: Bundle,
    task: Task,
    sensors: Sequence[Sensor],
    config: RobotConfig | None = None,
    rate: float | None = None,
) -> None:
    """Check that a policy can drive in an env.

    Args:
        bundle: of the policy.
        task: of the env.
        sensors: of the env, in the order of the observation.
        config: of the robot; None to skip what only it tells.
        rate: policy steps per second of the env [Hz]; None to skip it.

    Raises:
        PolicyError: names the first field that doesn't match; the message doesn't name the file.
    """
    here, file = task_name(task), bundle.robot.values
    own = {} if config is None else robot_values(config, sensors)
    for name in LAYOUT_FIELDS:
        if name in file and name in own and not equal_values(file[name], own[name]):
            raise _unlike(
                name,
                format_value(file[name]),
                format_value(own[name]),
                "on this robot",
                RETRAIN_HINT,
            )
    _check_observation(bundle, describe_observation(task, sensors), here)
    if _format_action(bundle.action) != _format_action(ActionLayout()):
        raise _unlike(
            "action",
            _format_action(bundle.action),
            _format_action(ActionLayout()),
            f"in {here}",
            RETRAIN_HINT,
        )
    if rate is not None and not equal_values(bundle.rates.policy, rate):
        raise _unlike(
            "rates.policy",
            f"{bundle.rates.policy:g}",
            f"{rate:g}",
            f"in this {here}",
            ARGUMENTS_HINT,
        )


def _check_observation(bundle: Bundle, own: ObservationLayout, here: str) -> None:
    """Compare the observation of a file with that of an env; PolicyError where they differ."""
    file = bundle.observation
    pairs = itertools.zip_longest(_parts(file), _parts(own), fillvalue="nothing")
    for number, (said, wanted) in enumerate(pairs):
        if said != wanted:
            raise _unlike(
                f"observation[{number}]", _quote(said), wanted, f"in {here}", RETRAIN_HINT
            )
    for number, name in enumerate(file.names):
        ends = [(seen.low[number], seen.high[number]) for seen in (file, own)]
        if ends[0] != ends[1]:
            raise _unlike(
                f"observation.{_quote(name)}",
                _span(ends[0]),
                _span(ends[1]),
                f"in {here}",
                RETRAIN_HINT,
            )
    sizes = [tuple(sensor.size for sensor in seen.sensors) for seen in (file, own)]
    if sizes[0] != sizes[1]:
        raise _unlike(
            "observation.sensors", f"{sizes[0]} numbers", f"{sizes[1]}", f"in {here}", RETRAIN_HINT
        )
    if not equal_values(file.scale, own.scale):
        told = [format_value(seen.scale) for seen in (file, own)]
        raise _unlike("observation.scale", told[0], told[1], f"in this {here}", ARGUMENTS_HINT)


def _parts(seen: ObservationLayout) -> list[str]:
    """Return the names of an observation's numbers, and the layouts of its sensors."""
    return [*seen.names, *(sensor.layout for sensor in seen.sensors)]


def robot_differences(bundle: Bundle, sensors: Sequence[Sensor], config: RobotConfig) -> list[str]:
    """Say how a robot differs from those of the training, one line for each field.

    Args:
        bundle: of the policy, which `check` has accepted.
        sensors: of the env.
        config: of the robot.
    """
    own = robot_values(config, sensors) | {"rates.control": config.control_rate}
    file = bundle.robot.values | {"rates.control": bundle.rates.control}
    lines = [
        f"{name} was {format_value(file[name])} in the training and is {format_value(own[name])} "
        "on this robot"
        for name, most in (*REPORTED_FIELDS.items(), ("rates.control", 0.0))
        if name in file and name in own and not equal_values(file[name], own[name], most)
    ]
    lines += find_out_of_range(bundle, own)
    return [f"{line}: it may drive worse than it was measured to" for line in lines]


def _unlike(name: str, file: str, own: str, where: str, fix: str) -> PolicyError:
    """Build the error for a field that doesn't match."""
    return PolicyError(f"{name} is {file} in the file and {own} {where}: {fix}")


def _quote(text: str) -> str:
    """Return text from a file as one short line without control characters."""
    return escape_unprintable(shorten_text(text, MAX_QUOTED_CHARS))


def _span(ends: tuple[Value, Value]) -> str:
    return " to ".join(format_value(end) for end in ends)


def _format_action(action: ActionLayout) -> str:
    """Format names, ranges and units of an action."""
    parts = zip(action.names, action.low, action.high, action.units, strict=False)
    return ", ".join(
        f"{_quote(name)} {low:g} to {high:g} {_quote(unit)}" for name, low, high, unit in parts
    )
