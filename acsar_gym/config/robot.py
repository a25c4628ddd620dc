"""Configuration of a robot: geometry, serial link, limits, and its simulation."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import AfterValidator, Field, model_validator

from acsar_gym.config.footprint import Corners, Outline, box
from acsar_gym.config.lidar import LidarConfig
from acsar_gym.config.limits import (
    ANGULAR_ACCELERATION,
    LINEAR_ACCELERATION,
    AngularLimits,
    Geofence,
    LinearLimits,
    accelerating,
)
from acsar_gym.config.measured import Measured, check
from acsar_gym.config.parts import BodyConfig, EncoderConfig, FirmwareConfig, MotorConfig
from acsar_gym.config.rates import check_feedback, check_window, whole_ratio
from acsar_gym.config.section import Section
from acsar_gym.config.units import Length, Name, Offset, Rate, Speed, Wait
from acsar_gym.config.wheels import WheelsConfig
from acsar_gym.config.wire import BAUD_RATES, BITS_PER_BYTE, LINE_BYTES, known_baud
from acsar_gym.errors import ConfigError, shown

FOOT = 0.01
"""Size of the contact patch of a wheel, which the default footprint contains [m]."""
USUAL_RATES = (200.0, 100.0, 50.0, 40.0, 25.0, 20.0, 10.0, 5.0, 2.0, 1.0)
"""Rates that error messages suggest [Hz]."""
TWIN = ("motor", "encoder", "firmware", "body", "measured")
"""Sections that the robot's own driver doesn't have: for the simulation only, or about it."""


class RobotConfig(Section):
    """One robot: geometry, serial link, limits, and simulation. Units: m, m/s and rad/s.

    Lengths are at most 100 m, speeds 1,000, rates 10,000 Hz, and times 1 h.
    """

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
    """What `acsar-gym estop NAME` calls this robot, beside its device."""
    serial_port: Name | None = None
    """Device that `open_link("serial", config)` opens."""
    baud_rate: Annotated[int, AfterValidator(known_baud)] = 115200
    """Baud rate [bit/s]; 8N1, no flow control."""
    trailing_comma: bool = True
    """Send a comma after the last motor, as the robot's own driver does; some boards take a value
    only at its comma."""
    control_rate: Rate = 100.0
    """Ticks per second [Hz]; one command line per tick."""
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
    """Stop a real robot with an error that names the wheel, where measured wheel speeds contradict
    the commanded ones for longer than `motor`, `firmware` and `encoder` explain."""
    max_linear: Speed = 0.5
    """Linear speed of a full action, and limit of all commands [m/s]."""
    max_angular: Speed = 1.5
    """Angular speed of a full action, and limit of all commands [rad/s]."""
    max_wheel_speed: Speed = 30.0
    """Limit of wheel speeds [rad/s]; all four are scaled, which keeps the turning radius."""
    linear_limits: Annotated[LinearLimits, accelerating(LINEAR_ACCELERATION)] = LinearLimits(
        max_acceleration=LINEAR_ACCELERATION
    )
    """Limits of the commanded linear velocity, in simulation and on hardware; `max_acceleration` is
    2 m/s^2 by default, and null means none."""
    angular_limits: Annotated[AngularLimits, accelerating(ANGULAR_ACCELERATION)] = AngularLimits(
        max_acceleration=ANGULAR_ACCELERATION
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
    footprint: Corners | None = None
    """Footprint for collisions: polygon of 3 to 100 corners (x, y) in order, in the base frame [m],
    with the origin inside. A list, or a string like "[[0.2, 0.1], [-0.2, 0.1], [0.0, -0.2]]".
    None: the rectangle around body and wheels."""
    wheels: WheelsConfig = WheelsConfig()
    """Letters and signs of motors and encoders, where the board is wired differently."""
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

    def __hash__(self) -> int:
        fields = [getattr(self, name) for name in type(self).model_fields if name != "measured"]
        return hash((*fields, frozenset(self.measured.items())))

    @model_validator(mode="after")
    def _measured_fields_exist(self) -> Self:
        """Check the names of measured fields, and that their intervals are within their bounds."""
        check(self.measured, type(self))
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
        check_feedback(self.feedback_rate, self.feedback_timeout, loop)
        check_window(self.encoder.window, loop)
        return self

    @property
    def feedback_rate(self) -> float:
        """Feedback lines per second that the board sends [Hz]."""
        return self.firmware.feedback_rate or self.control_rate

    @property
    def period(self) -> float:
        """Duration of a tick [s]."""
        return 1.0 / self.control_rate

    @property
    def outline(self) -> Outline:
        """Corners of the footprint in the base frame, counter-clockwise [m]."""
        length = max(self.body.length, self.wheelbase + FOOT)
        width = max(self.body.width, self.wheel_separation + FOOT)
        return self.footprint or box(length, width)

    @property
    def wheel_radii(self) -> tuple[float, float]:
        """Radius of the left wheels, and of the right ones [m]."""
        left, right = self.left_wheel_radius_multiplier, self.right_wheel_radius_multiplier
        return self.wheel_radius * left, self.wheel_radius * right

    @property
    def effective_separation(self) -> float:
        """wheel_separation * wheel_separation_multiplier [m]."""
        return self.wheel_separation * self.wheel_separation_multiplier

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

    def save(self, path: str | Path, remarks: Mapping[str, str] | None = None) -> None:
        """Write a YAML file that `load` reads back: the geometry, and what isn't the default.

        Args:
            path: the file, .yaml or .yml.
            remarks: comments to write above fields, by their names.

        Raises:
            ConfigError: it can't be written, or has another suffix.
        """
        from acsar_gym.config import saving  # noqa: PLC0415 - only saving needs the YAML writer

        saving.save(self, saving.target(path), remarks)

    @classmethod
    def load(cls, path: str | Path) -> RobotConfig:
        """Return the robot of a `.yaml` file, or of a `.urdf` file's `<ros2_control>` parameters.

        Args:
            path: the file. A URDF without a baud_rate means 9600 baud, as for the robot's own
                driver, and by default a control_rate of 20 Hz.

        Raises:
            ConfigError: the file is missing or malformed, or holds a bad value.
        """
        from acsar_gym.config import files  # noqa: PLC0415 - only loading needs the parsers

        if not isinstance(path, str | Path):
            raise ConfigError(f"path = {shown(path)}: must be a file's name")
        try:
            return cls(**files.fields(Path(path), cls._driver_params()))
        except ConfigError as error:
            raise ConfigError(f"{Path(path)}: {error}") from None

    @classmethod
    def _driver_params(cls) -> list[str]:
        """Return the parameter names that a URDF may use: all but those of the simulation."""
        return [name for name in cls.model_fields if name not in TWIN]

    @classmethod
    def preset(cls, name: str) -> RobotConfig:
        """Return a robot that comes with the package; ConfigError where there is no such preset.

        Args:
            name: such as "acsar".
        """
        from acsar_gym.config import files  # noqa: PLC0415

        return cls.load(files.preset(name))

    @classmethod
    def of(cls, robot: RobotSource) -> RobotConfig:
        """Return the config that a value of an env's `robot` argument means.

        Args:
            robot: a config, a mapping of fields, a file, the name of a preset, or None for acsar.

        Raises:
            ConfigError: for other types, and see `load` and `preset`.
        """
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
"""Type of an env's `robot` argument; see `RobotConfig.of`."""
