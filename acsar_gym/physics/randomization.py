"""Domain randomization: which parameters of a robot are drawn anew for every episode, and how.

`Randomization` has the ranges, `Drawn` the numbers that an episode draws from them, and
`vary_physics` their effect on a robot's physics. The single env and the batch both draw with
`draw_robot`, so that the same seed gives the same robot.

To add a parameter: add a field to `Randomization`, one to the end of `Drawn` (so that existing
seeds still draw the same numbers), and its effect to `vary_physics`. If the physics has no such
number, add a field to `model.Physics` and use it there; batches, planar robots and PyBullet's need
no change.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Collection, Mapping
from typing import Annotated, Any, NamedTuple, Self

import numpy as np
from numba.np.unsafe.ndarray import to_fixed_tuple
from numpy.typing import NDArray
from pydantic import AfterValidator, Field

from acsar_gym.config import Measured, RobotConfig
from acsar_gym.config.physics import Physics
from acsar_gym.config.section import Delay, Section, value_of_wheel
from acsar_gym.errors import ConfigError, show_value
from acsar_gym.jit import jit, loop, record_of
from acsar_gym.physics.model import compute_physics, loop_period, turn_factor, wire_loops

Range = tuple[float, float]
Floats = NDArray[np.float64]

DEFAULT_RANGES: dict[str, Range] = {
    "friction": (0.7, 1.2),
    "motor_gain": (0.95, 1.05),
    "motor_lag": (0.6, 1.5),
    "wheel_radius": (0.98, 1.02),
    "turn_factor": (0.9, 1.1),
    "latency": (0.0, 0.02),
}
"""Ranges of what wasn't measured: factors, and latency [s]. Robots of the same parts differ by so
much, and so do floors; the rest isn't randomized."""
FACTOR_FIELDS = {
    "friction": "body.friction",
    "mass": "body.mass",
    "wheel_radius": "wheel_radius",
    "left_wheel_radius": "left_wheel_radius_multiplier",
    "right_wheel_radius": "right_wheel_radius_multiplier",
}
"""Parameters that are factors on one value, and the field whose interval they follow."""
TURNING_FIELDS = ("body.turn_factor", "wheel_separation_multiplier")
"""Fields whose intervals the turn factor follows, the first that was measured: a multiplier that is
right for a robot is the factor by which it turns slower."""
WHEEL_FIELDS = {
    "motor_gain": "gain",
    "motor_lag": "time_constant",
    "deadband_offset": "deadband",
}
"""Parameters of single wheels, and the field of `motor` that they are about."""
LEAST_TURN = 1.001
"""Least turn factor of a range; one of 1 would be a tyre without sideways friction."""
MIN_FACTOR, MAX_FACTOR = 1e-6, 1e3  # factors that a range can have
LEVEL_WIDTHS = {1: 0.5, 2: 1.0, 3: 2.0}
"""Widths of the levels of randomization, relative to what `acsar-gym train` randomizes."""
MIN_LEVEL_FACTOR = 0.05  # least factor of a range that is widened for a level


def measured_ranges(config: RobotConfig) -> dict[str, tuple[float, ...]]:
    """Return the parameters that follow from a robot's measurements, with their ranges.

    A measured interval becomes the range of the parameter that it is about; factors are relative to
    the configured value. Where wheels have intervals of their own, the range holds all of them, and
    the default width for wheels without one.
    """
    measured, ranges = config.measured, dict[str, tuple[float, ...]]()
    for name, path in FACTOR_FIELDS.items():
        if path in measured:
            value: Any = functools.reduce(getattr, path.split("."), config)
            ranges[name] = _relative_range(measured[path], value)
    turning = next((measured[path] for path in TURNING_FIELDS if path in measured), None)
    if turning is not None:
        factor = turn_factor(config)
        ranges["turn_factor"] = (
            max(turning.low, LEAST_TURN) / factor,
            max(turning.high, LEAST_TURN) / factor,
        )
    for name, field in WHEEL_FIELDS.items():
        ends = _wheel_ends(config, name, field)
        if ends:
            ranges[name] = (min(ends), max(ends))
    if delay := measured.get("firmware.command_delay"):
        ranges["command_delay"] = (max(delay.low, 0.0), max(delay.high, 0.0))
    if config.firmware.delay_samples:
        ranges["delay_samples"] = config.firmware.delay_samples
    return ranges


def _wheel_ends(config: RobotConfig, name: str, field: str) -> list[float]:
    """Ends of the ranges of all wheels for one parameter; nothing where none was measured."""
    everywhere, ends = config.measured.get(f"motor.{field}"), list[float]()
    intervals = [config.measured.get(f"motor.{field}.{wheel}", everywhere) for wheel in "abcd"]
    for wheel, interval in enumerate(intervals):
        value = value_of_wheel(getattr(config.motor, field), wheel)
        if name == "deadband_offset":
            ends += [interval.low - value, interval.high - value] if interval else []
        elif any(intervals) and value > 0.0:
            ends += DEFAULT_RANGES[name] if interval is None else _relative_range(interval, value)
    return ends


def _relative_range(interval: Measured, value: float) -> Range:
    """An interval as a range of factors on a value."""
    low, high = interval.low / value, interval.high / value
    return min(max(low, MIN_FACTOR), MAX_FACTOR), min(max(high, MIN_FACTOR), MAX_FACTOR)


def choose_ranges(config: RobotConfig) -> dict[str, tuple[float, ...]]:
    """Return the measured ranges of a robot, and the default ones of what wasn't measured."""
    from_robot, usual, factor = measured_ranges(config), dict(DEFAULT_RANGES), turn_factor(config)
    low, high = usual["turn_factor"]
    usual["turn_factor"] = (max(low, (1.0 + factor) / 2.0 / factor), high)  # stays above 1
    if "command_delay" in from_robot or "delay_samples" in from_robot:
        del usual["latency"]
    return usual | from_robot


def describe_ranges(config: RobotConfig) -> str:
    """Describe which ranges of a robot were measured; nothing where none were."""
    measured = measured_ranges(config)
    if not measured:
        return ""
    texts = [
        f"delay_samples ({len(width)} delays up to {max(width):.3g} s)"
        if name == "delay_samples"
        else f"{name} {width[0]:.3g} to {width[1]:.3g}"
        for name, width in measured.items()
    ]
    usual = [name for name in choose_ranges(config) if name not in measured]
    return f"randomized as measured: {', '.join(texts)}; by default widths: {', '.join(usual)}"


def randomization_level(config: RobotConfig, number: int) -> Randomization:
    """Return the randomization of a level: half, all, or twice of what a robot is trained with.

    Measured delays (`command_delay`, `delay_samples`) are the same on all levels.
    """
    if number not in LEVEL_WIDTHS:
        raise ConfigError(f"randomization level {show_value(number)}: must be 1, 2 or 3")
    scale, ranges = LEVEL_WIDTHS[number], choose_ranges(config)
    for name, width in ranges.items():
        if name in ("latency", "deadband_offset"):  # about zero
            ranges[name] = tuple(scale * end for end in width)
        elif name not in ("command_delay", "delay_samples"):  # factors, about one
            low, high = (1.0 + scale * (end - 1.0) for end in width)
            ranges[name] = (max(low, MIN_LEVEL_FACTOR), high)
    low, high = ranges["turn_factor"]
    ranges["turn_factor"] = (max(low, LEAST_TURN / turn_factor(config)), high)
    return Randomization.of(ranges)


class Drawn(NamedTuple):
    """The numbers that an episode draws, in the order of drawing; defaults change nothing.

    Names that end in _a to _d are for one wheel each.
    """

    mass: float = 1.0
    friction: float = 1.0
    motor_gain_a: float = 1.0
    motor_lag_a: float = 1.0
    motor_gain_b: float = 1.0
    motor_lag_b: float = 1.0
    motor_gain_c: float = 1.0
    motor_lag_c: float = 1.0
    motor_gain_d: float = 1.0
    motor_lag_d: float = 1.0
    deadband: float = math.nan
    wheel_radius: float = 1.0
    latency: float = 0.0
    feedback_rate: float = math.nan
    track_width: float = 1.0
    left_wheel_radius: float = 1.0
    right_wheel_radius: float = 1.0
    turn_factor: float = 1.0
    command_delay: float = math.nan
    delay_samples: float = 0.0
    deadband_offset_a: float = 0.0
    deadband_offset_b: float = 0.0
    deadband_offset_c: float = 0.0
    deadband_offset_d: float = 0.0
    lidar_rate: float = math.nan
    lidar_noise: float = math.nan
    lidar_bias: float = math.nan
    lidar_dropouts: float = math.nan
    lidar_outliers: float = math.nan


class DrawnRanges(NamedTuple):
    """Least and largest value of each number; both are the default where it doesn't vary."""

    low: Drawn
    high: Drawn
    delays: tuple[float, ...] = (0.0,)
    """What `delay_samples` is drawn from [s]; its low and high are the shares 0 and 1."""


def _bounded(least: float, most: float) -> AfterValidator:
    """Return a validator of a range."""

    def check(value: Range | None) -> Range | None:
        if value is not None and not least <= value[0] <= value[1] <= most:
            raise ValueError(f"must be (low, high) with {least:g} <= low <= high <= {most:g}")
        return value

    return AfterValidator(check)


Factor = Annotated[Range | None, _bounded(MIN_FACTOR, MAX_FACTOR)]


class Randomization(Section):
    """Ranges (low, high) from which every episode draws; a parameter that is None doesn't vary.

    The same on every simulated link and in a batch. Factors multiply the configured value; other
    values replace it or are added to it. The info of an episode has what was drawn, as applied,
    under "drawn_" and the name.
    """

    section = "randomization"
    mass: Factor = None
    """Factor on the mass, and so on inertia and wheel loads."""
    friction: Factor = None
    """Factor on the friction between tyre and ground."""
    motor_gain: Factor = None
    """Factor on each wheel's speed for its set point; four numbers."""
    motor_lag: Factor = None
    """Factor on each wheel's time constant; four numbers. No effect on motors without lag."""
    deadband: Annotated[Range | None, _bounded(0.0, 1e3)] = None
    """Set points below this don't turn the wheel [rad/s]."""
    wheel_radius: Factor = None
    """Factor on the real wheel radius; odometry still assumes the configured one."""
    latency: Annotated[Range | None, _bounded(0.0, 10.0)] = None
    """Delay of commands and feedback on top of the wire's own [s], in whole firmware loops;
    shorter than an env step."""
    feedback_rate: Annotated[Range | None, _bounded(0.1, 1e4)] = None
    """Feedback lines per second [Hz], rounded to whole firmware loops."""
    track_width: Factor = None
    """Factor on the real distance between left and right wheels; odometry still assumes the
    configured one. Tyres that wear or bulge change where they touch the ground."""
    left_wheel_radius: Factor = None
    """Factor on the real radius of the left wheels; odometry still assumes the configured one."""
    right_wheel_radius: Factor = None
    """Factor on the real radius of the right wheels."""
    turn_factor: Factor = None
    """Factor on the robot's turn factor (see `body.turn_factor`), which depends on the ground. No
    effect in MuJoCo, whose contacts decide by themselves how a robot turns."""
    command_delay: Annotated[Range | None, _bounded(0.0, 1.0)] = None
    """Time from the last byte of a command to its effect, after the processing time [s]."""
    delay_samples: Annotated[tuple[Delay, ...], Field(min_length=1)] | None = None
    """Delays of commands on top of `command_delay` [s]; each episode draws one of them."""
    deadband_offset: Annotated[Range | None, _bounded(-1e3, 1e3)] = None
    """Added to each wheel's deadband, which stays at least 0 [rad/s]; four numbers."""
    lidar_rate: Annotated[Range | None, _bounded(0.1, 1e4)] = None
    """Revolutions of the LiDAR per second [Hz]."""
    lidar_noise: Annotated[Range | None, _bounded(0.0, 1e3)] = None
    """Standard deviation of the LiDAR's ranges [m]."""
    lidar_bias: Annotated[Range | None, _bounded(-1e3, 1e3)] = None
    """Added to all of the LiDAR's ranges [m]."""
    lidar_dropouts: Annotated[Range | None, _bounded(0.0, 1.0)] = None
    """Share of the LiDAR's measurements that fail."""
    lidar_outliers: Annotated[Range | None, _bounded(0.0, 1.0)] = None
    """Share of the LiDAR's measurements at an edge that lie between its two sides."""

    @classmethod
    def of(
        cls,
        ranges: Mapping[str, tuple[float, ...]] | Self | bool | None,
        config: RobotConfig | None = None,
    ) -> Randomization:
        """Return a Randomization from a mapping of names to ranges.

        Args:
            ranges: a mapping, a Randomization, True for what `acsar-gym train` randomizes
                (`measured`), or None or False for nothing.
            config: the robot, for True.

        Raises:
            ConfigError: a name is unknown, or a range is malformed.
        """
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
        """Return the ranges of a robot's measurements, and default widths for the rest.

        Measured delays (`firmware.delay_samples`, or the interval of `firmware.command_delay`)
        replace the default latency.

        Args:
            config: the robot, with the intervals in its field `measured`.
        """
        return cls.of(choose_ranges(config))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters that vary."""
        return tuple(name for name, value in self if value is not None)

    def ranges(self, config: RobotConfig, step: float) -> DrawnRanges:
        """Return the range of every number that an episode draws.

        Args:
            config: the robot.
            step: duration of an env step [s].

        Raises:
            ConfigError: the latency is as long as a step, the wire or `feedback_timeout` doesn't
                allow the feedback rate, or the robot would turn as fast as the formula says.
        """
        dt = loop_period(config)
        for rate in self.feedback_rate or ():
            applied = 1.0 / (loops_between(rate, dt) * dt)
            try:
                config.with_(firmware={"feedback_rate": applied})
            except ConfigError as error:
                said = f"randomization.feedback_rate = {self.feedback_rate}: {error}"
                raise ConfigError(said) from error
        if self.turn_factor and (least := self.turn_factor[0] * turn_factor(config)) <= 1.0:
            raise ConfigError(
                f"randomization.turn_factor = {self.turn_factor}: makes this robot's turn factor "
                f"{least:g}: must stay above 1"
            )
        slowest = wire_loops(config) * dt + (self.latency or (0.0, 0.0))[1]
        if self.latency and slowest > step - dt / 2.0:
            raise ConfigError(
                f"randomization.latency = {self.latency}: on this wire a line takes up to "
                f"{slowest:g} s; must be shorter than a step of the policy ({step:g} s); a lower "
                "policy_rate makes it longer"
            )
        lags = config.motor.time_constant
        instant = [f"motor_lag_{w}" for i, w in enumerate("abcd") if value_of_wheel(lags, i) == 0.0]
        pairs = {
            number: (0.0, 1.0) if name == "delay_samples" else getattr(self, name)
            for name in self.names
            for number in number_names(name)
            if number not in instant
        }
        low = {number: pair[0] for number, pair in pairs.items()}
        high = {number: pair[1] for number, pair in pairs.items()}
        return DrawnRanges(Drawn(**low), Drawn(**high), self.delay_samples or (0.0,))


def longest_delay(ranges: DrawnRanges, config: RobotConfig) -> float:
    """Longest `command_delay` that an episode can have [s]."""
    drawn = ranges.high.command_delay
    longest = config.firmware.command_delay if math.isnan(drawn) else drawn
    return longest + max(ranges.delays)


DRAWN_SIZE = len(Drawn._fields)
LATENCY, FEEDBACK_RATE = Drawn._fields.index("latency"), Drawn._fields.index("feedback_rate")
DELAY_SAMPLES = Drawn._fields.index("delay_samples")


@jit
def loops_between(rate: float, dt: float) -> float:
    """Whole firmware loops between lines at this rate [Hz], at least one; NaN for NaN."""
    loops: float = np.rint(1.0 / (rate * dt))
    return 1.0 if loops < 1.0 else loops


@jit
def replace_nan(configured: float, value: float) -> float:
    """The value, or the configured one where the value is NaN."""
    return configured if np.isnan(value) else value


@jit
def scale_lag(blend: float, factor: float, dt: float) -> float:
    """A wheel's `blend` after its time constant is multiplied by a factor."""
    if factor == 1.0 or blend >= 1.0:
        return blend
    return 1.0 - math.exp(math.log(1.0 - blend) / factor)


@jit
def compute_deadband(configured: float, drawn: float, offset: float) -> float:
    """A wheel's deadband [rad/s]: configured or drawn, plus an offset, at least zero."""
    return max(replace_nan(configured, drawn) + offset, 0.0)


@jit
def scale_kappa(nominal: Physics, factor: float) -> float:
    """The tyres' `kappa` after the robot's turn factor is multiplied by a factor."""
    if factor == 1.0:
        return nominal.kappa
    ratio = (nominal.half_wheelbase / nominal.half_track) ** 2
    return ((1.0 + nominal.kappa * ratio) * factor - 1.0) / ratio


@jit
def vary_physics(nominal: Physics, drawn: Drawn, dt: float) -> Physics:
    """Apply what was drawn to a robot's physics."""
    return Physics(
        left_radius=nominal.left_radius * drawn.wheel_radius * drawn.left_wheel_radius,
        right_radius=nominal.right_radius * drawn.wheel_radius * drawn.right_wheel_radius,
        half_wheelbase=nominal.half_wheelbase,
        half_track=nominal.half_track * drawn.track_width,
        mass=nominal.mass * drawn.mass,
        yaw_inertia=nominal.yaw_inertia * drawn.mass,
        grip=nominal.grip * drawn.mass * drawn.friction,
        kappa=scale_kappa(nominal, drawn.turn_factor),
        slip_speed=nominal.slip_speed,
        max_speed=nominal.max_speed,
        deadband_a=compute_deadband(nominal.deadband_a, drawn.deadband, drawn.deadband_offset_a),
        deadband_b=compute_deadband(nominal.deadband_b, drawn.deadband, drawn.deadband_offset_b),
        deadband_c=compute_deadband(nominal.deadband_c, drawn.deadband, drawn.deadband_offset_c),
        deadband_d=compute_deadband(nominal.deadband_d, drawn.deadband, drawn.deadband_offset_d),
        blend_a=scale_lag(nominal.blend_a, drawn.motor_lag_a, dt),
        blend_b=scale_lag(nominal.blend_b, drawn.motor_lag_b, dt),
        blend_c=scale_lag(nominal.blend_c, drawn.motor_lag_c, dt),
        blend_d=scale_lag(nominal.blend_d, drawn.motor_lag_d, dt),
        gain_a=nominal.gain_a * drawn.motor_gain_a,
        gain_b=nominal.gain_b * drawn.motor_gain_b,
        gain_c=nominal.gain_c * drawn.motor_gain_c,
        gain_d=nominal.gain_d * drawn.motor_gain_d,
        latency_loops=nominal.latency_loops + np.rint(drawn.latency / dt),
        command_delay=replace_nan(nominal.command_delay, drawn.command_delay) + drawn.delay_samples,
        feedback_loops=replace_nan(nominal.feedback_loops, loops_between(drawn.feedback_rate, dt)),
        scan_rate=replace_nan(nominal.scan_rate, drawn.lidar_rate),
        range_noise=replace_nan(nominal.range_noise, drawn.lidar_noise),
        range_bias=replace_nan(nominal.range_bias, drawn.lidar_bias),
        range_dropouts=replace_nan(nominal.range_dropouts, drawn.lidar_dropouts),
        range_outliers=replace_nan(nominal.range_outliers, drawn.lidar_outliers),
    )


@loop
def draw_robot(
    nominal: Any, low: Floats, high: Floats, delays: Floats, samples: Floats, dt: float
) -> tuple[Physics, Drawn]:
    """Draw a robot's physics for one episode."""
    numbers = np.empty(DRAWN_SIZE)
    for k in range(DRAWN_SIZE):
        numbers[k] = low[k] + (high[k] - low[k]) * samples[k] if high[k] > low[k] else low[k]
    numbers[LATENCY] = np.rint(numbers[LATENCY] / dt) * dt
    place = min(int(numbers[DELAY_SAMPLES] * len(delays)), len(delays) - 1)
    numbers[DELAY_SAMPLES] = delays[place]
    numbers[FEEDBACK_RATE] = 1.0 / (loops_between(numbers[FEEDBACK_RATE], dt) * dt)
    drawn = Drawn(*to_fixed_tuple(numbers, DRAWN_SIZE))
    return vary_physics(nominal[0], drawn, dt), drawn


def drawn_places(name: str) -> tuple[int, ...]:
    """Indices of a parameter's numbers in `Drawn`: one, or four in the order of the wheels."""
    return tuple(Drawn._fields.index(number) for number in number_names(name))


def number_names(name: str) -> tuple[str, ...]:
    """Names of a parameter's numbers in `Drawn`."""
    return (name,) if name in Drawn._fields else tuple(f"{name}_{wheel}" for wheel in "abcd")


class Randomizer:
    """Draws the physics of one robot, episode by episode.

    Args:
        given: as for `Randomization.of`.
        config: the robot.
        step: duration of an env step [s].
        simulated: whether the link is simulated, so that physics can vary.
        unused: parameters that have no effect on this link; they are drawn, and not told.

    Raises:
        ConfigError: physics can't vary on this link, or as `Randomization.of` and
            `Randomization.ranges`.
    """

    def __init__(
        self,
        given: Any,
        config: RobotConfig,
        step: float,
        *,
        simulated: bool,
        unused: Collection[str] = (),
    ) -> None:
        randomization = Randomization.of(given, config)
        self._names, self._unused = randomization.names, unused
        if self._names and not simulated:
            raise ConfigError(
                f"randomization of {', '.join(self._names)}: only a simulated robot's physics can "
                "vary, and this link is real or a recording"
            )
        ranges = randomization.ranges(config, step)
        self._low, self._high = np.array(ranges.low), np.array(ranges.high)
        self._delays = np.array(ranges.delays)
        self._nominal, self._dt = record_of(compute_physics(config)), loop_period(config)
        self._drawn = Drawn()

    def draw(self, rng: np.random.Generator) -> Physics | None:
        """Draw the physics of an episode."""
        if not self._names:
            return None
        samples, varies = np.zeros(DRAWN_SIZE), self._high > self._low
        samples[varies] = rng.random(int(varies.sum()))
        physics, drawn = draw_robot(
            self._nominal, self._low, self._high, self._delays, samples, self._dt
        )
        self._drawn = Drawn(*map(float, drawn))
        return Physics(*map(float, physics))

    def info(self) -> dict[str, Any]:
        """What was drawn last, as applied: a float, or an array of four in the order of wheels."""
        told: dict[str, Any] = {}
        for name in self._names:
            if name in self._unused:
                continue
            numbers = np.array([self._drawn[k] for k in drawn_places(name)])
            told[f"drawn_{name}"] = float(numbers[0]) if len(numbers) == 1 else numbers
        return told
