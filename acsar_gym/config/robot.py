"""Configuration of a robot: geometry, serial link, limits, LiDAR, and its simulation."""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar, Self

from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from acsar_gym.config.footprint import Corners, Outline, make_rectangle
from acsar_gym.config.section import Factor, Length, Name, Offset, Rate, Section, Speed, Wait
from acsar_gym.config.sections import (
    ANGULAR_ACCELERATION,
    LINEAR_ACCELERATION,
    MANY_ROBOTS,
    SIX_NUMBERS,
    WHEEL_JOINTS,
    AngularLimits,
    BodyConfig,
    EncoderConfig,
    FirmwareConfig,
    Geofence,
    JointNames,
    LidarConfig,
    LinearLimits,
    LogHashes,
    Measured,
    MotorConfig,
    Ros2Config,
    WheelsConfig,
    default_acceleration,
    list_joints,
    validate_measured,
)
from acsar_gym.errors import ConfigError, show_value

MISFIT = "doesn't fit: "
"""Start of the `motor_fit` of a robot whose motors or board respond differently than simulated."""
LEAST_RATE = 0.01
"""Lowest rate of ticks and policy steps [Hz], which bounds the simulated time of a step."""
MAX_ENCODER_SAMPLES = 2_000
"""Most encoder readings that the simulated firmware stores for averaging."""


def whole_ratio(fast_name: str, fast: float, slow_name: str, slow: float) -> int:
    """Return the ratio of two rates.

    Args:
        fast_name: Name of the faster rate, for the message.
        fast: The faster rate [Hz].
        slow_name: Name of the slower rate, for the message.
        slow: The slower rate [Hz].

    Returns:
        The ratio fast / slow as an int.

    Raises:
        ConfigError: The ratio isn't an integer of at least 1, or `slow` is below 0.01 Hz.
    """
    ratio = math.nan
    # float() also parses text, which isn't a rate.
    if not isinstance(fast, str | bytes) and not isinstance(slow, str | bytes):
        with contextlib.suppress(TypeError, ValueError, ZeroDivisionError, OverflowError):
            ratio = float(fast) / float(slow)
    if not ratio > 0.0:
        raise ConfigError(f"{slow_name} = {show_value(slow)}: must be a positive number of Hz")
    if slow < LEAST_RATE:
        raise ConfigError(f"{slow_name} = {slow:g} Hz: must be at least {LEAST_RATE:g} Hz")

    # Rates like 1 / 0.03 are whole multiples up to rounding.
    nearest = round(min(ratio, 1e9))
    if nearest < 1 or not math.isclose(ratio, nearest, rel_tol=1e-9):
        raise ConfigError(
            f"{fast_name} = {fast:g} Hz: must be a whole multiple of {slow_name} = {slow:g} Hz"
        )
    return nearest


BAUD_RATES = (9600, 19200, 38400, 57600, 115200)
LINE_BYTES = 33
"""Length of a full line with CR LF, without the optional trailing comma [bytes]."""
BITS_PER_BYTE = 10
"""Format 8N1: a start bit, eight data bits, a stop bit."""


def validate_baud_rate(value: int) -> int:
    """Return the baud rate. Raises ValueError for rates that boards don't use."""
    if value not in BAUD_RATES:
        raise ValueError(f"must be one of {', '.join(map(str, BAUD_RATES))}")
    return value


CONTACT_PATCH = 0.01
"""Size of the contact patch of a wheel, which the default footprint contains [m]."""
HINTS = {
    "wheel_base": "write wheel_separation for the distance between left and right wheels, or "
    "wheelbase for that between the axles",
    "wheel_diameter": "write wheel_radius, half of it",
    "wheel_track": "write wheel_separation",
    "track_width": "write wheel_separation",
    "robot_radius": "write footprint, the corners around it",
}
"""What to write instead of fields of other programs, some of which call the track wheel_base."""


class RobotConfig(Section):
    """A robot: geometry, serial link, limits, and simulation. Units: m, m/s and rad/s.

    Speeds are at most 1,000, rates 10,000 Hz, times 1 h and lengths 100 m, and wheels have a radius
    of 5 mm to 1 m.

    Example:
        >>> from acsar_gym import RobotConfig
        >>> config = RobotConfig(wheel_radius=0.06, serial_port="/dev/ttyUSB0")
        >>> config.with_(lidar={"noise": 0.0}).wheel_radius
        0.06
    """

    hints: ClassVar[Mapping[str, str]] = HINTS

    wheel_radius: float = Field(0.05, ge=0.005, le=1.0)
    """Radius of the wheels [m]. A number in centimetres is out of range."""
    wheel_separation: Length = 0.3
    """Distance between the centres of left and right wheels [m]."""
    wheelbase: Length = 0.22
    """Distance between the front and the rear axle [m], used by the simulation."""
    wheel_separation_multiplier: Factor = 1.0
    """Factor for skidding, as in ROS diff_drive_controller. With equal wheel loads it is
    1 + (wheelbase / wheel_separation)^2."""
    left_wheel_radius_multiplier: Factor = 1.0
    """Factor from `wheel_radius` to the radius of the left wheels, as in ROS
    diff_drive_controller. Driver and simulation use both factors."""
    right_wheel_radius_multiplier: Factor = 1.0
    """Factor from `wheel_radius` to the radius of the right wheels."""
    name: Name = ""
    """Name of the robot in the files of policies and in datasets."""
    serial_port: Name | None = None
    """Device that `open_link("serial", config)` opens."""
    baud_rate: Annotated[int, AfterValidator(validate_baud_rate)] = 115200
    """Baud rate [bit/s]. The format is 8N1, without flow control."""
    trailing_comma: bool = True
    """Send a comma after the last motor, as the robot's own driver does. Some boards use a value
    only after its comma."""
    control_rate: Rate = 100.0
    """Ticks per second [Hz]. Each tick sends a command line."""
    late_after: float = Field(0.2, gt=0.0, le=1.0)
    """A tick is late if it ends more than this share of a control period after its deadline. A
    smaller delay has no measurable effect on drives and their odometry
    (`pytest -s -m slow tests/links/test_lateness.py`)."""
    connect_timeout: Wait = 5.0
    """Longest wait for the first valid line after opening [s]. AVR boards reset when they are
    opened."""
    reconnect_timeout: float = Field(10.0, ge=0.0, le=3600.0)
    """Longest wait at the next activation for a lost port to come back [s]."""
    feedback_timeout: Wait = 0.5
    """Feedback older than this stops the robot with an error [s]."""
    watchdog_timeout: float | None = Field(0.15, ge=0.01, le=60.0)
    """If the driving process hangs for this time while wheels turn, the watchdog process sends zero
    commands [s], 0.01 to 60. If the process died, it does so at once. None: no watchdog."""
    wheel_check: bool = True
    """Stop a real robot with an error that names the wheel if measured wheel speeds contradict the
    commands."""
    max_linear: Speed = 0.5
    """Linear speed of a full action, and limit of all commands [m/s]."""
    max_angular: Speed = 1.5
    """Angular speed of a full action, and limit of all commands [rad/s]."""
    max_wheel_speed: Speed = 30.0
    """Limit of wheel speeds [rad/s]. All four are scaled, which keeps the turning radius."""
    linear_limits: Annotated[LinearLimits, default_acceleration(LINEAR_ACCELERATION)] = (
        LinearLimits(max_acceleration=LINEAR_ACCELERATION)
    )
    """Limits of the commanded linear velocity, in simulation and on hardware. `max_acceleration` is
    2 m/s^2 by default, and null means no limit."""
    angular_limits: Annotated[AngularLimits, default_acceleration(ANGULAR_ACCELERATION)] = (
        AngularLimits(max_acceleration=ANGULAR_ACCELERATION)
    )
    """Limits of the commanded angular velocity. `max_acceleration` is 8 rad/s^2 by default."""
    geofence: Geofence | None = None
    """Area that the robot may not leave, by odometry. None: no limit."""
    odom_frame: Name = "odom"
    """Name of the odometry frame in recordings."""
    base_frame: Name = "base_link"
    """Name of the base frame in recordings."""
    lidar_frame: Name = "lidar_link"
    """Name of the LiDAR's frame in recordings."""
    lidar_x_offset: Offset = -0.15
    """x of the LiDAR in the base frame [m], forward."""
    lidar_y_offset: Offset = 0.0
    """y of the LiDAR in the base frame [m], to the left."""
    lidar_z_offset: Offset = 0.37
    """z of the LiDAR in the base frame [m], up."""
    lidar_yaw: float | None = Field(None, ge=-2.0 * math.pi, le=2.0 * math.pi)
    """Direction of a real LiDAR's zero, counter-clockwise from the robot's x axis [rad]. None: 0
    for a LiDAR on a serial port, while a LiDAR in ROS needs a transform on /tf_static."""
    footprint: Corners | None = None
    """Footprint for collisions: convex polygon of 3 to 100 corners (x, y) in order, in the base
    frame [m], with the origin inside. A list, or a string like
    "[[0.2, 0.1], [-0.2, 0.1], [0.0, -0.2]]". None: the rectangle around body and wheels."""
    wheel_joints: Annotated[JointNames, BeforeValidator(list_joints)] = WHEEL_JOINTS
    """Names of the joints of the wheels a, b, c, d in ROS."""
    wheels: WheelsConfig = WheelsConfig()
    """Letters and signs of motors and encoders, if the board is wired differently."""
    ros2: Ros2Config = Ros2Config()
    """Names and topics of a robot that is in ROS 2, for the link "ros2"."""
    motor: MotorConfig = MotorConfig()
    """Motors and their speed control, as simulated."""
    encoder: EncoderConfig = EncoderConfig()
    """Wheel encoders, as simulated."""
    firmware: FirmwareConfig = FirmwareConfig()
    """Program of the microcontroller, as simulated."""
    body: BodyConfig = BodyConfig()
    """Chassis and ground, as simulated."""
    lidar: LidarConfig = LidarConfig()
    """Range sensor, simulated or real."""
    measured: dict[str, Measured] = Field(default_factory=dict, max_length=1_000)
    """95 % intervals of measured fields, by dotted name, such as "wheel_separation_multiplier",
    "motor.time_constant.a" or "firmware.command_delay". Randomization can take its ranges from
    them."""
    motor_fit: Name = ""
    """Whether motors and board respond as simulated, by `acsar-gym identify`: "fits", or
    "doesn't fit: " and the difference. Empty: it wasn't checked."""
    motor_fit_logs: LogHashes = ()
    """Logs from which `motor_fit` was found: first 16 hex digits of the SHA-256 of each log."""

    def __hash__(self) -> int:
        """Hash some fields, since `measured` has no hash."""
        return hash((self.name, self.wheel_radius, self.wheelbase, self.max_linear, self.motor))

    @model_validator(mode="after")
    def _measured_fields_exist(self) -> Self:
        """Check the names of measured fields, and that their intervals are within their bounds."""
        validate_measured(self.measured, type(self))
        return self

    @model_validator(mode="after")
    def _wire_is_fast_enough(self) -> Self:
        """Check that the baud rate can carry the lines of the control and feedback rates."""
        # Commands and feedback have the same format, each on its own line of the cable.
        line = LINE_BYTES + self.trailing_comma
        lines = self.baud_rate / (BITS_PER_BYTE * line)
        rates = {"control_rate": self.control_rate, "firmware.feedback_rate": self.feedback_rate}
        for field, rate in rates.items():
            if rate > lines:
                enough = [baud for baud in BAUD_RATES if baud >= rate * BITS_PER_BYTE * line]
                hint = f"baud_rate {enough[0]} or more, or " if enough else ""
                raise ConfigError(
                    f"baud_rate = {self.baud_rate}: carries {int(lines)} lines of {line} bytes a "
                    f"second, {field} needs {rate:g}; use {hint}a {field} of at most {int(lines)}"
                )
        return self

    @model_validator(mode="after")
    def _rates_fit(self) -> Self:
        """Check that the rates are integer multiples, and time-out and averaging window fit."""
        loop = self.firmware.loop_rate
        rate = self.feedback_rate
        whole_ratio("firmware.loop_rate", loop, "control_rate", self.control_rate)
        if rate > loop:
            raise ConfigError(
                f"firmware.feedback_rate = {rate:g} Hz: must be at most "
                f"firmware.loop_rate = {loop:g} Hz"
            )
        if self.feedback_timeout < 1.5 / rate:
            raise ConfigError(
                f"feedback_timeout = {self.feedback_timeout:g} s: must be at least one and a half "
                f"periods of the feedback at {rate:g} Hz"
            )

        # The simulated firmware averages over whole loops.
        window = self.encoder.window
        if not 1.0 - 1e-9 <= window * loop <= MAX_ENCODER_SAMPLES:
            raise ConfigError(
                f"encoder.window = {window:g} s: must be 1 to {MAX_ENCODER_SAMPLES:,} periods of "
                f"firmware.loop_rate ({1.0 / loop:g} s)"
            )
        return self

    @model_validator(mode="after")
    def _commanded_joints_are_the_wheels(self) -> Self:
        """Check that the array of wheel speeds has the joint of each wheel once."""
        commanded = self.ros2.command_joints
        joints = self.ros_joints
        if commanded is not None and sorted(commanded) != sorted({*joints}):
            raise ConfigError(
                f"ros2.command_joints = {show_value([*commanded])}: must be the wheels' joints, "
                f"each once: {', '.join(dict.fromkeys(joints))}"
            )
        return self

    @property
    def ros_joints(self) -> JointNames:
        """Joints of the wheels a, b, c, d in ROS 2. Two wheels have the joint of a side twice."""
        return self.ros2.joints or self.wheel_joints

    @property
    def has_two_wheels(self) -> bool:
        """Whether ROS 2 has a single joint for each side, which b and c, and a and d share."""
        return len({*self.ros_joints}) == 2

    def check_four_wheels(self) -> None:
        """Raise ConfigError for a robot with two driven wheels, which only ROS 2 drives."""
        if self.has_two_wheels and self.ros2.only is not False:
            joints = ", ".join(self.ros_joints[:2])
            raise ConfigError(
                f"this robot has two driven wheels ({joints}): only robots with four "
                "driven wheels that skid are simulated or driven over a serial port; --link ros2 "
                "drives it"
            )

    def check_simulated(self) -> None:
        """Raise ConfigError for a robot that can only be driven in ROS 2, not simulated."""
        self.check_four_wheels()
        if self.ros2.only:
            raise ConfigError(
                "no file has the wheelbase of this robot, so only --link ros2 drives it; for a "
                f"simulation, {SIX_NUMBERS}"
            )

    @property
    def misfit(self) -> str:
        """A line about how motors or board respond differently than simulated, or empty."""
        fit = self.motor_fit
        return f"this robot's simulation {fit}" if fit.startswith(MISFIT) else ""

    @property
    def feedback_rate(self) -> float:
        """Feedback lines per second that the board sends [Hz]."""
        return self.firmware.feedback_rate or self.control_rate

    @property
    def period(self) -> float:
        """Duration of a tick [s]."""
        return 1.0 / self.control_rate

    @property
    def line_time(self) -> float:
        """Duration of a line on the wire [s]."""
        return (LINE_BYTES + self.trailing_comma) * BITS_PER_BYTE / self.baud_rate

    @property
    def wire_time(self) -> float:
        """Time from sending a line until it is used, without extra latency or delay [s]."""
        return self.line_time + self.firmware.processing_time

    @property
    def late_tick(self) -> float:
        """Time after its deadline from which a tick is late [s]."""
        return self.late_after * self.period

    @property
    def outline(self) -> Outline:
        """Corners of the footprint in the base frame, counter-clockwise [m]."""
        # Wheels may be outside of the body.
        length = max(self.body.length, self.wheelbase + CONTACT_PATCH)
        width = max(self.body.width, self.wheel_separation + CONTACT_PATCH)
        return self.footprint or make_rectangle(length, width)

    @property
    def wheel_radii(self) -> tuple[float, float]:
        """Radius of the left wheels, and of the right ones [m]."""
        radius = self.wheel_radius
        return (
            radius * self.left_wheel_radius_multiplier,
            radius * self.right_wheel_radius_multiplier,
        )

    @property
    def effective_separation(self) -> float:
        """wheel_separation * wheel_separation_multiplier [m]."""
        return self.wheel_separation * self.wheel_separation_multiplier

    @property
    def twist_geometry(self) -> tuple[float, float, float]:
        """Left and right radius and separation by which a controller converts twists [m]."""
        # The robot's own geometry may have been calibrated since, but its controller keeps its own.
        separation = self.ros2.wheel_separation or self.effective_separation
        return *(self.ros2.wheel_radii or self.wheel_radii), separation

    def with_(self, **changes: Any) -> RobotConfig:
        """Return a validated copy with changed fields.

        Args:
            **changes: New values. A dict changes single fields of a section, except for `measured`,
                which is replaced as a whole.

        Raises:
            ConfigError: A field is unknown, or a value is bad.
        """
        # Validate everything again, as fields depend on each other.
        fields = self.model_dump()
        for name, value in changes.items():
            is_section = isinstance(fields.get(name), dict) and name != "measured"
            is_nested = is_section and isinstance(value, dict)
            fields[name] = fields[name] | value if is_nested else value
        return RobotConfig(**fields)

    def save(
        self,
        path: str | Path,
        remarks: Mapping[str, str] | None = None,
        *,
        outdated: Sequence[str] = (),
        force: bool = False,
    ) -> None:
        """Write a YAML file that `load` reads back: the geometry, and what isn't the default.

        In a robot's file that exists, only the values that differ are changed. Other values and
        comments stay, except for comments inside braces or brackets that go over several lines.

        Args:
            path: The file, .yaml or .yml.
            remarks: Comments to write above fields, by their names.
            outdated: Remarks of earlier calls to remove from the file.
            force: Replace a file that isn't a robot's.

        Raises:
            ConfigError: It can't be written, has another suffix, or exists and isn't a robot's.
        """
        from acsar_gym.config import saving  # noqa: PLC0415 - only saving needs the YAML writer

        saving.save_robot(self, path, remarks or {}, outdated, force=force)

    @classmethod
    def load(cls, path: str | Path) -> RobotConfig:
        """Return the robot that a file describes.

        Args:
            path: A `.yaml` file of this package, a `.urdf` file of the robot's own driver (the
                parameters in its `<ros2_control>` block, of which a missing baud_rate means 9600
                baud at a control_rate of 20 Hz), or a ROS parameter file with a
                diff_drive_controller.

        Raises:
            ConfigError: The file is missing or malformed, has a bad value, or is of another kind.
        """
        from acsar_gym.config import files  # noqa: PLC0415 - only loading needs the parsers

        if not isinstance(path, str | Path):
            raise ConfigError(f"path = {show_value(path)}: must be a file's name")
        try:
            return cls(**files.read_fields(Path(path), cls.model_fields))
        except ConfigError as error:
            raise ConfigError(f"{path}: {error}") from error

    @classmethod
    def preset(cls, name: str) -> RobotConfig:
        """Return a robot of this package.

        Args:
            name: Such as "acsar".

        Raises:
            ConfigError: There is no such preset.
        """
        from acsar_gym.config import files  # noqa: PLC0415

        return cls.load(files.find_preset(name))

    @classmethod
    def of(cls, robot: RobotSource) -> RobotConfig:
        """Return the config that a value of an env's `robot` argument means.

        Args:
            robot: A config, a mapping of fields, a file, the name of a preset, the number of a
                robot drawn at random, such as "drawn:17", or None for acsar.

        Raises:
            ConfigError: The value has another type. See `load` and `preset` for other reasons.
        """
        if isinstance(robot, RobotConfig):
            return robot
        if isinstance(robot, Mapping):
            return cls.model_validate(dict(robot))
        if robot is None:
            return cls.preset("acsar")
        if isinstance(robot, Path):
            return cls.load(robot)
        if not isinstance(robot, str):
            many = isinstance(robot, list | tuple)
            must = MANY_ROBOTS if many else "must be a RobotConfig, its fields, a preset or a file"
            raise ConfigError(f"robot = {show_value(robot)}: {must}")
        from acsar_gym.config import drawn, files  # noqa: PLC0415 - NumPy, and the parsers

        # Drawn robots first, as their names could be files of a folder.
        numbers = drawn.parse_numbers(robot)
        if numbers is None:
            return cls.load(files.find_file(robot))
        if len(numbers) > 1:
            first = f"{drawn.PREFIX}{numbers[0]}"
            raise ConfigError(f"robot = {show_value(robot)}: {MANY_ROBOTS}, such as {first!r}")
        return cls.model_validate(drawn.draw_robot(numbers[0]))


RobotSource = RobotConfig | Mapping[str, Any] | str | Path | None
"""Type of an env's `robot` argument. See `RobotConfig.of`."""


def hash_config(config: RobotConfig) -> str:
    """Return the SHA-256 of a robot's config in hexadecimal. The order of fields doesn't matter."""
    data = config.model_dump(mode="json")
    text = json.dumps(data, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()
