"""Frozen, validated parameters of the robot and of its simulated twin.

The first block of `RobotConfig` is what the robot's own driver reads from its URDF; the sections
(`motor`, `encoder`, `firmware`, `body`) describe what stands on the other side of the wire and are
used by simulated links only; `lidar` is the range sensor, simulated or real. Every bad value is one
`ConfigError` that names field, value and what is allowed.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Self

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    ModelWrapValidatorHandler,
    ValidationError,
    model_validator,
)

from acsar_gym.errors import ConfigError, shown, suggestion

BAUD_RATES = (9600, 19200, 38400, 57600, 115200)
FOOT = 0.01
"""What a wheel takes of the footprint where it stands beyond the body [m]."""
LINE_BYTES = 33
"""Length of a full line with its line end, without the optional trailing comma."""
USUAL_RATES = (200.0, 100.0, 50.0, 40.0, 25.0, 20.0, 10.0, 5.0, 2.0, 1.0)
"""Rates that messages suggest [Hz]."""
BITS_PER_BYTE = 10
"""8N1: a start bit, eight data bits, a stop bit."""
LEAST_RATE = 0.01
"""Of ticks and of a policy's steps [Hz]: slower ones would simulate for ever."""
MOST_TOLD = 10
"""Problems of a config that one message tells."""
MOST_SAMPLES = 2_000
"""Encoder readings that the simulated firmware remembers for its window."""

Length = Annotated[float, Field(gt=0.0, le=100.0)]
"""[m]"""
Place = Annotated[float, Field(ge=-100.0, le=100.0)]
"""[m]"""
Speed = Annotated[float, Field(gt=0.0, le=1e3)]
"""[m/s] or [rad/s]"""
Rate = Annotated[float, Field(gt=0.0, le=1e4)]
"""[Hz]"""
Wait = Annotated[float, Field(gt=0.0, le=3600.0)]
"""At most an hour [s]."""
Name = Annotated[str, Field(max_length=1000)]


def _known_baud(value: int) -> int:
    if value not in BAUD_RATES:
        raise ValueError(f"must be one of {', '.join(map(str, BAUD_RATES))}")
    return value


class _Section(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
    section: ClassVar[str] = ""
    """Name of the field of RobotConfig that holds this section."""

    @model_validator(mode="wrap")
    @classmethod
    def _as_one_error(cls, data: Any, handler: ModelWrapValidatorHandler[Self]) -> Self:
        try:
            return handler(data)
        except ValidationError as error:
            raise ConfigError(_describe(cls, cls.section, error)) from None


class MotorConfig(_Section):
    """The motors and their speed loop."""

    section = "motor"
    max_speed: Speed = 30.0
    """Fastest wheel speed the motors reach [rad/s], at most 1,000."""
    acceleration: Annotated[float, Field(gt=0.0, le=1e6)] = 60.0
    """Slope at which the firmware ramps its set point [rad/s^2], at most 1e6."""
    time_constant: Annotated[float, Field(ge=0.0, le=100.0)] = 0.08
    """First-order lag of the speed loop [s]; published hobby figures are 0.05-0.2, at most 100."""
    deadband: Annotated[float, Field(ge=0.0, le=1e3)] = 0.0
    """Set points below this don't turn the wheel [rad/s], at most 1,000."""


class EncoderConfig(_Section):
    """The wheel encoders, as the firmware reads them."""

    section = "encoder"
    counts_per_revolution: Annotated[int, Field(gt=0, le=10_000_000)] = 1320
    """Counts per turn of the wheel, at most ten million."""
    window: Annotated[float, Field(gt=0.0, le=5.0)] = 0.05
    """Time over which the firmware averages before it sends [s]: at most 5 s and 2,000 loops."""


class FirmwareConfig(_Section):
    """The microcontroller's program."""

    section = "firmware"
    loop_rate: Rate = 200.0
    """Rate of its control loop, and of the simulation's substeps [Hz], at most 10,000."""
    feedback_rate: Rate | None = None
    """Feedback lines per second [Hz]; None: one per tick of the control rate."""
    processing_time: Annotated[float, Field(ge=0.0, le=1.0)] = 0.00125
    """Time from the last byte of a line to its effect, and from encoder to first byte [s], at most
    1 s."""
    command_timeout: Wait | None = 0.5
    """Motors stop when no valid command came for so long [s], at most an hour; None: they never
    do."""


class BodyConfig(_Section):
    """Chassis and ground."""

    section = "body"
    mass: Annotated[float, Field(gt=0.0, le=1e5)] = 4.0
    """Whole robot [kg], at most 100 t."""
    length: Length = 0.34
    """Footprint along x [m], as all lengths at most 100 m."""
    width: Length = 0.34
    """Footprint along y, over the wheels [m]."""
    height: Length = 0.12
    """Top of the chassis above ground [m]."""
    friction: Annotated[float, Field(gt=0.0, le=100.0)] = 1.0
    """Coulomb friction of tyre on ground, at most 100."""
    slip_speed: Speed = 0.005
    """Slip below which friction falls off linearly [m/s], at most 1,000."""


class SpeedLimits(_Section):
    """Limits of one axis, named and behaving as in ROS diff_drive_controller; None is no limit.

    m/s or rad/s, and their derivatives, at most 1e6. A minimum that is None is minus the maximum.
    """

    section = "limits"
    max_velocity: Annotated[float, Field(ge=0.0, le=1e6)] | None = None
    min_velocity: Annotated[float, Field(ge=-1e6, le=0.0)] | None = None
    max_acceleration: Annotated[float, Field(gt=0.0, le=1e6)] | None = None
    min_acceleration: Annotated[float, Field(ge=-1e6, lt=0.0)] | None = None
    max_jerk: Annotated[float, Field(gt=0.0, le=1e6)] | None = None
    min_jerk: Annotated[float, Field(ge=-1e6, lt=0.0)] | None = None


class Geofence(_Section):
    """A rectangle of the odometry frame [m]; outside of it the robot is commanded to stop."""

    section = "geofence"
    min_x: float = -math.inf
    max_x: float = math.inf
    min_y: float = -math.inf
    max_y: float = math.inf
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=True)

    @model_validator(mode="after")
    def _holds_the_start(self) -> Self:
        if not (self.min_x < 0.0 < self.max_x and self.min_y < 0.0 < self.max_y):
            raise ConfigError(
                f"geofence = {self.min_x:g} to {self.max_x:g}, {self.min_y:g} to {self.max_y:g} m: "
                "must have the start (0, 0) inside"
            )
        return self


class LidarConfig(_Section):
    """The LiDAR and how its scans are used; its place is lidar_x/y/z_offset of the robot."""

    section = "lidar"
    rays: Annotated[int, Field(gt=0, le=10_000)] = 64
    """Directions of an observation; each takes the measurement next to it."""
    field_of_view: Annotated[float, Field(gt=0.0, le=2.0 * math.pi + 1e-9)] = 2.0 * math.pi
    """Centred on the robot's x axis [rad]; a full turn has no direction twice."""
    min_range: Annotated[float, Field(ge=0.0, le=1e3)] = 0.1
    """Nearer measurements are taken for this range [m]."""
    max_range: Annotated[float, Field(gt=0.0, le=1e3)] = 5.0
    """What is farther, or not measured at all, has this range [m], at most 1 km."""
    rate: Rate = 10.0
    """Scans per second [Hz], at most 10,000."""
    noise: Annotated[float, Field(ge=0.0, le=1e3)] = 0.01
    """Standard deviation of a simulated range [m]; that of a hobby LiDAR at a few metres."""
    dropouts: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.0
    """Share of simulated rays that come back without a range."""
    timeout: Wait = 1.0
    """A scan older than this is an error that stops the robot [s], at most an hour."""

    @model_validator(mode="after")
    def _ranges_and_times_fit(self) -> Self:
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


class RobotConfig(_Section):
    """One robot: geometry, wire, limits, and its twin. Lengths in m, speeds in rad/s or m/s.

    Lengths are at most 100 m, speeds 1,000, rates 10,000 Hz, and times an hour.
    """

    wheel_radius: Length = 0.05
    """[m]"""
    wheel_separation: Length = 0.3
    """Distance between the centres of left and right wheels [m]."""
    wheelbase: Length = 0.22
    """Distance between the front and the rear axle [m]; used by the simulation."""
    wheel_separation_multiplier: Annotated[float, Field(gt=0.0, le=100.0)] = 1.0
    """As in ROS diff_drive_controller. For equal loads 1 + (wheelbase / wheel_separation)^2."""
    serial_port: Name | None = None
    """Device for `open_link("serial", config)`; there is no default."""
    baud_rate: Annotated[int, AfterValidator(_known_baud)] = 115200
    """Bits per second, 8N1, no flow control."""
    trailing_comma: bool = False
    """Send a comma after the last motor too, as the robot's own driver does."""
    control_rate: Rate = 100.0
    """Ticks per second: one command line each [Hz]."""
    connect_timeout: Wait = 5.0
    """How long activation waits for the board's first valid line [s]; AVR boards reset on open."""
    reconnect_timeout: Annotated[float, Field(ge=0.0, le=3600.0)] = 10.0
    """A port that was lost has so long to come back at the next activation [s]."""
    feedback_timeout: Wait = 0.5
    """Feedback older than this stops the robot with an error [s]."""
    watchdog_timeout: Annotated[float, Field(ge=0.01, le=60.0)] | None = 0.15
    """Commands that stop coming for so long mean that the program hangs: a process of its own
    commands zero [s], 0.01 to 60; None: no watchdog."""
    max_linear: Speed = 0.5
    """Linear speed of a full action [m/s]."""
    max_angular: Speed = 1.5
    """Angular speed of a full action [rad/s]."""
    max_wheel_speed: Speed = 30.0
    """Wheel speeds of a twist shrink to this, keeping the turn radius [rad/s]."""
    linear_limits: SpeedLimits = SpeedLimits()
    """Of the linear velocity that is commanded, in simulation and on hardware."""
    angular_limits: SpeedLimits = SpeedLimits()
    """Of the angular velocity that is commanded."""
    geofence: Geofence | None = None
    """Where the robot may go, by odometry."""
    odom_frame: Name = "odom"
    base_frame: Name = "base_link"
    lidar_frame: Name = "lidar_link"
    lidar_x_offset: Place = -0.15
    """[m] in the base frame, as the two below."""
    lidar_y_offset: Place = 0.0
    lidar_z_offset: Place = 0.37
    motor: MotorConfig = MotorConfig()
    encoder: EncoderConfig = EncoderConfig()
    firmware: FirmwareConfig = FirmwareConfig()
    body: BodyConfig = BodyConfig()
    lidar: LidarConfig = LidarConfig()

    @model_validator(mode="after")
    def _wire_is_fast_enough(self) -> Self:
        line = LINE_BYTES + self.trailing_comma
        lines = self.baud_rate / (BITS_PER_BYTE * line)
        for field, rate in (
            ("control_rate", self.control_rate),
            ("firmware.feedback_rate", self.feedback_rate),
        ):
            if rate > lines:
                enough = [b for b in BAUD_RATES if b >= rate * BITS_PER_BYTE * line]
                hint = f"baud_rate {enough[0]} or more, or " if enough else ""
                loop = self.firmware.loop_rate
                fits = max((r for r in USUAL_RATES if r <= lines and loop % r == 0), default=1.0)
                raise ConfigError(
                    f"baud_rate = {self.baud_rate}: carries {int(lines)} lines of {line} bytes a "
                    f"second, {field} needs {rate:g}; use {hint}{field} = {fits:g} or less"
                )
        return self

    @model_validator(mode="after")
    def _rates_are_whole(self) -> Self:
        loop = self.firmware.loop_rate
        whole_ratio("firmware.loop_rate", loop, "control_rate", self.control_rate)
        if self.feedback_rate > loop:
            raise ConfigError(
                f"firmware.feedback_rate = {self.feedback_rate:g} Hz: must be at most "
                f"firmware.loop_rate = {loop:g} Hz"
            )
        if self.feedback_timeout < 1.5 / self.feedback_rate:
            raise ConfigError(
                f"feedback_timeout = {self.feedback_timeout:g} s: must be at least one and a half "
                f"periods of the feedback at {self.feedback_rate:g} Hz"
            )
        if self.encoder.window * loop < 1.0 - 1e-9:
            raise ConfigError(
                f"encoder.window = {self.encoder.window:g} s: must be at least one period of "
                f"firmware.loop_rate ({1.0 / loop:g} s)"
            )
        if self.encoder.window * loop > MOST_SAMPLES:
            raise ConfigError(
                f"encoder.window = {self.encoder.window:g} s: must be at most {MOST_SAMPLES:,} "
                f"periods of firmware.loop_rate ({MOST_SAMPLES / loop:g} s)"
            )
        return self

    @property
    def feedback_rate(self) -> float:
        """Feedback lines per second that the board sends [Hz]."""
        return self.firmware.feedback_rate or self.control_rate

    @property
    def period(self) -> float:
        """Length of a tick [s]."""
        return 1.0 / self.control_rate

    @property
    def footprint(self) -> tuple[float, float]:
        """Length and width of what must not touch anything: the body, and wheels beyond it [m]."""
        return (
            max(self.body.length, self.wheelbase + FOOT),
            max(self.body.width, self.wheel_separation + FOOT),
        )

    @property
    def effective_separation(self) -> float:
        """wheel_separation * wheel_separation_multiplier [m]."""
        return self.wheel_separation * self.wheel_separation_multiplier

    def with_(self, **changes: Any) -> RobotConfig:
        """A validated copy with some fields changed; a dict changes fields of a section."""
        fields = self.model_dump()
        for name, value in changes.items():
            nested = isinstance(value, dict) and isinstance(fields.get(name), dict)
            fields[name] = {**fields[name], **value} if nested else value
        return RobotConfig(**fields)

    @classmethod
    def load(cls, path: str | Path) -> RobotConfig:
        """Read a `.yaml` file, or the `<ros2_control>` parameters of a `.urdf` file.

        A URDF without a baud_rate means 9600 baud, as it does for the robot's own driver, and a
        control_rate of 20 Hz unless it names one.

        Raises ConfigError where the file is missing, malformed, or holds a bad value.
        """
        from acsar_gym import config_files  # noqa: PLC0415 - only loading needs the parsers

        if not isinstance(path, str | Path):
            raise ConfigError(f"path = {shown(path)}: must be a file's name")
        return config_files.load(Path(path))

    @classmethod
    def preset(cls, name: str) -> RobotConfig:
        """A robot that comes with the package, such as "acsar"."""
        from acsar_gym import config_files  # noqa: PLC0415

        return config_files.preset(name)

    @classmethod
    def of(cls, robot: RobotSource) -> RobotConfig:
        """From what users may pass as `robot=`: config, fields, file, preset, or None for acsar."""
        if isinstance(robot, RobotConfig):
            return robot
        if isinstance(robot, Mapping):
            return cls.model_validate(dict(robot))
        if robot is None:
            return cls.preset("acsar")
        if not isinstance(robot, str | Path):
            raise ConfigError(
                f"robot = {shown(robot)}: must be a RobotConfig, its fields, a preset or a file"
            )
        if isinstance(robot, Path) or Path(robot).suffix or "/" in robot:
            return cls.load(robot)
        return cls.preset(robot)


RobotSource = RobotConfig | Mapping[str, Any] | str | Path | None
"""What users may pass as `robot=`; see `RobotConfig.of`."""


def whole_ratio(fast_name: str, fast: float, slow_name: str, slow: float) -> int:
    """The ratio fast / slow as an int.

    Raises ConfigError unless it is a whole number of at least 1, or where slow is below 0.01 Hz.
    """
    try:
        fast, slow = _number(fast), _number(slow)
        ratio = fast / slow
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        ratio = math.nan
    if not ratio > 0.0:
        raise ConfigError(f"{slow_name} = {shown(slow)}: must be a positive number of Hz")
    if slow < LEAST_RATE:
        raise ConfigError(f"{slow_name} = {slow:g} Hz: must be at least {LEAST_RATE:g} Hz")
    whole = round(min(ratio, 1e9))
    if whole < 1 or not math.isclose(ratio, whole, rel_tol=1e-9):
        raise ConfigError(
            f"{fast_name} = {fast:g} Hz: must be a whole multiple of {slow_name} = {slow:g} Hz"
        )
    return whole


def _number(value: float) -> float:
    if isinstance(value, str | bytes):
        raise TypeError
    return float(value)


def _describe(model: type[BaseModel], section: str, error: ValidationError) -> str:
    found = error.errors(include_url=False, include_context=False)
    parts = [_problem(model, section, item) for item in found[:MOST_TOLD]]
    if len(found) > MOST_TOLD:
        parts.append(f"and {len(found) - MOST_TOLD:,} more")
    return "; ".join(parts)


def _problem(model: type[BaseModel], section: str, item: Any) -> str:
    path = [str(part)[:40] for part in item["loc"]]
    field = ".".join([section, *path] if section else path)
    if item["type"] == "extra_forbidden":
        near = suggestion(str(item["loc"][-1])[:40], model.model_fields)
        return f"unknown field {field!r}{near}"
    allowed = item["msg"].removeprefix("Value error, ").removeprefix("Input should ")
    return f"{field} = {shown(item['input'])}: {_must(allowed)}"


def _must(allowed: str) -> str:
    return f"must {allowed}" if allowed.startswith("be") else allowed
