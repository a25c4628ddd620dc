"""Domain randomization: which parameters of a robot every episode draws, and what they change.

The fields of `Randomization` are the table of parameters. Each has a row: the rule by which
a drawn number changes the robot's physics, the numbers of `Physics` that it changes, the default
range and the measured interval that replaces it. The single env and the batch both draw with
`draw_robot`, so that the same seed gives the same robot.

To add a parameter, add a field at the end of `Randomization`, so that existing seeds still draw the
same numbers. If the physics has no such number, add it to `config.physics.Physics` and use it.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Annotated, Any, NamedTuple, Self

import numpy as np
from numba.np.unsafe.ndarray import to_fixed_tuple
from numpy.typing import NDArray
from pydantic import Field, ValidationInfo, field_validator

from acsar_gym.config import Measured, RobotConfig
from acsar_gym.config.physics import Physics
from acsar_gym.config.section import Delay, Section, value_of_wheel
from acsar_gym.errors import ConfigError, show_value
from acsar_gym.jit import jit, loop
from acsar_gym.physics.model import compute_physics, loop_period, turn_factor, wire_loops

Range = tuple[float, float]
Ends = Range | None
Ranges = dict[str, tuple[float, ...]]
Floats = NDArray[np.float64]

WHEELS = "abcd"
LEAST_TURN = 1.001
"""Least turn factor of a range. A turn factor of 1 would be a tyre without sideways friction."""
MIN_FACTOR = 1e-6
MAX_FACTOR = 1e3
"""Smallest and largest factor that a range can have."""
LEVEL_WIDTHS = {1: 0.5, 2: 1.0, 3: 2.0}
"""Widths of the levels of randomization, relative to what `acsar-gym train` randomizes."""
MIN_LEVEL_FACTOR = 0.05
"""Least factor of a range that is widened for a level."""


class Rule(IntEnum):
    """How a drawn number changes a number of the physics. See `apply_rule`."""

    FACTOR = 0
    """It multiplies the configured number."""
    TURN = 1
    """It multiplies the robot's turn factor."""
    LAG = 2
    """It multiplies a motor's time constant."""
    VALUE = 3
    """It replaces the configured number."""
    OFFSET = 4
    """It is added to the configured number, and the sum is at least 0."""
    LATENCY = 5
    """It is a time [s], and is added as whole firmware loops."""
    RATE = 6
    """It is a rate [Hz], and its period in whole firmware loops replaces the configured period."""


FACTOR, TURN, LAG, VALUE, OFFSET, LATENCY_RULE, RATE = Rule
NEUTRAL = (1.0, 1.0, 1.0, math.nan, 0.0, 0.0, math.nan)
"""Numbers that change nothing, by rule."""


@dataclass(frozen=True)
class Parameter:
    """A row of the table: what a parameter changes, and which ranges it has."""

    rule: Rule
    changes: tuple[str, ...]
    """Numbers of `Physics`, those of the four wheels without _a to _d."""
    default: Ends = None
    """Range if nothing was measured: robots of the same parts differ by so much, and so do floors.
    Parameters without a default range aren't randomized unless they were measured."""
    measured: tuple[str, ...] = ()
    """Fields of the config whose measured interval the range follows, the first that has one."""
    bounds: Ends = (MIN_FACTOR, MAX_FACTOR)
    """Least and largest number of a range."""
    per_wheel: bool = False
    """Whether every wheel draws its own number."""


def parameter(rule: Rule, *changes: str, **options: Any) -> Any:
    """Return a field of the table, which is None by default. See `Parameter`."""
    row: Any = Parameter(rule, changes, **options)
    return Field(default=None, json_schema_extra={"row": row})


class DrawnRanges(NamedTuple):
    """What `draw_robot` draws the numbers of an episode from."""

    low: Floats
    """Least value of each number. It is the neutral number if the parameter doesn't vary."""
    high: Floats
    """Largest value of each number."""
    delays: Floats
    """Delays of which `delay_samples` draws one [s]. Its low and high are the shares 0 and 1."""


class Randomization(Section):
    """Ranges (low, high) from which every episode draws. A parameter that is None doesn't vary.

    The same on every simulated link and in a batch. Factors multiply the configured value. Other
    values replace it or are added to it. The info of an episode has what was drawn, as applied,
    under "drawn_" and the name.
    """

    section = "randomization"
    mass: Ends = parameter(FACTOR, "mass", "yaw_inertia", "grip", measured=("body.mass",))
    """Factor on the mass, and so on inertia and wheel loads."""
    friction: Ends = parameter(FACTOR, "grip", default=(0.7, 1.2), measured=("body.friction",))
    """Factor on the friction between tyre and ground."""
    motor_gain: Ends = parameter(
        FACTOR, "gain", default=(0.95, 1.05), measured=("motor.gain",), per_wheel=True
    )
    """Factor on each wheel's speed for its set point, four numbers."""
    motor_lag: Ends = parameter(
        LAG, "blend", default=(0.6, 1.5), measured=("motor.time_constant",), per_wheel=True
    )
    """Factor on each wheel's time constant, four numbers. No effect on motors without lag."""
    deadband: Ends = parameter(VALUE, "deadband", bounds=(0.0, 1e3))
    """Set points below this don't turn the wheel [rad/s]."""
    wheel_radius: Ends = parameter(
        FACTOR, "left_radius", "right_radius", default=(0.98, 1.02), measured=("wheel_radius",)
    )
    """Factor on the real wheel radius. Odometry still assumes the configured one."""
    latency: Ends = parameter(
        LATENCY_RULE, "latency_loops", default=(0.0, 0.02), bounds=(0.0, 10.0)
    )
    """Delay of commands and feedback on top of the wire's own [s], in whole firmware loops,
    shorter than an env step."""
    feedback_rate: Ends = parameter(RATE, "feedback_loops", bounds=(0.1, 1e4))
    """Feedback lines per second [Hz], rounded to whole firmware loops."""
    track_width: Ends = parameter(FACTOR, "half_track")
    """Factor on the real distance between left and right wheels. Odometry still assumes the
    configured one. Tyres that wear or bulge change where they touch the ground."""
    left_wheel_radius: Ends = parameter(
        FACTOR, "left_radius", measured=("left_wheel_radius_multiplier",)
    )
    """Factor on the real radius of the left wheels. Odometry still assumes the configured one."""
    right_wheel_radius: Ends = parameter(
        FACTOR, "right_radius", measured=("right_wheel_radius_multiplier",)
    )
    """Factor on the real radius of the right wheels."""
    turn_factor: Ends = parameter(
        TURN,
        "kappa",
        default=(0.9, 1.1),
        # A multiplier that is right for a robot is the factor by which it turns slower.
        measured=("body.turn_factor", "wheel_separation_multiplier"),
    )
    """Factor on the robot's turn factor (see `body.turn_factor`), which depends on the ground. No
    effect in MuJoCo, whose contacts decide by themselves how a robot turns."""
    command_delay: Ends = parameter(
        VALUE, "command_delay", measured=("firmware.command_delay",), bounds=(0.0, 1.0)
    )
    """Time from the last byte of a command to its effect, after the processing time [s]."""
    delay_samples: Annotated[tuple[Delay, ...], Field(min_length=1)] | None = parameter(
        OFFSET, "command_delay", bounds=None
    )
    """Delays of commands on top of `command_delay` [s]. Each episode draws one of them."""
    deadband_offset: Ends = parameter(
        OFFSET, "deadband", measured=("motor.deadband",), bounds=(-1e3, 1e3), per_wheel=True
    )
    """Four numbers, added to the wheels' deadbands, which stay at least 0 [rad/s]."""
    lidar_rate: Ends = parameter(VALUE, "scan_rate", bounds=(0.1, 1e4))
    """Revolutions of the LiDAR per second [Hz]."""
    lidar_noise: Ends = parameter(VALUE, "range_noise", bounds=(0.0, 1e3))
    """Standard deviation of the LiDAR's ranges [m]."""
    lidar_bias: Ends = parameter(VALUE, "range_bias", bounds=(-1e3, 1e3))
    """Added to all of the LiDAR's ranges [m]."""
    lidar_dropouts: Ends = parameter(VALUE, "range_dropouts", bounds=(0.0, 1.0))
    """Share of the LiDAR's measurements that fail."""
    lidar_outliers: Ends = parameter(VALUE, "range_outliers", bounds=(0.0, 1.0))
    """Share of the LiDAR's measurements at an edge that lie between its two sides."""

    @field_validator("*")
    @classmethod
    def _check_bounds(cls, ends: Ends, info: ValidationInfo) -> Ends:
        bounds = TABLE[info.field_name or ""].bounds
        if ends and bounds and not bounds[0] <= ends[0] <= ends[1] <= bounds[1]:
            raise ValueError(
                f"must be (low, high) with {bounds[0]:g} <= low <= high <= {bounds[1]:g}"
            )
        return ends

    @classmethod
    def of(
        cls,
        ranges: Mapping[str, tuple[float, ...]] | Self | bool | None,
        config: RobotConfig | None = None,
    ) -> Randomization:
        """Return a Randomization from a mapping of names to ranges.

        Args:
            ranges: A mapping, a Randomization, True for what `acsar-gym train` randomizes
                (`measured`), or None or False for nothing.
            config: Robot configuration, for True.

        Raises:
            ConfigError: A name is unknown, or a range is malformed.
        """
        # Users pass what is easiest: all of these forms are in specs and on the command line.
        if isinstance(ranges, Randomization):
            return ranges
        if ranges is True and config is not None:
            return cls.measured(config)
        if ranges is None or ranges is False:
            return cls()
        if not isinstance(ranges, Mapping):
            raise ConfigError(
                f"randomization = {show_value(ranges)}: must be a mapping of names to (low, high), "
                'such as {"friction": (0.7, 1.2)}, or True for what acsar-gym train randomizes'
            )
        return cls.model_validate(dict(ranges))

    @classmethod
    def measured(cls, config: RobotConfig) -> Randomization:
        """Return the ranges of a robot's measurements, and default ranges for the rest.

        Measured delays (`firmware.delay_samples`, or the interval of `firmware.command_delay`)
        replace the default latency.

        Args:
            config: Robot configuration, with the intervals in its field `measured`.
        """
        return cls.of(choose_ranges(config))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters that vary."""
        return tuple(name for name, value in self if value is not None)

    def ranges(self, config: RobotConfig, step: float) -> DrawnRanges:
        """Return the range of every number that an episode draws.

        Args:
            config: Robot configuration.
            step: Duration of an env step [s].

        Raises:
            ConfigError: The latency is as long as a step, the wire or `feedback_timeout` doesn't
                allow the feedback rate, or the robot would turn as fast as the formula says.
        """
        self._check_robot(config, step)
        low = np.array(NEUTRAL_NUMBERS)
        high = low.copy()
        for name in self.names:
            for wheel, place in enumerate(PLACES[name]):
                if TABLE[name].rule is LAG and not config.motor.of_wheel(wheel).time_constant:
                    continue  # a motor without lag draws nothing
                # A delay is drawn as a place in its list, a share of the list's length.
                ends = (0.0, 1.0) if place == DELAY else getattr(self, name)
                low[place], high[place] = ends
        return DrawnRanges(low, high, np.array(self.delay_samples or (0.0,)))

    def _check_robot(self, config: RobotConfig, step: float) -> None:
        dt = loop_period(config)
        # The config itself refuses rates that the wire or the time-out doesn't allow.
        for rate in self.feedback_rate or ():
            applied = 1.0 / (loops_between(rate, dt) * dt)
            try:
                config.with_(firmware={"feedback_rate": applied})
            except ConfigError as error:
                raise ConfigError(
                    f"randomization.feedback_rate = {self.feedback_rate}: {error}"
                ) from error

        if self.turn_factor:
            # A factor of 1 is a tyre without sideways friction, see LEAST_TURN.
            slowest = self.turn_factor[0] * turn_factor(config)
            if slowest <= 1.0:
                raise ConfigError(
                    f"randomization.turn_factor = {self.turn_factor}: makes this robot's turn "
                    f"factor {slowest:g}: must stay above 1"
                )

        if self.latency:
            # The wire's own delay counts, because the latency is added to it.
            longest = wire_loops(config) * dt + self.latency[1]
            if longest > step - dt / 2.0:
                raise ConfigError(
                    f"randomization.latency = {self.latency}: on this wire a line takes up to "
                    f"{longest:g} s; must be shorter than a step of the policy ({step:g} s); a "
                    "lower policy_rate makes it longer"
                )

    def longest_delay(self, config: RobotConfig) -> float:
        """Return the longest `command_delay` of the physics that an episode can have [s]."""
        command_delay = self.command_delay or (config.firmware.command_delay,)
        return command_delay[-1] + max(self.delay_samples or (0.0,))


_FIELDS: Any = Randomization.model_fields
TABLE: dict[str, Parameter] = {
    name: field.json_schema_extra["row"] for name, field in _FIELDS.items()
}


ORDER = [
    name
    for per_wheel, group in itertools.groupby(TABLE, lambda name: TABLE[name].per_wheel)
    for name in [*group] * (len(WHEELS) if per_wheel else 1)
]
"""Parameters in the order in which numbers are drawn, those of wheels wheel by wheel."""
PLACES = {name: [k for k, drawn in enumerate(ORDER) if drawn == name] for name in TABLE}
"""Places of a parameter's numbers among those that are drawn: one, or four in wheel order."""
NEUTRAL_NUMBERS = [NEUTRAL[TABLE[name].rule] for name in ORDER]
CHANGES = np.array(
    [
        (place, number, row.rule)
        for name, row in TABLE.items()
        for stem in row.changes
        for place, number in zip(
            itertools.cycle(PLACES[name]),
            [n for n, field in enumerate(Physics._fields) if stem in (field, field[:-2])],
            strict=False,
        )
    ]
).T
"""(3, changes): place of a drawn number, that of a number of the physics that it changes, and the
rule."""
PHYSICS_SIZE = len(Physics._fields)
LATENCY, FEEDBACK_RATE, DELAY = (
    PLACES[name][0] for name in ("latency", "feedback_rate", "delay_samples")
)
HALF_WHEELBASE, HALF_TRACK = map(Physics._fields.index, ("half_wheelbase", "half_track"))


# Ranges from measurements


def measured_ranges(config: RobotConfig) -> Ranges:
    """Return the parameters that follow from a robot's measurements, with their ranges.

    A measured interval becomes the range of its parameter. Factors are relative to the configured
    value. If wheels have their own intervals, the range contains all of them, and the default range
    for wheels without an interval.
    """
    ranges: Ranges = {}
    for name, row in TABLE.items():
        # The first field that has an interval decides, such as a turn factor before a multiplier.
        candidates = (_list_ends(config, row, path) for path in row.measured)
        ends = next(filter(None, candidates), None)
        if ends:
            ranges[name] = (min(ends), max(ends))
    if config.firmware.delay_samples:
        ranges["delay_samples"] = config.firmware.delay_samples
    return ranges


def _list_ends(config: RobotConfig, row: Parameter, path: str) -> list[float]:
    """List the ends of the ranges of all wheels or of the robot, if it was measured."""
    value: Any = functools.reduce(getattr, path.split("."), config)
    value = turn_factor(config) if row.rule is TURN else value
    # An interval may be of all wheels, or of each wheel under its letter.
    common = config.measured.get(path)
    wheels = WHEELS if row.per_wheel else WHEELS[:1]
    intervals = [config.measured.get(f"{path}.{wheel}", common) for wheel in wheels]
    ends: list[float] = []
    for wheel, interval in enumerate(intervals if any(intervals) else ()):
        number = value_of_wheel(value, wheel)
        # A motor without lag has nothing that a factor could change.
        if number > 0.0 or row.rule is not LAG:
            ends += _follow(interval, row.rule, number) if interval else row.default or ()
    return ends


def _follow(interval: Measured, rule: Rule, value: float) -> list[float]:
    """List the ends of a parameter's range for an interval of what was configured as `value`."""
    ends = [interval.low, interval.high]
    if rule is OFFSET:
        return [end - value for end in ends]
    if rule is TURN:
        return [max(end, LEAST_TURN) / value for end in ends]
    if rule is VALUE:
        return [max(end, 0.0) for end in ends]
    return [min(max(end / value, MIN_FACTOR), MAX_FACTOR) for end in ends]


def choose_ranges(config: RobotConfig) -> Ranges:
    """Return the measured ranges of a robot, and the default ranges of what wasn't measured."""
    measured = measured_ranges(config)
    factor = turn_factor(config)
    ranges: Ranges = {name: row.default for name, row in TABLE.items() if row.default}
    low, high = ranges["turn_factor"]
    ranges["turn_factor"] = (max(low, (1.0 + factor) / 2.0 / factor), high)  # stays above 1
    # A measured delay contains the latency that the default range stands for.
    if "command_delay" in measured or "delay_samples" in measured:
        del ranges["latency"]
    return ranges | measured


def describe_ranges(config: RobotConfig) -> str:
    """Describe which ranges of a robot were measured, in an empty text if none was."""
    measured = measured_ranges(config)
    if not measured:
        return ""
    texts = [
        f"delay_samples ({len(ends)} delays up to {max(ends):.3g} s)"
        if name == "delay_samples"
        else f"{name} {ends[0]:.3g} to {ends[1]:.3g}"
        for name, ends in measured.items()
    ]
    # What wasn't measured is named, because a policy may depend on it.
    defaults = [name for name in choose_ranges(config) if name not in measured]
    return f"randomized as measured: {', '.join(texts)}; by default widths: {', '.join(defaults)}"


def randomization_level(config: RobotConfig, number: int) -> Randomization:
    """Return the randomization of a level: half, all, or twice of what a robot is trained with.

    Measured delays (`command_delay`, `delay_samples`) are the same on all levels.
    """
    if number not in LEVEL_WIDTHS:
        raise ConfigError(f"randomization level {show_value(number)}: must be 1, 2 or 3")
    scale = LEVEL_WIDTHS[number]
    ranges = choose_ranges(config)
    for name, ends in ranges.items():
        # Ranges widen around the number that changes nothing. Values without one stay.
        neutral = NEUTRAL[TABLE[name].rule]
        if name != "delay_samples" and not math.isnan(neutral):
            low, high = (neutral + scale * (end - neutral) for end in ends)
            ranges[name] = (max(low, MIN_LEVEL_FACTOR) if neutral else low, high)
    # Twice the width may reach below a turn factor of 1, which no robot has.
    low, high = ranges["turn_factor"]
    ranges["turn_factor"] = (max(low, LEAST_TURN / turn_factor(config)), high)
    return Randomization.of(ranges)


# Drawing


@jit
def loops_between(rate: float, dt: float) -> float:
    """Return whole firmware loops between lines at a rate [Hz], at least one, or NaN for NaN."""
    loops: float = np.rint(1.0 / (rate * dt))
    return 1.0 if loops < 1.0 else loops


@jit
def apply_rule(rule: int, configured: float, drawn: float, ratio: float, dt: float) -> float:
    """Return a number of the physics after a drawn number has changed it.

    Args:
        rule: A `Rule`.
        configured: Number of the physics.
        drawn: Number that was drawn. A neutral number changes nothing.
        ratio: Squared ratio of wheelbase and track, by which `kappa` follows from the turn factor.
        dt: Period of the firmware loop [s].
    """
    number = configured

    if rule == FACTOR:
        number = configured * drawn
    elif rule == TURN and drawn != 1.0:
        # The turn factor is 1 + kappa * ratio, see `physics.model`.
        number = ((1.0 + configured * ratio) * drawn - 1.0) / ratio
    elif rule == LAG and drawn != 1.0 and configured < 1.0:
        # The blend is 1 - exp(-dt / lag), so its logarithm holds the lag.
        number = 1.0 - math.exp(math.log(1.0 - configured) / drawn)
    elif rule == VALUE and not np.isnan(drawn):
        number = drawn
    elif rule == OFFSET:
        number = max(configured + drawn, 0.0)
    elif rule == LATENCY_RULE:
        number = configured + np.rint(drawn / dt)
    elif rule == RATE and not np.isnan(drawn):
        number = loops_between(drawn, dt)
    return number


@loop
def draw_robot(
    nominal: Floats, low: Floats, high: Floats, delays: Floats, samples: Floats, dt: float
) -> tuple[Physics, Floats]:
    """Draw a robot's physics for one episode.

    Args:
        nominal: Numbers of the configured `Physics`.
        low: Least value of each drawn number. See `DrawnRanges`.
        high: Largest value of each drawn number.
        delays: Delays of which one is drawn [s].
        samples: Random numbers from 0 to 1, one for each drawn number.
        dt: Period of the firmware loop [s].

    Returns:
        The physics, and the numbers that were drawn, as applied.
    """
    # Samples of parameters that don't vary are zero and unused.
    drawn = low.copy()
    for k in range(len(drawn)):
        if high[k] > low[k]:
            drawn[k] = low[k] + (high[k] - low[k]) * samples[k]

    # The info of an episode reports what is applied: whole firmware loops, and a delay of the list.
    drawn[LATENCY] = np.rint(drawn[LATENCY] / dt) * dt
    drawn[FEEDBACK_RATE] = 1.0 / (loops_between(drawn[FEEDBACK_RATE], dt) * dt)
    drawn[DELAY] = delays[min(int(drawn[DELAY] * len(delays)), len(delays) - 1)]

    # In the table's order, because several parameters may change the same number.
    ratio = (nominal[HALF_WHEELBASE] / nominal[HALF_TRACK]) ** 2
    numbers = nominal.copy()
    for place, field, rule in zip(CHANGES[0], CHANGES[1], CHANGES[2]):  # noqa: B905 - for numba
        numbers[field] = apply_rule(rule, numbers[field], drawn[place], ratio, dt)
    return Physics(*to_fixed_tuple(numbers, PHYSICS_SIZE)), drawn


class Randomizer:
    """Draws the physics of one robot, episode by episode.

    Args:
        ranges: Ranges, as for `Randomization.of`.
        config: Robot configuration.
        step: Duration of an env step [s].
        simulated: Whether the link is simulated, so that physics can vary.
        unused: Parameters that have no effect on this link. They are drawn, but not reported.

    Raises:
        ConfigError: Physics can't vary on this link, or as `Randomization.of` and
            `Randomization.ranges`.
    """

    def __init__(
        self,
        ranges: Any,
        config: RobotConfig,
        step: float,
        *,
        simulated: bool,
        unused: Collection[str] = (),
    ) -> None:
        randomization = Randomization.of(ranges, config)
        self._names = randomization.names
        if self._names and not simulated:
            raise ConfigError(
                f"randomization of {', '.join(self._names)}: only a simulated robot's physics can "
                "vary, and this link is real or a recording"
            )
        self._unused = unused
        self._ranges = randomization.ranges(config, step)
        self._nominal = np.array(compute_physics(config))
        self._dt = loop_period(config)
        self._drawn = np.array(NEUTRAL_NUMBERS)

    def draw(self, rng: np.random.Generator) -> Physics | None:
        """Draw the physics of an episode, or None if nothing varies."""
        if not self._names:
            return None
        varies = self._ranges.high > self._ranges.low
        samples = np.zeros(len(varies))

        # Parameters that don't vary use no random numbers, so that adding one keeps existing seeds.
        samples[varies] = rng.random(int(varies.sum()))
        physics, self._drawn = draw_robot(self._nominal, *self._ranges, samples, self._dt)
        return physics

    def info(self) -> dict[str, Any]:
        """Return what was drawn last, as applied: a float, or an array of four in wheel order."""
        info: dict[str, Any] = {}
        for name in self._names:
            if name not in self._unused:
                # A number for the robot, or four for the wheels.
                numbers = self._drawn[PLACES[name]]
                info[f"drawn_{name}"] = numbers if TABLE[name].per_wheel else float(numbers[0])
        return info
