"""One robot: its geometry, wire, limits, and the parts of its simulated twin."""

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
    Geofence,
    SpeedLimits,
    accelerating,
)
from acsar_gym.config.parts import BodyConfig, EncoderConfig, FirmwareConfig, MotorConfig
from acsar_gym.config.rates import whole_ratio
from acsar_gym.config.section import Section
from acsar_gym.config.units import Length, Name, Offset, Rate, Speed, Wait
from acsar_gym.config.wire import BAUD_RATES, BITS_PER_BYTE, LINE_BYTES, known_baud
from acsar_gym.errors import ConfigError, shown

FOOT = 0.01
"""What a wheel takes of the footprint where it stands beyond the body [m]."""
USUAL_RATES = (200.0, 100.0, 50.0, 40.0, 25.0, 20.0, 10.0, 5.0, 2.0, 1.0)
"""Rates that messages suggest [Hz]."""
MOST_SAMPLES = 2_000
"""Encoder readings that the simulated firmware remembers for its window."""
TWIN = ("motor", "encoder", "firmware", "body")
"""Sections that describe the simulated twin; the robot's own driver knows nothing of them."""


class RobotConfig(Section):
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
    baud_rate: Annotated[int, AfterValidator(known_baud)] = 115200
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
    """Linear speed of a full action, and of any command at most [m/s]."""
    max_angular: Speed = 1.5
    """Angular speed of a full action, and of any command at most [rad/s]."""
    max_wheel_speed: Speed = 30.0
    """Wheel speeds of any command shrink to this, keeping the turn radius [rad/s]."""
    linear_limits: Annotated[SpeedLimits, accelerating(LINEAR_ACCELERATION)] = SpeedLimits(
        max_acceleration=LINEAR_ACCELERATION
    )
    """Of the linear velocity that is commanded, in simulation and on hardware; `max_acceleration`
    is 2 m/s^2 unless it is named, and null is none."""
    angular_limits: Annotated[SpeedLimits, accelerating(ANGULAR_ACCELERATION)] = SpeedLimits(
        max_acceleration=ANGULAR_ACCELERATION
    )
    """Of the angular velocity that is commanded; `max_acceleration` is 8 rad/s^2."""
    geofence: Geofence | None = None
    """Where the robot may go, by odometry."""
    odom_frame: Name = "odom"
    base_frame: Name = "base_link"
    lidar_frame: Name = "lidar_link"
    lidar_x_offset: Offset = -0.15
    """[m] in the base frame, as the two below."""
    lidar_y_offset: Offset = 0.0
    lidar_z_offset: Offset = 0.37
    footprint: Corners | None = None
    """What must not touch anything, as a polygon: its corners (x, y) in the base frame, 3 to 100 in
    order around it, the origin inside [m]. None: the rectangle of the body and of the wheels
    beyond it. A list, or a text like "[[0.2, 0.1], [-0.2, 0.1], [0.0, -0.2]]"."""
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
    def outline(self) -> Outline:
        """Corners of what must not touch anything, counter-clockwise, in the base frame [m]."""
        length = max(self.body.length, self.wheelbase + FOOT)
        width = max(self.body.width, self.wheel_separation + FOOT)
        return self.footprint or box(length, width)

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
        from acsar_gym.config import files  # noqa: PLC0415 - only loading needs the parsers

        if not isinstance(path, str | Path):
            raise ConfigError(f"path = {shown(path)}: must be a file's name")
        try:
            return cls(**files.fields(Path(path), cls._driver_params()))
        except ConfigError as error:
            raise ConfigError(f"{Path(path)}: {error}") from None

    @classmethod
    def _driver_params(cls) -> list[str]:
        """Names of the parameters that a URDF may hold: all but those of the simulated twin."""
        return [name for name in cls.model_fields if name not in TWIN]

    @classmethod
    def preset(cls, name: str) -> RobotConfig:
        """A robot that comes with the package, such as "acsar"."""
        from acsar_gym.config import files  # noqa: PLC0415

        return cls.load(files.preset(name))

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
