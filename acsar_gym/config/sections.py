"""The sections of a robot's configuration: board, wiring, body, LiDAR, ROS 2, limits, intervals."""

from __future__ import annotations

import functools
import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal, NamedTuple, Self, get_args

from pydantic import (
    AfterValidator,
    BeforeValidator,
    ConfigDict,
    Field,
    ModelWrapValidatorHandler,
    StringConstraints,
    TypeAdapter,
    ValidationError,
    ValidationInfo,
    field_validator,
    model_validator,
)

from acsar_gym.config.section import (
    Delay,
    Length,
    Name,
    PerWheel,
    Rate,
    Section,
    Speed,
    Wait,
    per_wheel,
    value_of_wheel,
)
from acsar_gym.errors import ConfigError


class LidarConfig(Section):
    """The LiDAR and how its scans are used; its position is lidar_x/y/z_offset of the robot."""

    section = "lidar"
    rays: Annotated[int, Field(gt=0, le=10_000)] = 64
    """Rays of an observation; each has the range between the two measurements next to it in
    direction."""
    field_of_view: Annotated[float, Field(gt=0.0, le=2.0 * math.pi + 1e-9)] = 2.0 * math.pi
    """Angle covered by the rays, centred on the x axis [rad]; a full turn has no duplicate ray."""
    min_range: Annotated[float, Field(ge=0.0, le=1e3)] = 0.1
    """Smaller measurements are set to this range [m]."""
    max_range: Annotated[float, Field(gt=0.0, le=1e3)] = 5.0
    """Larger or failed measurements are set to this range [m], at most 1 km."""
    rate: Rate = 10.0
    """Scans per second [Hz], at most 10,000."""
    noise: Annotated[float, Field(ge=0.0, le=1e3)] = 0.01
    """Standard deviation of simulated ranges [m]; typical of hobby LiDARs at a few metres."""
    bias: Annotated[float, Field(ge=-1e3, le=1e3)] = 0.0
    """Added to all simulated ranges [m]."""
    dropouts: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.0
    """Share of simulated measurements that fail."""
    outliers: Annotated[float, Field(ge=0.0, le=1.0)] = 0.0
    """Share of simulated measurements at an edge that lie anywhere between what is before and what
    is behind it, as the beam meets both."""
    timeout: Wait = 1.0
    """A scan older than this is an error that stops the robot [s], at most 1 h."""

    @model_validator(mode="after")
    def _ranges_and_times_fit(self) -> Self:
        """Check the order of the ranges, and the time-out against the rate."""
        if self.min_range >= self.max_range:
            raise ConfigError(
                f"lidar.min_range = {self.min_range:g}: must be less than lidar.max_range = "
                f"{self.max_range:g} m"
            )
        if self.timeout < 1.5 / self.rate:
            raise ConfigError(
                f"lidar.timeout = {self.timeout:g} s: must be at least one and a half periods of "
                f"lidar.rate = {self.rate:g} Hz"
            )
        return self


class WheelMotor(NamedTuple):
    """The motor values of one wheel; see `MotorConfig`."""

    gain: float
    acceleration: float
    time_constant: float
    deadband: float


class MotorConfig(Section):
    """The motors and their speed control; values of single wheels as four numbers, a to d."""

    section = "motor"
    max_speed: Speed = 30.0
    """Largest wheel speed of the motors [rad/s], at most 1,000."""
    gain: Annotated[PerWheel, per_wheel(Field(gt=0.0, le=100.0))] = 1.0
    """Wheel speed for a set point of 1 rad/s, at most 100; a number, or four."""
    acceleration: Annotated[PerWheel, per_wheel(Field(gt=0.0, le=1e6))] = 60.0
    """Acceleration of the firmware's set point ramp [rad/s^2], at most 1e6; a number, or four."""
    time_constant: Annotated[PerWheel, per_wheel(Field(ge=0.0, le=100.0))] = 0.08
    """Time constant of the first-order speed loop [s], at most 100; hobby motors have 0.05-0.2. A
    number, or four."""
    deadband: Annotated[PerWheel, per_wheel(Field(ge=0.0, le=1e3))] = 0.0
    """Set points times gain below this don't turn the wheel [rad/s], at most 1,000; a number, or
    four."""

    def of_wheel(self, wheel: int) -> WheelMotor:
        """Return the values of one wheel.

        Args:
            wheel: 0 to 3 for a to d.
        """
        return WheelMotor(
            *(value_of_wheel(getattr(self, name), wheel) for name in WheelMotor._fields)
        )


class EncoderConfig(Section):
    """The wheel encoders, as the firmware reads them."""

    section = "encoder"
    counts_per_revolution: Annotated[int, Field(gt=0, le=10_000_000)] = 1320
    """Counts per turn of the wheel, at most ten million."""
    window: Annotated[float, Field(gt=0.0, le=5.0)] = 0.05
    """Averaging time of the feedback [s], at most 5 s and 2,000 loops of the firmware."""
    quantum: Annotated[float, Field(gt=0.0, le=100.0)] | None = None
    """Printed speeds are rounded to multiples of this [rad/s], at most 100; None: not rounded, but
    for the two decimals of a line."""


class FirmwareConfig(Section):
    """The program of the microcontroller."""

    section = "firmware"
    loop_rate: Rate = 200.0
    """Rate of its control loop, and of the simulation's substeps [Hz], at most 10,000."""
    feedback_rate: Rate | None = None
    """Feedback lines per second [Hz]; None: one per tick of the control rate."""
    processing_time: Delay = 0.00125
    """Time from the last byte of a line to its effect, and from encoder to first byte [s], at most
    1 s."""
    command_delay: Delay = 0.0
    """Further time from the last byte of a command to its effect [s], at most 1 s."""
    delay_samples: Annotated[tuple[Delay, ...], Field(max_length=1_000)] = ()
    """Measured delays of commands on top of `command_delay` [s], as quantiles of equal weight. Only
    randomization uses them: each episode draws one."""
    command_timeout: Wait | None = 0.5
    """Motors stop after this time without a valid command [s], at most 1 h; None: never."""


class BodyConfig(Section):
    """Chassis and ground."""

    section = "body"
    mass: Annotated[float, Field(gt=0.0, le=1e5)] = 4.0
    """Mass of the whole robot [kg], at most 100 t."""
    length: Length = 0.34
    """Length of the footprint, along x [m]."""
    width: Length = 0.34
    """Width of the footprint over the wheels, along y [m]."""
    height: Length = 0.12
    """Height of the top of the chassis above ground [m]."""
    friction: Annotated[float, Field(gt=0.0, le=100.0)] = 1.0
    """Coulomb friction coefficient between tyre and ground, at most 100."""
    slip_speed: Speed = 0.005
    """Slip speed below which friction is proportional to slip [m/s], at most 1,000."""
    turn_factor: Annotated[float, Field(gt=1.0, le=100.0)] | None = None
    """Factor by which the robot turns slower than the differential-drive formula says, at most 100.
    It sets the tyres' sideways friction: (mu_lateral / mu_longitudinal)^2 =
    (turn_factor - 1) (wheel_separation / wheelbase)^2. None: equal friction in all directions, so
    1 + (wheelbase / wheel_separation)^2. MuJoCo's contacts know neither this nor `slip_speed`."""


# Wiring

WIRE_LETTERS = "abcd"
Letter = Literal["a", "b", "c", "d"]
Sign = Literal[1, -1]
Speeds = tuple[float, float, float, float]
Heard = tuple[float | None, float | None, float | None, float | None]


class WheelConfig(Section):
    """One wheel's motor and encoder on the wire."""

    section = "wheels"
    motor: Letter
    """Letter that commands it."""
    motor_sign: Sign = 1
    """-1 where a positive command turns it backward."""
    encoder: Letter
    """Letter that reports its speed."""
    sign: Sign = 1
    """-1 where its encoder reports a forward turn as negative."""

    @model_validator(mode="wrap")
    @classmethod
    def _as_one_error(cls, data: Any, handler: ModelWrapValidatorHandler[Self]) -> Self:
        """Leave errors to WheelsConfig, which knows the wheel's name."""
        return handler(data)


def _wheel(letter: Letter) -> BeforeValidator:
    """Return a validator that sets missing letters of a wheel to its own."""
    letters = {"motor": letter, "encoder": letter}
    return BeforeValidator(lambda given: {**letters, **given} if isinstance(given, dict) else given)


@dataclass(frozen=True, slots=True)
class WheelLetters:
    """Which letter belongs to each wheel, for one direction of the wire.

    Attributes:
        places: index of each wheel's letter, in the order of the wheels.
        signs: 1.0 or -1.0 for each wheel.
    """

    places: tuple[int, int, int, int]
    signs: Speeds

    def to_wire(self, speeds: Sequence[float]) -> Speeds:
        """Convert speeds of the wheels to those of the letters a, b, c, d [rad/s]."""
        wire = [0.0, 0.0, 0.0, 0.0]
        for place, sign, speed in zip(self.places, self.signs, speeds, strict=True):
            wire[place] = sign * speed + 0.0  # no negative zero
        return wire[0], wire[1], wire[2], wire[3]

    def to_wheels(self, wire: Heard) -> Heard:
        """Convert speeds of the letters to those of the wheels [rad/s]; None where one misses."""
        a, b, c, d = (
            None if (speed := wire[place]) is None else sign * speed + 0.0
            for place, sign in zip(self.places, self.signs, strict=True)
        )
        return a, b, c, d


class WheelsConfig(Section):
    """The wiring: letters and signs of each wheel's motor and encoder."""

    section = "wheels"
    a: Annotated[WheelConfig, _wheel("a")] = WheelConfig(motor="a", encoder="a")
    """The front right wheel."""
    b: Annotated[WheelConfig, _wheel("b")] = WheelConfig(motor="b", encoder="b")
    """The front left wheel."""
    c: Annotated[WheelConfig, _wheel("c")] = WheelConfig(motor="c", encoder="c")
    """The rear left wheel."""
    d: Annotated[WheelConfig, _wheel("d")] = WheelConfig(motor="d", encoder="d")
    """The rear right wheel."""

    @model_validator(mode="after")
    def _letters_are_used_once(self) -> Self:
        """Check that no letter belongs to two wheels."""
        for part in ("motor", "encoder"):
            used = Counter(getattr(wheel, part) for wheel in self.each)
            twice = sorted(letter for letter, count in used.items() if count > 1)
            if twice:
                raise ConfigError(
                    f"wheels: {part} {twice[0]} belongs to {used[twice[0]]} wheels: each letter "
                    "must be used once"
                )
        return self

    @property
    def each(self) -> tuple[WheelConfig, WheelConfig, WheelConfig, WheelConfig]:
        """The wheels in the order a, b, c, d."""
        return self.a, self.b, self.c, self.d

    @property
    def motors(self) -> WheelLetters | None:
        """Letters of the commands; None where every wheel has its own, forward."""
        return _letters([(wheel.motor, wheel.motor_sign) for wheel in self.each])

    @property
    def encoders(self) -> WheelLetters | None:
        """Letters of the feedback; None where every wheel has its own, forward."""
        return _letters([(wheel.encoder, wheel.sign) for wheel in self.each])


def _letters(named: Sequence[tuple[str, int]]) -> WheelLetters | None:
    """Return the mapping of four wheels; None for the identity."""
    if [letter for letter, sign in named if sign == 1] == list(WIRE_LETTERS):
        return None
    a, b, c, d = (WIRE_LETTERS.index(letter) for letter, _ in named)
    sa, sb, sc, sd = (float(sign) for _, sign in named)
    return WheelLetters((a, b, c, d), (sa, sb, sc, sd))


# ROS 2

JointNames = tuple[Name, Name, Name, Name]
"""Joints of the wheels a, b, c, d; where two stand for a side, each of them twice."""
_TOPIC = re.compile("/?[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*")


def _topic(name: str) -> str:
    """Return a name that ROS 2 allows; ValueError for others."""
    if not _TOPIC.fullmatch(name):
        raise ValueError("must be a topic, such as 'cmd_vel' or '/base/cmd_vel'")
    return name


Topic = Annotated[str, Field(max_length=200), AfterValidator(_topic)]
"""Relative to the link's namespace, but for names that begin with a slash."""


def _name_joints(given: Any) -> Any:
    """Return names in the order a, b, c, d; ValueError for what isn't four, or one of a side."""
    if given is None:
        return None
    if isinstance(given, Mapping):
        if given.keys() == {"left", "right"}:
            given = [given[side] for side in ("right", "left", "left", "right")]
        elif given.keys() == set(WIRE_LETTERS):
            given = [given[letter] for letter in WIRE_LETTERS]
    names = [*given] if isinstance(given, list | tuple) else []
    if len(names) != 4 or not all(isinstance(name, str) and name for name in names):
        raise ValueError("must be four names in the order a, b, c, d, or {left: NAME, right: NAME}")
    a, b, c, d = names
    if len({*names}) != 4 and not (a == d != b == c):
        raise ValueError("must name each joint once, or {left: NAME, right: NAME}")
    return a, b, c, d


Radius = Annotated[float, Field(gt=0.0, le=100.0)]


class Ros2Config(Section):
    """How a robot that is in ROS 2 is reached by the link "ros2"."""

    section = "ros2"
    joints: Annotated[JointNames | None, BeforeValidator(_name_joints)] = None
    """Joints of the wheels in `joint_states`: four names in the order a, b, c, d, a mapping
    {a, b, c, d}, or {left, right} where one joint stands for a side. None: `wheel_joints`."""
    command: Literal["twist_stamped", "twist", "wheel_speeds"] | None = None
    """What the robot takes: geometry_msgs/TwistStamped or Twist, or the wheels' speeds [rad/s] as
    std_msgs/Float64MultiArray. None: as its subscription says."""
    command_topic: Topic = "cmd_vel"
    """Topic of the commands. Topics are relative to the link's namespace, but for those that begin
    with a slash."""
    command_joints: tuple[Name, ...] | None = None
    """Order of the joints in the array of wheel speeds; None: a, b, c, d."""
    joint_states_topic: Topic = "joint_states"
    """Topic of the measured wheels, sensor_msgs/JointState."""
    odom_topic: Topic = "odom"
    """Topic of the robot's odometry, nav_msgs/Odometry."""
    scan_topic: Topic = "scan"
    """Topic of the LiDAR `--lidar ros2`, sensor_msgs/LaserScan."""
    wheel_separation: Annotated[float, Field(gt=0.0, le=1000.0)] | None = None
    """Separation by which the robot's controller turns twists into speeds of wheels, its multiplier
    included [m]; None: that of the robot. `identify` finds it, and `calibrate` keeps it."""
    wheel_radii: tuple[Radius, Radius] | None = None
    """Likewise the radii of its left and its right wheels [m]."""
    feedback: Literal["joint_states", "odom"] | None = None
    """Where the wheels' speeds come from; None: `joint_states`, or `odom` where nobody publishes
    those."""
    use_sim_time: bool | None = None
    """Whether time is that of the topic /clock; None: where somebody publishes it."""
    only: bool | None = None
    """Whether the robot can't be simulated, as it has two driven wheels, or nothing says its
    wheelbase. None: where one joint stands for a side."""


# Limits

LINEAR_ACCELERATION = 2.0  # default limit [m/s^2]; ROS configurations of mobile bases use 1 to 3
ANGULAR_ACCELERATION = 8.0  # default limit [rad/s^2]


def _not_zero(value: float) -> float:
    """Return an acceleration; ValueError for zero, which would never let the robot go."""
    if value == 0.0:
        raise ValueError("must not be 0")
    return value


AccelerationLimit = Annotated[float, Field(ge=-1e6, le=1e6), AfterValidator(_not_zero)]
"""An acceleration whose sign follows from its name, so that it doesn't matter."""


class SpeedLimits(Section):
    """Limits of one axis, with names and meaning of ROS diff_drive_controller; None is no limit.

    Units are m/s or rad/s and their derivatives, at most 1e6. If a minimum is None, it is the
    negative maximum. A twist of zero isn't limited, but sent at once. NaN is None, and so is a jerk
    of 0, as in ROS.

    Accelerations have the names of Humble (`min_acceleration` limits braking, and speeding up
    backward) or of Jazzy, which tells these two apart.
    """

    section = "limits"
    max_velocity: Annotated[float, Field(ge=0.0, le=1e6)] | None = None
    """Forward or counter-clockwise."""
    min_velocity: Annotated[float, Field(ge=-1e6, le=0.0)] | None = None
    """Backward or clockwise; not positive."""
    max_acceleration: Annotated[float, Field(gt=0.0, le=1e6)] | None = None
    """Of a robot that speeds up forward, and in the names of Humble also of one that brakes
    backward."""
    min_acceleration: Annotated[float, Field(ge=-1e6, lt=0.0)] | None = None
    """Humble's; negative, and an error beside a name of Jazzy."""
    max_deceleration: AccelerationLimit | None = None
    """Of a robot that goes forward; None: as `max_acceleration`."""
    max_acceleration_reverse: AccelerationLimit | None = None
    """Of a robot that goes backward; None: as `max_acceleration`."""
    max_deceleration_reverse: AccelerationLimit | None = None
    """Of a robot that goes backward; None: as `max_deceleration`."""
    max_jerk: Annotated[float, Field(gt=0.0, le=1e6)] | None = None
    """How fast the acceleration may grow [m/s^3 or rad/s^3]."""
    min_jerk: Annotated[float, Field(ge=-1e6, lt=0.0)] | None = None
    """How fast the acceleration may fall; negative."""

    @field_validator("*", mode="before")
    @classmethod
    def _without_unset(cls, value: Any, info: ValidationInfo) -> Any:
        """Return None for ROS's words for no limit."""
        if not isinstance(value, float | int):
            return value
        is_jerk = str(info.field_name).endswith("_jerk")
        return None if math.isnan(value) or (is_jerk and value == 0.0) else value

    @model_validator(mode="after")
    def _names_of_one_release(self) -> Self:
        """Check that accelerations don't have names of both Humble and Jazzy."""
        for name in ("max_deceleration", "max_acceleration_reverse", "max_deceleration_reverse"):
            if self.min_acceleration is not None and getattr(self, name) is not None:
                raise ConfigError(
                    f"{self.section}.min_acceleration (of ROS 2 Humble) and {self.section}.{name} "
                    "(of Jazzy) limit the same: use the names of one of them"
                )
        return self


class LinearLimits(SpeedLimits):
    """Limits of the linear velocity."""

    section = "linear_limits"


class AngularLimits(SpeedLimits):
    """Limits of the angular velocity."""

    section = "angular_limits"


def default_acceleration(limit: float) -> BeforeValidator:
    """Return a validator that sets a missing `max_acceleration` to this limit; null stays null."""

    def complete(given: Any) -> Any:
        if isinstance(given, SpeedLimits):
            return given.model_dump()
        return {"max_acceleration": limit, **given} if isinstance(given, dict) else given

    return BeforeValidator(complete)


class Geofence(Section):
    """A rectangle in the odometry frame [m]; outside of it the robot is stopped."""

    section = "geofence"
    min_x: float = -math.inf
    """Least x [m]; negative."""
    max_x: float = math.inf
    """Largest x [m]; positive."""
    min_y: float = -math.inf
    """Least y [m]; negative."""
    max_y: float = math.inf
    """Largest y [m]; positive."""
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=True)

    @model_validator(mode="after")
    def _holds_the_start(self) -> Self:
        """Check that the start of the odometry frame is inside."""
        if not (self.min_x < 0.0 < self.max_x and self.min_y < 0.0 < self.max_y):
            raise ConfigError(
                f"geofence = {self.min_x:g} to {self.max_x:g}, {self.min_y:g} to {self.max_y:g} m: "
                "must have the start (0, 0) inside"
            )
        return self


# Measured intervals

Number = Annotated[float, Field(ge=-1e6, le=1e6)]
LogHash = Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{16}$")]
LogHashes = Annotated[tuple[LogHash, ...], Field(max_length=1_000)]


class Measured(Section):
    """The 95 % interval of one measured value, and what it was measured from."""

    section = "measured"
    low: Number
    """Lower end, in the unit of the field."""
    high: Number
    """Upper end."""
    method: Name
    """How it was measured, such as "identify" or "calibrate straight"."""
    logs: LogHashes = ()
    """First 16 hex digits of the SHA-256 of each log."""

    @model_validator(mode="after")
    def _is_an_interval(self) -> Measured:
        """Check the order of the ends."""
        if self.low > self.high:
            raise ConfigError(f"measured: low = {self.low:g}: must be at most high = {self.high:g}")
        return self


def validate_measured(measured: Mapping[str, Measured], model: type[Section]) -> None:
    """Raise ConfigError for intervals of no number of the model, or with bad ends."""
    for name, interval in measured.items():
        adapter = _find_number(model, name)
        if adapter is None:
            raise ConfigError(f"measured: unknown field {name[:60]!r}: must be like 'motor.gain.a'")
        for end in ("low", "high"):
            value = getattr(interval, end)
            try:
                adapter.validate_python(value)
            except ValidationError as error:
                allowed = error.errors(include_url=False)[0]["msg"].removeprefix("Input should ")
                raise ConfigError(f"measured.{name}.{end} = {value:g}: must {allowed}") from error


@functools.lru_cache(maxsize=256)
def _find_number(model: type[Section], name: str) -> TypeAdapter[Any] | None:
    """The validator of a field by its dotted name; None where there is none."""
    part, _, inner = name.partition(".")
    field = model.model_fields.get(part)
    if field is None:
        return None
    for kind in (field.annotation, *get_args(field.annotation)):
        if isinstance(kind, type) and issubclass(kind, Section):
            return _find_number(kind, inner)
    if inner and not (field.annotation == PerWheel and inner in WIRE_LETTERS):
        return None
    is_whole = field.annotation is int  # whose interval has any ends
    number: Any = float if is_whole else Annotated[field.annotation, *field.metadata, Field()]
    return TypeAdapter(number)


def update_measured(
    measured: Mapping[str, Measured], findings: Mapping[str, Measured | None]
) -> dict[str, Measured]:
    """Return the intervals of a robot after new findings, for its field `measured`.

    An interval for all wheels replaces those of single wheels; one of a single wheel leaves the
    others theirs; None ends one.
    """
    result = dict(measured)
    for name in findings:
        field, _, wheel = name.rpartition(".")
        if wheel in WIRE_LETTERS and field in result:
            every = result.pop(field)
            result = {f"{field}.{other}": every for other in WIRE_LETTERS} | result
        for old in (name, *(f"{name}.{other}" for other in WIRE_LETTERS)):
            result.pop(old, None)
    return result | {name: interval for name, interval in findings.items() if interval is not None}
