"""What a policy file says about itself: one JSON document in the metadata of its ONNX network.

`Bundle` is the document. It says what the policy observes and how its actions are meant, on which
robot and in which task it was trained, and how. `describe_policy` makes it from an env, and
`check_bundle` compares it with another one: names, ranges and scale of the observation, the layout
of its sensors, the action and the policy rate must match. A robot may differ, because actions and
observed speeds are relative to its own limits: `robot_differences` says where.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Annotated, Any, Literal, Self

from pydantic import Field, JsonValue, StringConstraints, model_validator

from acsar_gym import reading
from acsar_gym.config import RobotConfig
from acsar_gym.config.footprint import outline_radius
from acsar_gym.config.robot import hash_calibration, hash_config
from acsar_gym.config.section import Section
from acsar_gym.envs.ids import full_id, strip_module
from acsar_gym.envs.robot_env import RobotEnv
from acsar_gym.errors import AcsarError, ConfigError, PolicyError, escape_unprintable
from acsar_gym.physics import Randomization
from acsar_gym.physics.model import turn_factor
from acsar_gym.recording.messages import to_plain_json
from acsar_gym.sensors import LIDAR, Sensor
from acsar_gym.tasks import Task
from acsar_gym.tasks.factory import task_name
from acsar_gym.vector.env import RobotVectorEnv

BUNDLE_KEY = "acsar_gym.bundle"
"""Key of the metadata of an ONNX file that holds the bundle."""
MAX_BUNDLE_BYTES = 500_000
"""Largest bundle that is read."""
MAX_QUOTED_CHARS = 100
"""Longest text from a file in a message [characters]."""
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

AnyEnv = RobotEnv | RobotVectorEnv
Bound = float | None
"""One end of a range; None: no limit."""
Range = tuple[float, float]
Positive = Annotated[float, Field(gt=0.0)]
Count = Annotated[int, Field(ge=0)]
Size = Annotated[int, Field(gt=0, le=100_000)]
Value = Annotated[float | tuple[float, ...] | None, Field(union_mode="left_to_right")]


class EnvSummary(Section):
    """The environment that the policy was trained in."""

    section = "env"
    id: Annotated[str, StringConstraints(min_length=1, max_length=200, pattern="^[^:]*$")]
    """Id without a module, as in "module:id": Gymnasium would import one that the file chooses."""
    options: dict[str, JsonValue] = Field({})
    """Options of the task."""
    worlds: str = ""
    """The worlds of the training, such as "clutter 1000 to 1399 (train split)"; empty: none."""
    max_episode_steps: Count | None = None


class SensorLayout(Section):
    """The numbers that one sensor adds to an observation."""

    section = "observation.sensors"
    name: str
    size: Size
    low: Bound
    high: Bound
    layout: str
    """What the sensor says about its numbers, see `Sensor.layout`."""


class NormalizerSummary(Section):
    """The normalization of observations that the network begins with; it is part of the graph."""

    section = "observation.normalizer"
    kind: str
    """"running" for mean and standard deviation, otherwise the name of the module's class."""
    clip: Positive | None = None
    mean: Range | None = None
    """Least and largest mean that is subtracted."""
    std: Range | None = None
    """Least and largest standard deviation that is divided by."""


class ObservationLayout(Section):
    """The numbers of an observation: the task's own, then those of the sensors."""

    section = "observation"
    names: tuple[str, ...]
    low: tuple[Bound, ...]
    high: tuple[Bound, ...]
    sensors: tuple[SensorLayout, ...] = ()
    scale: Positive | None = None
    """Length that distances are divided by [m]; None: the task has none."""
    normalizer: NormalizerSummary | None = None
    """None: the network takes observations as they are."""

    @model_validator(mode="after")
    def _check_lengths(self) -> Self:
        """Check that every number of the task has a range."""
        if not len(self.names) == len(self.low) == len(self.high):
            raise ConfigError("observation: names, low and high must be of one length")
        return self

    @property
    def width(self) -> int:
        """How many numbers an observation has."""
        return len(self.names) + sum(sensor.size for sensor in self.sensors)


class ActionLayout(Section):
    """The numbers of an action: parts of the robot's own limits."""

    section = "action"
    names: tuple[str, ...] = ("linear", "angular")
    units: tuple[str, ...] = ("max_linear", "max_angular")
    """What 1.0 of each number is: these fields of the robot [m/s, rad/s]."""
    low: tuple[float, ...] = (-1.0, -1.0)
    high: tuple[float, ...] = (1.0, 1.0)

    def __str__(self) -> str:
        parts = zip(self.names, self.low, self.high, self.units, strict=False)
        return ", ".join(f"{name} {low:g} to {high:g} {unit}" for name, low, high, unit in parts)


class StateLayout(Section):
    """One state of a recurrent policy: an output that is the next decision's input."""

    section = "state"
    input: str
    output: str
    shape: Annotated[tuple[Size, ...], Field(min_length=1, max_length=4)]
    """Shape of both, float32, with a batch of one; all zeros at the start of an episode."""


class PolicyRates(Section):
    """How often the policy decides, and the driver sends a command [Hz]."""

    section = "rates"
    policy: Positive
    control: Positive


class RobotSummary(Section):
    """The robot of the training."""

    section = "robot"
    name: str = ""
    sha256: str
    """Of its whole config."""
    calibration_sha256: str | None = None
    """Of its measured intervals; None: nothing was measured."""
    values: dict[str, Value] = Field({})
    """Its limits, physics and LiDAR by dotted name, in SI units; see `ROBOT_FIELDS`."""


class TrainingSummary(Section):
    """How the policy was trained; whatever isn't known is missing."""

    section = "training"
    algorithm: str = ""
    hyperparameters: dict[str, JsonValue] = Field({})
    steps: Count | None = None
    """Env steps, of all robots together."""
    seed: Count | None = None
    command: str = ""
    versions: dict[str, str] = Field({})
    """Of the libraries, by name."""
    revision: str = ""
    """Revision of the source, as git names it."""
    seconds: Annotated[float, Field(ge=0.0)] | None = None
    """How long it took [s]."""
    finished: str = ""
    """When it ended, in UTC as ISO 8601 writes it."""


class Bundle(Section):
    """All that a policy file says about itself; see the module."""

    section = "bundle"
    version: Literal[1] = 1
    """Version of the format: this package reads and writes 1."""
    env: EnvSummary
    observation: ObservationLayout
    action: ActionLayout = ActionLayout()
    state: Annotated[tuple[StateLayout, ...], Field(max_length=16)] = ()
    """The states of a recurrent policy, in the order of the graph's inputs and outputs."""
    rates: PolicyRates
    robot: RobotSummary
    robots: dict[str, Range] = Field({})
    """Least and largest number of the robots that it was trained on, by name, see `robot_number`;
    empty: it was trained on `robot` alone."""
    randomization: dict[str, Annotated[tuple[float, ...], Field(min_length=1)]] | None = None
    """Ranges of the training by name, see `Randomization`; None: not known."""
    training: TrainingSummary | None = None
    metrics: dict[str, dict[str, float | None]] = Field({})
    """Figures by occasion, such as {"held_out": {"success_rate": 0.97, "episodes": 64}}."""

    def as_json(self) -> str:
        """Return the document."""
        return json.dumps(self.model_dump(mode="json"), allow_nan=False)


def parse_bundle(text: str) -> Bundle:
    """Parse a bundle from a file."""
    if len(text) > MAX_BUNDLE_BYTES:
        raise PolicyError(f"its bundle is larger than {MAX_BUNDLE_BYTES:,} bytes")
    try:
        return Bundle.model_validate(reading.parse_json(text))
    except ConfigError as error:
        raise PolicyError(
            f"its bundle is damaged, or of another version of acsar_gym: "
            f"{escape_unprintable(str(error), 300)}: export the policy again"
        ) from error


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
    """Parameter of the randomization that it is multiplied by, or with `inverse` divided by; where
    the robot lies outside of the training's range, it is told."""
    inverse: bool = False
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
    sensors = take_sensors(task, env.sensors, width)
    if robots is None and isinstance(env, RobotVectorEnv) and len(env.fleet) > 1:
        robots = {name: measure_range(env.fleet, name) for name in FLEET_NUMBERS}
    ranges = None
    if randomization is not None:
        ranges = {name: tuple(getattr(randomization, name)) for name in randomization.names}
    try:
        return Bundle(
            env=EnvSummary(
                id=strip_module(full_id(env_id)),
                options={field.name: to_plain_json(getattr(task, field.name)) for field in options},
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

    def require_value(name: str, value: Value, wanted: Value, where: str) -> None:
        equal = equal_values(value, wanted)
        require(equal, name, format_value(value), format_value(wanted), where)

    task_text, file = task_name(task), bundle.observation
    sensors = sensors[: max(len(file.sensors), 1)]  # a policy may leave out the last ones
    own = describe_observation(task, sensors)
    here, in_this = f"in {task_text}: {RETRAIN_HINT}", f"in this {task_text}: {ARGUMENTS_HINT}"
    robot = {} if config is None else robot_values(config, sensors)
    for name in (field.name for field in ROBOT_FIELDS.values() if field.equal):
        if name in bundle.robot.values and name in robot and name not in bundle.robots:
            on_robot = f"on this robot: {RETRAIN_HINT}"
            require_value(name, bundle.robot.values[name], robot[name], on_robot)
    parts = [[*seen.names, *(sensor.layout for sensor in seen.sensors)] for seen in (file, own)]
    for number, (said, wanted) in enumerate(itertools.zip_longest(*parts, fillvalue="nothing")):
        require(said == wanted, f"observation[{number}]", said, wanted, here)
    ends = [list(zip(seen.low, seen.high, strict=True)) for seen in (file, own)]
    for name, *spans in zip(file.names, *ends, strict=False):
        said, wanted = (" to ".join(map(format_value, span)) for span in spans)
        require(spans[0] == spans[1], f"observation.{_quote(name)}", said, wanted, here)
    sizes = [tuple(sensor.size for sensor in seen.sensors) for seen in (file, own)]
    said, wanted = map(str, sizes)
    require(said == wanted, "observation.sensors", f"{said} numbers", wanted, here)
    require_value("observation.scale", file.scale, own.scale, in_this)
    action, wanted = str(bundle.action), str(ActionLayout())
    require(action == wanted, "action", action, wanted, here)
    if rate is not None:
        require_value("rates.policy", bundle.rates.policy, rate, in_this)


def _quote(text: str) -> str:
    """Return text from a file as one short line without control characters."""
    return escape_unprintable(text, MAX_QUOTED_CHARS)


def robot_number(config: RobotConfig, name: str) -> Value:
    """Return a number of a robot: of its outline, or one of `ROBOT_FIELDS`."""
    if name in OUTLINE_NUMBERS:
        return OUTLINE_NUMBERS[name](config)
    if name not in ROBOT_FIELDS:
        raise PolicyError(
            f"robots {_quote(name)}: this acsar_gym compares no such number: export the policy "
            "again"
        )
    return ROBOT_FIELDS[name].value(config)


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
    fields = [RobotField("rates.control", apart=0.0)]
    if not bundle.robots:  # `robots_outside` tells about the others
        fields = [*ROBOT_FIELDS.values(), *fields]
    lines = []
    for field in (field for field in fields if field.name in file and field.name in own):
        before, now = file[field.name], own[field.name]
        if field.apart is not None and not equal_values(before, now, field.apart):
            lines.append(
                f"{field.name} was {format_value(before)} in the training and is "
                f"{format_value(now)} on this robot"
            )
        trained, values = as_numbers(before), as_numbers(now)
        varied = bundle.randomization is not None and (field.factor or field.replaced)
        if not (varied and trained and values):
            continue
        low, high = trained_range(field, trained, bundle.randomization or {})
        margin = RANGE_MARGIN * max(abs(low), abs(high))
        under = field.least and min(values) < low - margin
        if under or (field.most and max(values) > high + margin):
            span = f"{low:.4g} to {high:.4g}" if high > low else f"{low:.4g}"
            source = f" ({field.source})" if field.source else ""
            lines.append(
                f"{field.name} was {span} in the training and is {format_value(now)} on this "
                f"robot{source}"
            )
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
    normalizer = {} if seen.normalizer is None else seen.normalizer.model_dump(mode="json")
    yield "normalizer", _format_mapping(normalizer)
    yield "action", str(action)
    yield "state", ", ".join(f"{one.input} {list(one.shape)}" for one in bundle.state) or "none"
    yield "rates", f"policy {bundle.rates.policy:g} Hz, control {bundle.rates.control:g} Hz"
    yield "robot", f"{robot.name or 'unnamed'}, config {robot.sha256[:16]}"
    yield "calibration", (robot.calibration_sha256 or "none")[:16]
    values = {name: format_value(value) for name, value in robot.values.items()}
    yield "", _format_mapping({name: text for name, text in values.items() if text != "none"})
    for name, ranges in (("robots", bundle.robots), ("randomization", bundle.randomization)):
        spans = {key: f"{min(span):.4g} to {max(span):.4g}" for key, span in (ranges or {}).items()}
        yield name, "not known" if ranges is None else _format_mapping(spans)
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
