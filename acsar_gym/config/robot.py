"""Configuration of a robot: geometry, serial link, limits, LiDAR, and its simulation."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar, Self

from pydantic import AfterValidator, Field, model_validator

from acsar_gym.config.footprint import Corners, Outline, make_rectangle, outline_radius
from acsar_gym.config.parts import HINTS, MANY_ROBOTS
from acsar_gym.config.section import Length, Name, Offset, Rate, Section, Speed, Wait
from acsar_gym.config.sections import (
    ANGULAR_ACCELERATION,
    LINEAR_ACCELERATION,
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
    validate_measured,
)
from acsar_gym.errors import ConfigError, show_value

MISFIT = "doesn't fit: "
"""Begin of a `motor_fit` of a robot whose motors or board answer otherwise than simulated."""
LEAST_RATE = 0.01
"""Lowest rate of ticks and policy steps [Hz], which bounds the simulated time of a step."""

MAX_ENCODER_SAMPLES = 2_000
"""Most encoder readings that the simulated firmware stores for averaging."""


def whole_ratio(fast_name: str, fast: float, slow_name: str, slow: float) -> int:
    """Return the ratio of two rates.

    Args:
        fast_name: name of the faster rate, for the message.
        fast: [Hz].
        slow_name: name of the slower rate, for the message.
        slow: [Hz].

    Returns:
        fast / slow as an int.

    Raises:
        ConfigError: it isn't an integer of at least 1, or `slow` is below 0.01 Hz.
    """
    try:
        texts = isinstance(fast, str | bytes) or isinstance(
            slow, str | bytes
        )  # float() parses them
        ratio = math.nan if texts else float(fast) / float(slow)
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        ratio = math.nan
    if not ratio > 0.0:
        raise ConfigError(f"{slow_name} = {show_value(slow)}: must be a positive number of Hz")
    if slow < LEAST_RATE:
        raise ConfigError(f"{slow_name} = {slow:g} Hz: must be at least {LEAST_RATE:g} Hz")
    whole = round(min(ratio, 1e9))
    if whole < 1 or not math.isclose(ratio, whole, rel_tol=1e-9):
        raise ConfigError(
            f"{fast_name} = {fast:g} Hz: must be a whole multiple of {slow_name} = {slow:g} Hz"
        )
    return whole


BAUD_RATES = (9600, 19200, 38400, 57600, 115200)
LINE_BYTES = 33  # length of a full line with CR LF, without the optional trailing comma [bytes]
BITS_PER_BYTE = 10  # 8N1: a start bit, eight data bits, a stop bit


def validate_baud_rate(value: int) -> int:
    """Return the baud rate; ValueError for rates that boards don't use."""
    if value not in BAUD_RATES:
        raise ValueError(f"must be one of {', '.join(map(str, BAUD_RATES))}")
    return value


CONTACT_PATCH = 0.01
"""Size of the contact patch of a wheel, which the default footprint contains [m]."""
USUAL_RATES = (200.0, 100.0, 50.0, 40.0, 25.0, 20.0, 10.0, 5.0, 2.0, 1.0)
"""Rates that error messages suggest [Hz]."""
SIMULATION_SECTIONS = (
    "motor",
    "encoder",
    "firmware",
    "body",
    "measured",
    "motor_fit",
    "motor_fit_logs",
)
"""Sections that the robot's own driver doesn't have: for the simulation only, or about it."""


MOST_LENGTHS = {
    "wheel_radius": (0.005, 1.0),
    "wheel_separation": (0.02, 10.0),
    "wheelbase": (0.02, 10.0),
}
"""Least and largest sizes of robots on four wheels [m]; loaders in mines have the largest."""
LIDAR_OFFSETS = ("lidar_x_offset", "lidar_y_offset", "lidar_z_offset")
MOST_RADII = 50.0  # tracks and wheelbases are at most as many wheel radii long
MOST_TRACKS = 20.0  # a robot reaches from its middle at most as many times its track or wheelbase


class RobotConfig(Section):
    """One robot: geometry, serial link, limits, and simulation. Units: m, m/s and rad/s.

    Speeds are at most 1,000, rates 10,000 Hz, times 1 h, and lengths those of robots: wheels of 5
    mm to 1 m in radius, a track and a wheelbase of 2 cm to 10 m.
    """

    hints: ClassVar[Mapping[str, str]] = HINTS

    wheel_radius: Length = 0.05
    """Radius of the wheels [m]."""
    wheel_separation: Length = 0.3
    """Distance between the centres of left and right wheels [m]."""
    wheelbase: Length = 0.22
    """Distance between the front and the rear axle [m]; used by the simulation."""
    wheel_separation_multiplier: Annotated[float, Field(gt=0.0, le=100.0)] = 1.0
    """Factor for skidding, as in ROS diff_drive_controller; with equal wheel loads
    1 + (wheelbase / wheel_separation)^2."""
    left_wheel_radius_multiplier: Annotated[float, Field(gt=0.0, le=100.0)] = 1.0
    """Factor from `wheel_radius` to the radius of the left wheels, as in ROS
    diff_drive_controller; driver and simulation use both."""
    right_wheel_radius_multiplier: Annotated[float, Field(gt=0.0, le=100.0)] = 1.0
    """Factor from `wheel_radius` to the radius of the right wheels."""
    name: Name = ""
    """Name of the robot in the files of policies and in datasets."""
    serial_port: Name | None = None
    """Device that `open_link("serial", config)` opens."""
    baud_rate: Annotated[int, AfterValidator(validate_baud_rate)] = 115200
    """Baud rate [bit/s]; 8N1, no flow control."""
    trailing_comma: bool = True
    """Send a comma after the last motor, as the robot's own driver does; some boards take a value
    only at its comma."""
    control_rate: Rate = 100.0
    """Ticks per second [Hz]; one command line per tick."""
    late_after: Annotated[float, Field(gt=0.0, le=1.0)] = 0.2
    """A tick is late that ends more than this share of a control period after its deadline. Drives
    and their odometry don't tell less (`pytest -s -m slow tests/links/test_lateness.py`)."""
    connect_timeout: Wait = 5.0
    """Longest wait for the first valid line after opening [s]; AVR boards reset on open."""
    reconnect_timeout: Annotated[float, Field(ge=0.0, le=3600.0)] = 10.0
    """Longest wait at the next activation for a lost port to come back [s]."""
    feedback_timeout: Wait = 0.5
    """Feedback older than this stops the robot with an error [s]."""
    watchdog_timeout: Annotated[float, Field(ge=0.01, le=60.0)] | None = 0.15
    """Where the driving process gave no sign of life for this time while wheels turn, as it hangs,
    the watchdog process sends zero commands [s], 0.01 to 60; it does so at once where the process
    died. None: no watchdog."""
    wheel_check: bool = True
    """Stop a real robot with an error that names the wheel if measured wheel speeds contradict the
    commands."""
    max_linear: Speed = 0.5
    """Linear speed of a full action, and limit of all commands [m/s]."""
    max_angular: Speed = 1.5
    """Angular speed of a full action, and limit of all commands [rad/s]."""
    max_wheel_speed: Speed = 30.0
    """Limit of wheel speeds [rad/s]; all four are scaled, which keeps the turning radius."""
    linear_limits: Annotated[LinearLimits, default_acceleration(LINEAR_ACCELERATION)] = (
        LinearLimits(max_acceleration=LINEAR_ACCELERATION)
    )
    """Limits of the commanded linear velocity, in simulation and on hardware; `max_acceleration` is
    2 m/s^2 by default, and null means none."""
    angular_limits: Annotated[AngularLimits, default_acceleration(ANGULAR_ACCELERATION)] = (
        AngularLimits(max_acceleration=ANGULAR_ACCELERATION)
    )
    """Limits of the commanded angular velocity; `max_acceleration` is 8 rad/s^2 by default."""
    geofence: Geofence | None = None
    """Area that the robot may not leave, by odometry; None for no limit."""
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
    lidar_yaw: Annotated[float, Field(ge=-2.0 * math.pi, le=2.0 * math.pi)] | None = None
    """Direction of a real LiDAR's zero, counter-clockwise from the robot's x axis [rad]. None: 0
    for a LiDAR on a serial port; a LiDAR in ROS then needs a transform on /tf_static."""
    footprint: Corners | None = None
    """Footprint for collisions: polygon of 3 to 100 corners (x, y) in order, in the base frame [m],
    with the origin inside. A list, or a string like "[[0.2, 0.1], [-0.2, 0.1], [0.0, -0.2]]".
    None: the rectangle around body and wheels."""
    wheel_joints: JointNames = (
        "front_right_wheel_joint",
        "front_left_wheel_joint",
        "rear_left_wheel_joint",
        "rear_right_wheel_joint",
    )
    """Names of the joints of the wheels a, b, c, d in ROS."""
    wheels: WheelsConfig = WheelsConfig()
    """Letters and signs of motors and encoders, where the board is wired differently."""
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
    """Whether motors and board answer as simulated: "fits", or "doesn't fit: " and in which way, as
    `acsar-gym identify` found; empty: nobody looked."""
    motor_fit_logs: LogHashes = ()
    """What that was found from: first 16 hex digits of the SHA-256 of each log."""

    def __hash__(self) -> int:
        fields = [getattr(self, name) for name in type(self).model_fields if name != "measured"]
        return hash((*fields, frozenset(self.measured.items())))

    @model_validator(mode="after")
    def _measured_fields_exist(self) -> Self:
        """Check the names of measured fields, and that their intervals are within their bounds."""
        validate_measured(self.measured, type(self))
        return self

    @model_validator(mode="after")
    def _is_as_large_as_robots_are(self) -> Self:
        """Check lengths, alone and against each other, as some are meant in centimetres."""
        for name, (least, most) in MOST_LENGTHS.items():
            value = getattr(self, name)
            if not least <= value <= most:
                raise _not_in_metres(name, value, f"{least:g} to {most:g} m")
        for name in ("wheel_separation", "wheelbase"):
            value, most = getattr(self, name), MOST_RADII * self.wheel_radius
            if value > most:
                allowed = f"at most {most:g} m with wheels of {self.wheel_radius:g} m"
                raise _not_in_metres(name, value, allowed)
        body, most = self.body, MOST_TRACKS * max(self.wheel_separation, self.wheelbase)
        lengths = {
            **{f"body.{name}": getattr(body, name) for name in ("length", "width", "height")},
            "footprint's reach": outline_radius(self.footprint) if self.footprint else 0.0,
            **{name: getattr(self, name) for name in LIDAR_OFFSETS},
        }
        for name, value in lengths.items():
            if abs(value) > most:
                allowed = f"at most {most:g} m with a track of {self.wheel_separation:g} m"
                raise _not_in_metres(name, value, allowed)
        return self

    @model_validator(mode="after")
    def _wire_is_fast_enough(self) -> Self:
        """Check that the baud rate can carry the lines of the control and feedback rates."""
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
    def _rates_fit(self) -> Self:
        """Check that the rates are integer multiples, and time-out and averaging window fit."""
        loop = self.firmware.loop_rate
        whole_ratio("firmware.loop_rate", loop, "control_rate", self.control_rate)
        rate, samples = self.feedback_rate, self.encoder.window * loop
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
        if not 1.0 - 1e-9 <= samples <= MAX_ENCODER_SAMPLES:
            raise ConfigError(
                f"encoder.window = {self.encoder.window:g} s: must be 1 to "
                f"{MAX_ENCODER_SAMPLES:,} periods of firmware.loop_rate ({1.0 / loop:g} s)"
            )
        return self

    @model_validator(mode="after")
    def _commanded_joints_are_the_wheels(self) -> Self:
        """Check that each joint of the array of wheel speeds is a wheel's, and none is missing."""
        commanded, joints = self.ros2.command_joints, self.ros_joints
        if commanded is not None and sorted(commanded) != sorted({*joints}):
            raise ConfigError(
                f"ros2.command_joints = {show_value([*commanded])}: must be the wheels' joints, "
                f"each once: {', '.join(dict.fromkeys(joints))}"
            )
        return self

    @property
    def ros_joints(self) -> JointNames:
        """Joints of the wheels a, b, c, d in ROS 2; of two wheels, that of the side."""
        return self.ros2.joints or self.wheel_joints

    @property
    def has_two_wheels(self) -> bool:
        """Whether one joint stands for each side in ROS 2, so that b and c, and a and d are one."""
        return len({*self.ros_joints}) == 2

    def check_four_wheels(self) -> None:
        """Raise ConfigError for a robot with two driven wheels, which only ROS 2 drives."""
        if self.has_two_wheels and self.ros2.only is not False:
            right, left = self.ros_joints[:2]
            raise ConfigError(
                f"this robot has two driven wheels ({right}, {left}): only robots with four "
                "driven wheels that skid are simulated or driven over a serial port; --link ros2 "
                "drives it"
            )

    def check_simulated(self) -> None:
        """Raise ConfigError for a robot that can't be simulated, but driven in ROS 2."""
        self.check_four_wheels()
        if self.ros2.only:
            raise ConfigError(
                "no file says the wheelbase of this robot, so it can't be simulated: give its "
                "URDF, too (URDF,FILE), or set wheelbase, and ros2.only to false; --link ros2 "
                "drives it"
            )

    @property
    def misfit(self) -> str:
        """One line that says how motors or board answer otherwise than simulated; empty if not."""
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
        """How long after its deadline a tick has ended that is just not late [s]."""
        return self.late_after * self.period

    @property
    def outline(self) -> Outline:
        """Corners of the footprint in the base frame, counter-clockwise [m]."""
        length = max(self.body.length, self.wheelbase + CONTACT_PATCH)
        width = max(self.body.width, self.wheel_separation + CONTACT_PATCH)
        return self.footprint or make_rectangle(length, width)

    @property
    def wheel_radii(self) -> tuple[float, float]:
        """Radius of the left wheels, and of the right ones [m]."""
        left, right = self.left_wheel_radius_multiplier, self.right_wheel_radius_multiplier
        return self.wheel_radius * left, self.wheel_radius * right

    @property
    def effective_separation(self) -> float:
        """wheel_separation * wheel_separation_multiplier [m]."""
        return self.wheel_separation * self.wheel_separation_multiplier

    @property
    def twist_geometry(self) -> tuple[float, float, float]:
        """Left and right radius and separation by which a controller in ROS 2 takes twists [m]."""
        left, right = self.ros2.wheel_radii or self.wheel_radii
        return left, right, self.ros2.wheel_separation or self.effective_separation

    def with_(self, **changes: Any) -> RobotConfig:
        """Return a validated copy with changed fields.

        Args:
            **changes: new values; a dict changes single fields of a section, but `measured` is
                replaced as a whole.

        Raises:
            ConfigError: for unknown fields and bad values.
        """
        fields = self.model_dump()
        for name, value in changes.items():
            section = isinstance(fields.get(name), dict) and name != "measured"
            nested = isinstance(value, dict) and section
            fields[name] = {**fields[name], **value} if nested else value
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

        In a robot's file that exists, only the values that differ are changed: its comments and
        all other lines stay.

        Args:
            path: the file, .yaml or .yml.
            remarks: comments to write above fields, by their names.
            outdated: remarks of earlier savings to remove from the file.
            force: replace a file that isn't a robot's.

        Raises:
            ConfigError: it can't be written, has another suffix, or exists and isn't a robot's.
        """
        from acsar_gym.config import saving  # noqa: PLC0415 - only saving needs the YAML writer

        saving.save_robot(self, path, remarks or {}, outdated, force=force)

    @classmethod
    def load(cls, path: str | Path, *more: str | Path) -> RobotConfig:
        """Return the robot that a file describes, or several files together.

        Args:
            path: a `.yaml` file of this package, a `.urdf` file (its `<ros2_control>` parameters,
                links and joints), or a file of ROS parameters: those of a diff_drive_controller or
                JointGroupVelocityController, "controllers.yaml:base_drive" where it has several, or
                nav2's footprint. In a URDF of the robot's own driver, no baud_rate means 9600 baud,
                and by default a control_rate of 20 Hz.
            *more: further files of the same robot; a later one counts more.

        Raises:
            ConfigError: a file is missing or malformed, holds a bad value, or isn't of a robot with
                four driven wheels that skid, or two in ROS; or they don't say how large it is.
        """
        from acsar_gym.config import files  # noqa: PLC0415 - only loading needs the parsers

        for file in (path, *more):
            if not isinstance(file, str | Path):
                raise ConfigError(f"path = {show_value(file)}: must be a file's name")
        params = [name for name in cls.model_fields if name not in SIMULATION_SECTIONS]
        fields = files.read_fields((path, *more), params)
        try:
            return cls(**fields)
        except ConfigError as error:
            names = ",".join(str(Path(file)) for file in (path, *more))
            raise ConfigError(f"{names}: {error}") from error

    @classmethod
    def preset(cls, name: str) -> RobotConfig:
        """Return a robot that comes with the package; ConfigError where there is no such preset.

        Args:
            name: such as "acsar".
        """
        from acsar_gym.config import files  # noqa: PLC0415

        return cls.load(files.find_preset(name))

    @classmethod
    def of(cls, robot: RobotSource) -> RobotConfig:
        """Return the config that a value of an env's `robot` argument means.

        Args:
            robot: a config, a mapping of fields, a file, the name of a preset, the number of a
                robot drawn at random, such as "drawn:17", or None for acsar. Files of ROS
                parameters may follow, separated by commas: "robot.urdf,controllers.yaml".

        Raises:
            ConfigError: for other types, and see `load` and `preset`.
        """
        if isinstance(robot, RobotConfig):
            return robot
        if isinstance(robot, Mapping):
            return cls.model_validate(dict(robot))
        if robot is None:
            return cls.preset("acsar")
        if isinstance(robot, list | tuple):
            raise ConfigError(f"robot: {MANY_ROBOTS}, such as the first of them")
        if not isinstance(robot, str | Path):
            raise ConfigError(
                f"robot = {show_value(robot)}: must be a RobotConfig, its fields, a "
                "preset or a file"
            )
        from acsar_gym.config import drawn, files  # noqa: PLC0415 - NumPy, and the parsers

        numbers = drawn.parse_numbers(robot) if isinstance(robot, str) else None
        if numbers is not None:
            first = f"{drawn.PREFIX}{numbers[0]}"
            if len(numbers) > 1:
                raise ConfigError(f"robot = {show_value(robot)}: {MANY_ROBOTS}, such as {first!r}")
            return cls.model_validate(drawn.draw_robot(numbers[0]))
        if isinstance(robot, Path):
            return cls.load(robot)
        return cls.load(*files.find_parts(robot))


def _not_in_metres(name: str, value: float, allowed: str) -> ConfigError:
    """Return the error for a length that no robot has."""
    return ConfigError(
        f"{name} = {value:g}: must be {allowed}; lengths are in metres, not cm or mm"
    )


RobotSource = RobotConfig | Mapping[str, Any] | str | Path | None
"""Type of an env's `robot` argument; see `RobotConfig.of`."""


def hash_config(config: RobotConfig) -> str:
    """Return the SHA-256 of a robot's whole config, in hexadecimal; the order of fields is free."""
    return _hash_data(config.model_dump(mode="json"))


def hash_calibration(config: RobotConfig) -> str | None:
    """Return the SHA-256 of a robot's measured intervals; None where nothing was measured."""
    measured = config.model_dump(mode="json", include={"measured"})["measured"]
    return _hash_data(measured) if measured else None


def _hash_data(data: Any) -> str:
    text = json.dumps(data, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()
