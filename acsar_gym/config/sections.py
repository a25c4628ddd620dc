"""Sections of a robot's configuration: board, wiring, body, LiDAR, ROS 2, limits, intervals."""

from __future__ import annotations

import functools
import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal, NamedTuple, Self

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
    Factor,
    Length,
    Name,
    PerWheel,
    Rate,
    Section,
    Share,
    Speed,
    Wait,
    per_wheel,
    value_of_wheel,
)
from acsar_gym.errors import ConfigError

GEOMETRY_FIELDS = (
    "wheel_radius",
    "wheel_separation",
    "wheelbase",
    "wheel_separation_multiplier",
    "left_wheel_radius_multiplier",
    "right_wheel_radius_multiplier",
)
"""Fields that a robot's file always has. ROS's diff_drive_controller uses the same names."""
SIX_NUMBERS = (
    "write wheel_radius, wheel_separation, wheelbase, wheel_separation_multiplier, max_linear and "
    "max_angular into a YAML file, and give that"
)
"""What to do about a robot in any file that isn't read."""
MANY_ROBOTS = "a fleet is for a batch of robots (make_vec); give one robot here"


Distance = Annotated[float, Field(ge=0.0, le=1e3)]


class LidarConfig(Section):
    """The LiDAR and how its scans are used. The robot's lidar_x/y/z_offset are its position."""

    section = "lidar"
    rays: int = Field(64, gt=0, le=10_000)
    """Rays of an observation. The range of a ray is interpolated between the two measurements next
    to it in direction."""
    field_of_view: float = Field(2.0 * math.pi, gt=0.0, le=2.0 * math.pi + 1e-9)
    """Angle covered by the rays, centred on the x axis [rad]. A full turn has no duplicate ray."""
    min_range: Distance = 0.1
    """Smaller measurements are set to this range [m]."""
    max_range: float = Field(5.0, gt=0.0, le=1e3)
    """Larger or failed measurements are set to this range [m], at most 1 km."""
    rate: Rate = 10.0
    """Scans per second [Hz], at most 10,000."""
    noise: Distance = 0.01
    """Standard deviation of simulated ranges [m]. The default is typical of hobby LiDARs at a few
    metres."""
    bias: float = Field(0.0, ge=-1e3, le=1e3)
    """Added to all simulated ranges [m]."""
    dropouts: float = Field(0.0, ge=0.0, lt=1.0)
    """Share of simulated measurements that fail."""
    outliers: Share = 0.0
    """Share of simulated measurements at an edge that lie anywhere between the surfaces in front of
    it and behind it, since the beam meets both."""
    timeout: Wait = 1.0
    """A scan older than this is an error that stops the robot [s], at most 1 h."""

    @model_validator(mode="after")
    def _ranges_and_times_fit(self) -> Self:
        """Check the order of the ranges, and the time-out against the rate."""
        # Measurements are clipped to these two, which must not cross.
        if self.min_range >= self.max_range:
            raise ConfigError(
                f"lidar.min_range = {self.min_range:g}: must be less than lidar.max_range = "
                f"{self.max_range:g} m"
            )
        # A scan that is complete must not be too old already.
        if self.timeout < 1.5 / self.rate:
            raise ConfigError(
                f"lidar.timeout = {self.timeout:g} s: must be at least one and a half periods of "
                f"lidar.rate = {self.rate:g} Hz"
            )
        return self


class WheelMotor(NamedTuple):
    """Motor values of a single wheel. See `MotorConfig`."""

    gain: float
    acceleration: float
    time_constant: float
    deadband: float


class MotorConfig(Section):
    """The motors and their speed control. Four numbers are values of the wheels a to d."""

    section = "motor"
    max_speed: Speed = 30.0
    """Largest wheel speed of the motors [rad/s], at most 1,000."""
    gain: Annotated[PerWheel, per_wheel(Field(gt=0.0, le=100.0))] = 1.0
    """Wheel speed for a set point of 1 rad/s, at most 100. A number, or four."""
    acceleration: Annotated[PerWheel, per_wheel(Field(gt=0.0, le=1e6))] = 60.0
    """Acceleration of the firmware's set point ramp [rad/s^2], at most 1e6. A number, or
    four."""
    time_constant: Annotated[PerWheel, per_wheel(Field(ge=0.0, le=100.0))] = 0.08
    """Time constant of the first-order speed loop [s], at most 100. Hobby motors have 0.05-0.2. A
    number, or four."""
    deadband: Annotated[PerWheel, per_wheel(Field(ge=0.0, le=1e3))] = 0.0
    """Set points times gain below this don't turn the wheel [rad/s], at most 1,000. A number, or
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
    counts_per_revolution: int = Field(1320, gt=0, le=10_000_000)
    """Counts per turn of the wheel, at most ten million."""
    window: float = Field(0.05, gt=0.0, le=5.0)
    """Averaging time of the feedback [s], at most 5 s and 2,000 loops of the firmware."""
    quantum: Factor | None = None
    """Printed speeds are rounded to multiples of this [rad/s], at most 100. None: they are only
    rounded to the two decimals of a line."""


class FirmwareConfig(Section):
    """The program of the microcontroller."""

    section = "firmware"
    loop_rate: Rate = 200.0
    """Rate of its control loop, and of the simulation's substeps [Hz], at most 10,000."""
    feedback_rate: Rate | None = None
    """Feedback lines per second [Hz]. None: as many as ticks of the control rate."""
    processing_time: Delay = 0.00125
    """Time from the last byte of a line to its effect, and from encoder to first byte [s], at most
    1 s."""
    command_delay: Delay = 0.0
    """Further time from the last byte of a command to its effect [s], at most 1 s."""
    delay_samples: Annotated[tuple[Delay, ...], Field(max_length=1_000)] = ()
    """Measured delays of commands on top of `command_delay` [s], as quantiles of equal weight. Only
    randomization uses them: each episode draws a delay."""
    command_timeout: Wait | None = 0.5
    """Motors stop after this time without a valid command [s], at most 1 h. None: never."""


class BodyConfig(Section):
    """Chassis and ground."""

    section = "body"
    mass: float = Field(4.0, gt=0.0, le=1e5)
    """Mass of the whole robot [kg], at most 100 t."""
    length: Length = 0.34
    """Length of the footprint, along x [m]."""
    width: Length = 0.34
    """Width of the footprint over the wheels, along y [m]."""
    height: Length = 0.12
    """Height of the top of the chassis above ground [m]."""
    friction: Factor = 1.0
    """Coulomb friction coefficient between tyre and ground, at most 100."""
    slip_speed: Speed = 0.005
    """Slip speed below which friction is proportional to slip [m/s], at most 1,000."""
    turn_factor: float | None = Field(None, gt=1.0, le=100.0)
    """Factor by which the robot turns slower than the differential-drive formula says, at most 100.
    It sets the tyres' sideways friction: (mu_lateral / mu_longitudinal)^2 =
    (turn_factor - 1) (wheel_separation / wheelbase)^2. None: equal friction in all directions, so
    1 + (wheelbase / wheel_separation)^2. MuJoCo's contacts know neither this nor `slip_speed`."""


# Wiring

WIRE_LETTERS = "abcd"
Letter = Literal["a", "b", "c", "d"]
Sign = Literal[1, -1]
Speeds = tuple[float, float, float, float]
ReportedSpeeds = tuple[float | None, float | None, float | None, float | None]


class WheelConfig(Section):
    """One wheel's motor and encoder on the wire."""

    section = "wheels"
    motor: Letter
    """Letter that commands the motor."""
    motor_sign: Sign = 1
    """-1 if a positive command turns the wheel backward."""
    encoder: Letter
    """Letter that reports the wheel's speed."""
    sign: Sign = 1
    """-1 if the encoder reports a forward turn as negative."""

    @model_validator(mode="wrap")
    @classmethod
    def _as_one_error(cls, data: Any, handler: ModelWrapValidatorHandler[Self]) -> Self:
        """Leave errors to WheelsConfig, which knows the wheel's name."""
        return handler(data)


@dataclass(frozen=True, slots=True)
class WheelLetters:
    """Which letter belongs to each wheel, for one direction of the wire.

    Attributes:
        places: Index of each wheel's letter, in the order of the wheels.
        signs: 1.0 or -1.0 for each wheel.
    """

    places: tuple[int, ...]
    signs: tuple[float, ...]

    def to_wire(self, speeds: Sequence[float]) -> Speeds:
        """Convert speeds of the wheels to those of the letters a, b, c, d [rad/s]."""
        wire = [0.0] * 4
        for place, sign, speed in zip(self.places, self.signs, speeds, strict=True):
            wire[place] = sign * speed + 0.0  # no negative zero
        a, b, c, d = wire
        return a, b, c, d

    def to_wheels(self, wire: ReportedSpeeds) -> ReportedSpeeds:
        """Convert speeds of the letters to those of the wheels [rad/s]. None is a missing speed."""
        a, b, c, d = (
            None if (speed := wire[place]) is None else sign * speed + 0.0
            for place, sign in zip(self.places, self.signs, strict=True)
        )
        return a, b, c, d


def _wire_wheel(letter: Letter) -> WheelConfig:
    return WheelConfig(motor=letter, encoder=letter)


class WheelsConfig(Section):
    """The wiring: letters and signs of each wheel's motor and encoder."""

    section = "wheels"
    a: WheelConfig = _wire_wheel("a")
    """The front right wheel."""
    b: WheelConfig = _wire_wheel("b")
    """The front left wheel."""
    c: WheelConfig = _wire_wheel("c")
    """The rear left wheel."""
    d: WheelConfig = _wire_wheel("d")
    """The rear right wheel."""

    @field_validator("*", mode="before")
    @classmethod
    def _fill_letters(cls, wheel: Any, info: ValidationInfo) -> Any:
        """Set missing letters of a wheel to its own."""
        letter = info.field_name
        usual = {"motor": letter, "encoder": letter}
        return usual | wheel if isinstance(wheel, dict) else wheel

    @model_validator(mode="after")
    def _letters_are_used_once(self) -> Self:
        """Check that no letter belongs to two wheels."""
        for device in ("motor", "encoder"):
            letters = Counter(getattr(wheel, device) for wheel in self.each)
            # Two wheels that share a letter would turn together.
            letter, count = max(letters.items(), key=lambda item: item[1])
            if count > 1:
                raise ConfigError(
                    f"wheels: {device} {letter} belongs to {count} wheels: each letter must be "
                    "used once"
                )
        return self

    @property
    def each(self) -> tuple[WheelConfig, WheelConfig, WheelConfig, WheelConfig]:
        """The wheels in the order a, b, c, d."""
        return self.a, self.b, self.c, self.d

    @property
    def motors(self) -> WheelLetters | None:
        """Letters of the commands. None if each wheel has its own letter, forward."""
        return _letters([(wheel.motor, wheel.motor_sign) for wheel in self.each])

    @property
    def encoders(self) -> WheelLetters | None:
        """Letters of the feedback. None if each wheel has its own letter, forward."""
        return _letters([(wheel.encoder, wheel.sign) for wheel in self.each])


def _letters(wiring: Sequence[tuple[str, int]]) -> WheelLetters | None:
    """Return the mapping of four wheels, None for the identity."""
    # The usual wiring needs no conversion, which every tick would pay for.
    if [letter for letter, sign in wiring if sign == 1] == list(WIRE_LETTERS):
        return None
    letters, signs = zip(*wiring, strict=True)
    return WheelLetters(tuple(map(WIRE_LETTERS.index, letters)), tuple(map(float, signs)))


# ROS 2

JointNames = tuple[Name, Name, Name, Name]
"""Joints of the wheels a, b, c, d. A robot with two driven wheels has the joint of a side twice."""
WHEEL_JOINTS: JointNames = (
    "front_right_wheel_joint",
    "front_left_wheel_joint",
    "rear_left_wheel_joint",
    "rear_right_wheel_joint",
)
_TOPIC = re.compile("/?[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*")


def _topic(name: str) -> str:
    """Return a name that ROS 2 allows. Raises ValueError for any other."""
    if not _TOPIC.fullmatch(name):
        raise ValueError("must be a topic, such as 'cmd_vel' or '/base/cmd_vel'")
    return name


Topic = Annotated[str, Field(max_length=200), AfterValidator(_topic)]
"""Relative to the link's namespace, except for names that start with a slash."""


def list_joints(value: Any) -> Any:
    """Return names in the order a, b, c, d. Raises ValueError if they aren't four, or two sides."""
    if value is None:
        return None
    # A robot with two driven wheels names each side once.
    if isinstance(value, Mapping):
        order = ("right", "left", "left", "right") if "left" in value else tuple(WIRE_LETTERS)
        value = [value[key] for key in order] if value.keys() == {*order} else []
    names = [*value] if isinstance(value, list | tuple) else []
    if len(names) != 4 or not all(isinstance(name, str) and name for name in names):
        raise ValueError("must be four names in the order a, b, c, d, or {left: NAME, right: NAME}")
    # A joint may occur twice, as that of both wheels of a side.
    a, b, c, d = names
    if len({*names}) != 4 and not (a == d != b == c):
        raise ValueError("must name each joint once, or {left: NAME, right: NAME}")
    return a, b, c, d


class Ros2Config(Section):
    """How the link "ros2" reaches a robot that is in ROS 2."""

    section = "ros2"
    joints: Annotated[JointNames | None, BeforeValidator(list_joints)] = None
    """Joints of the wheels in `joint_states`: four names in the order a, b, c, d, a mapping
    {a, b, c, d}, or {left, right} for a robot with two driven wheels. None: `wheel_joints`."""
    command: Literal["twist_stamped", "twist", "wheel_speeds"] | None = None
    """Type of the commands: geometry_msgs/TwistStamped or Twist, or the wheels' speeds [rad/s] as
    std_msgs/Float64MultiArray. None: the type that the robot subscribes to."""
    command_topic: Topic = "cmd_vel"
    """Topic of the commands. Topics are relative to the link's namespace, except for those that
    start with a slash."""
    command_joints: tuple[Name, ...] | None = None
    """Order of the joints in the array of wheel speeds. None: a, b, c, d."""
    joint_states_topic: Topic = "joint_states"
    """Topic of the measured wheels, sensor_msgs/JointState."""
    odom_topic: Topic = "odom"
    """Topic of the robot's odometry, nav_msgs/Odometry."""
    scan_topic: Topic = "scan"
    """Topic of the LiDAR `--lidar ros2`, sensor_msgs/LaserScan."""
    wheel_separation: float | None = Field(None, gt=0.0, le=1000.0)
    """Separation by which the robot's controller converts twists to speeds of wheels, its
    multiplier included [m]. None: that of the robot. Write it as the controller's file has it:
    `identify` and `calibrate` keep it."""
    wheel_radii: tuple[Length, Length] | None = None
    """Radii of the left and right wheels by which the controller converts twists [m]."""
    feedback: Literal["joint_states", "odom"] | None = None
    """Source of the wheels' speeds. None: `joint_states`, or `odom` if no node publishes joint
    states."""
    use_sim_time: bool | None = None
    """Whether the topic /clock is the time. None: it is if a node publishes it."""
    only: bool | None = None
    """Whether the robot can't be simulated, since it has two driven wheels, or since no file has
    its wheelbase. None: it can't if `joints` has a joint for each side."""


# Limits

LINEAR_ACCELERATION = 2.0
"""Default limit [m/s^2]. ROS configurations of mobile bases use 1 to 3."""
ANGULAR_ACCELERATION = 8.0
"""Default limit [rad/s^2]."""


def _not_zero(value: float) -> float:
    """Return an acceleration. Raises ValueError for zero, with which the robot would never move."""
    if value == 0.0:
        raise ValueError("must not be 0")
    return value


Increase = Annotated[float, Field(gt=0.0, le=1e6)]
Decrease = Annotated[float, Field(ge=-1e6, lt=0.0)]
AccelerationLimit = Annotated[float, Field(ge=-1e6, le=1e6), AfterValidator(_not_zero)]
"""An acceleration whose direction follows from its name. Its sign doesn't matter."""


class SpeedLimits(Section):
    """Limits of an axis, with names and meaning of ROS diff_drive_controller. None is no limit.

    Units are m/s or rad/s and their derivatives, at most 1e6. If a minimum is None, it is the
    negative maximum. A twist of zero isn't limited, but sent at once. NaN and a jerk of 0 are None,
    as in ROS.

    Accelerations have the names of Humble, in which `min_acceleration` limits braking and speeding
    up backward, or the names of Jazzy, which distinguishes these two.
    """

    section = "limits"
    max_velocity: float | None = Field(None, ge=0.0, le=1e6)
    """Forward or counter-clockwise."""
    min_velocity: float | None = Field(None, ge=-1e6, le=0.0)
    """Backward or clockwise. Not positive."""
    max_acceleration: Increase | None = None
    """For speeding up forward, and in the names of Humble also for braking backward."""
    min_acceleration: Decrease | None = None
    """A name of Humble. Negative, and an error next to a name of Jazzy."""
    max_deceleration: AccelerationLimit | None = None
    """For braking forward. None: as `max_acceleration`."""
    max_acceleration_reverse: AccelerationLimit | None = None
    """For speeding up backward. None: as `max_acceleration`."""
    max_deceleration_reverse: AccelerationLimit | None = None
    """For braking backward. None: as `max_deceleration`."""
    max_jerk: Increase | None = None
    """How fast the acceleration may grow [m/s^3 or rad/s^3]."""
    min_jerk: Decrease | None = None
    """How fast the acceleration may fall. Negative."""

    @field_validator("*", mode="before")
    @classmethod
    def _without_unset(cls, value: Any, info: ValidationInfo) -> Any:
        """Return None for ROS's words for no limit."""
        # ROS writes NaN, and for jerks 0, for no limit.
        is_number = isinstance(value, float | int)
        is_jerk = str(info.field_name).endswith("_jerk")
        return None if is_number and (math.isnan(value) or (is_jerk and not value)) else value

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
    """Return a validator that sets a missing `max_acceleration` to this limit. Null stays null."""

    def complete(value: Any) -> Any:
        # An object states all of its fields, also those that are None.
        if isinstance(value, SpeedLimits):
            return value.model_dump()
        return {"max_acceleration": limit} | value if isinstance(value, dict) else value

    return BeforeValidator(complete)


class Geofence(Section):
    """A rectangle in the odometry frame [m]. The robot is stopped outside of it."""

    section = "geofence"
    min_x: float = -math.inf
    """Smallest x [m]. Negative."""
    max_x: float = math.inf
    """Largest x [m]. Positive."""
    min_y: float = -math.inf
    """Smallest y [m]. Negative."""
    max_y: float = math.inf
    """Largest y [m]. Positive."""
    # An infinite side is open.
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
    """The 95 % interval of a measured value, and its sources."""

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
    """Raise ConfigError if an interval isn't of a number of the model, or has a bad end."""
    for name, interval in measured.items():
        adapter = _find_number(model, name)
        if adapter is None:
            raise ConfigError(f"measured: unknown field {name[:60]!r}: must be like 'motor.gain.a'")

        # Both ends have the bounds of the field itself.
        for end in ("low", "high"):
            value = getattr(interval, end)
            try:
                adapter.validate_python(value)
            except ValidationError as error:
                allowed = error.errors(include_url=False)[0]["msg"].removeprefix("Input should ")
                raise ConfigError(f"measured.{name}.{end} = {value:g}: must {allowed}") from error


@functools.lru_cache(maxsize=256)
def _find_number(model: type[Section], name: str) -> TypeAdapter[Any] | None:
    """The validator of a field by its dotted name, None for an unknown name."""
    first, _, inner = name.partition(".")
    # Dotted names lead through the sections to a field.
    field = model.model_fields.get(first)
    if field is None:
        return None
    if isinstance(field.annotation, type) and issubclass(field.annotation, Section):
        return _find_number(field.annotation, inner)
    if inner and not (field.annotation == PerWheel and inner in WIRE_LETTERS):
        return None
    if field.annotation is int:  # the ends of its interval needn't be whole
        return TypeAdapter(float)
    number: Any = Annotated[field.annotation, *field.metadata, Field()]
    return TypeAdapter(number)


def update_measured(
    measured: Mapping[str, Measured], findings: Mapping[str, Measured | None]
) -> dict[str, Measured]:
    """Return the intervals of a robot after new findings, for its field `measured`.

    An interval for all wheels replaces those of single wheels. An interval of a single wheel
    leaves the other wheels theirs.

    Args:
        measured: Intervals before.
        findings: New intervals by the names of their fields. None removes an interval.
    """
    result = dict(measured)
    # Split an interval of all wheels before one of them gets its own.
    for name in findings:
        field, _, wheel = name.rpartition(".")
        if wheel in WIRE_LETTERS and field in result:
            shared = result.pop(field)
            result = {f"{field}.{letter}": shared for letter in WIRE_LETTERS} | result
        # What was measured before of the same wheels is outdated.
        for outdated in (name, *(f"{name}.{letter}" for letter in WIRE_LETTERS)):
            result.pop(outdated, None)
    return result | {name: interval for name, interval in findings.items() if interval is not None}
