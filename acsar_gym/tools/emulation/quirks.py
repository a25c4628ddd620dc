"""Boards that behave differently: ways in which real ones have been wired and programmed.

A quirk is a name such as `at-comma`, or a name and a value such as `dead-wheel=c`. Those of wiring
and timing change the emulated robot's config; the others change the bytes at the board's connector.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

from acsar_gym.config import RobotConfig, WheelsConfig
from acsar_gym.errors import ConfigError, show_value, suggest_name
from acsar_gym.links.base import Link
from acsar_gym.physics.body import GroundTruth
from acsar_gym.protocol import MOTORS, ZERO, Decoder, Speeds, encode
from acsar_gym.worlds import Scene

BOOT_TIME = 1.5
"""How long a board is silent after a reset [s]."""
RUNAWAY_SPEED = 14.4
"""How much faster than commanded a wheel of `assets/firmware` turns where its encoder is reversed,
so that the speed loop drives it away from its command [rad/s]."""
QUIRK_NAMES: dict[str, str | None] = {
    "at-comma": None,
    "no-comma": None,
    "unpadded": None,
    "padded-space": None,
    "reversed-encoder": "",
    "reversed-motor": "",
    "swapped-encoders": None,
    "swapped-motors": None,
    "dead-wheel": "",
    "dead-encoder": "",
    "runaway": "",
    "feedback-factor": "",
    "frozen": "1",
    "resets": "1",
    "command-timeout": "",
    "no-timeout": None,
    "feedback-rate": "",
}
"""Quirks and their default values; None where a quirk has no value, "" where it needs one. A
`runaway` wheel has a reversed encoder within the board's speed loop."""
MIRRORED_LETTERS = str.maketrans("abcd", "badc")
"""Letters of the wheels on the other side."""

Quirks = dict[str, str]


def parse_quirks(quirks: Sequence[str]) -> Quirks:
    """Check quirks such as "at-comma" and "dead-wheel=c"; ConfigError names a bad one.

    Returns:
        Names and values.
    """
    found: Quirks = {}
    for quirk in quirks:
        name, equals, value = quirk.partition("=")
        if name not in QUIRK_NAMES:
            raise ConfigError(
                f"unknown quirk {show_value(quirk)}{suggest_name(name[:40], QUIRK_NAMES)}"
            )
        default = QUIRK_NAMES[name]
        if default is None and equals:
            raise ConfigError(f"quirk {show_value(quirk)}: {name} has no value")
        found[name] = value or default or ""
        _check(quirk, name, found[name])
    return found


def _check(quirk: str, name: str, value: str) -> None:
    """Check the value of a quirk."""
    if name.startswith(("dead-", "reversed-", "runaway")) and (
        len(value) != 1 or value not in MOTORS
    ):
        raise ConfigError(f"quirk {show_value(quirk)}: write {name}=WHEEL, one of a, b, c, d")
    if name in ("frozen", "resets", "command-timeout", "feedback-rate", "feedback-factor"):
        try:
            number = float(value)
        except ValueError:
            number = math.nan
        if not 0.0 < number < math.inf:
            raise ConfigError(f"quirk {show_value(quirk)}: write {name}=NUMBER, more than 0")


def apply_to_config(quirks: Quirks, config: RobotConfig) -> RobotConfig:
    """Return the config of a robot with these quirks of wiring and timing.

    Args:
        quirks: names and values.
        config: of the robot without them.
    """
    firmware: dict[str, Any] = {}
    if "command-timeout" in quirks:
        firmware["command_timeout"] = float(quirks["command-timeout"])
    if "no-timeout" in quirks:
        firmware["command_timeout"] = None
    if "feedback-rate" in quirks:
        firmware["feedback_rate"] = float(quirks["feedback-rate"])
    return config.with_(firmware=firmware, wheels=_wiring(quirks, config.wheels))


def _wiring(quirks: Quirks, usual: WheelsConfig) -> dict[str, Any]:
    """Return the wiring with these quirks."""
    wheels: dict[str, dict[str, Any]] = usual.model_dump()
    for wheel in wheels.values():
        if "swapped-encoders" in quirks:
            wheel["encoder"] = wheel["encoder"].translate(MIRRORED_LETTERS)
        if "swapped-motors" in quirks:
            wheel["motor"] = wheel["motor"].translate(MIRRORED_LETTERS)
    for name, sign in (("reversed-encoder", "sign"), ("reversed-motor", "motor_sign")):
        if name in quirks:
            wheels[quirks[name]][sign] *= -1
    return wheels


class QuirkyLink:
    """A simulated robot whose board differs in the bytes that it takes and sends.

    Args:
        link: of the simulated robot.
        config: of that robot.
        quirks: names and values.
    """

    lateness = None

    def __init__(self, link: Link, config: RobotConfig, quirks: Quirks) -> None:
        self._link = link
        self._quirks = quirks
        self._comma = config.trailing_comma
        self._dead_motor = _letter(quirks.get("dead-wheel"), config, "motor")
        self._runaway = _letter(quirks.get("runaway"), config, "motor")
        self._top = config.motor.max_speed
        self._factors = [float(quirks.get("feedback-factor", "1"))] * len(MOTORS)
        for name, factor in (("runaway", -1.0), ("dead-encoder", 0.0)):
            if (encoder := _letter(quirks.get(name), config, "encoder")) is not None:
                self._factors[encoder] *= factor
        self._scales = any(factor != 1.0 for factor in self._factors)
        commas = "at-comma" in quirks or "no-comma" in quirks
        self._filters_input = commas or "dead-wheel" in quirks or "runaway" in quirks
        self._style = _style(quirks)
        self._pause = float(quirks.get("frozen") or quirks.get("resets") or math.inf)
        self._begun = False
        self.reset(Scene())

    def reset(self, scene: Scene) -> None:
        """Reset robot and board."""
        self._link.reset(scene)
        self._input = b""
        self._decoder = Decoder()
        self._told: Speeds = ZERO
        self._begun = False
        self._elapsed = 0.0
        self._off = False
        self._stops_at, self._wakes_at = self._pause, math.inf

    @property
    def truth(self) -> GroundTruth | None:
        """Ground truth of the simulation."""
        return self._link.truth

    def open(self) -> None:
        """Open the simulation."""
        self._link.open()

    def now(self) -> float:
        """Return the simulated time [s]."""
        return self._link.now()

    def close(self) -> None:
        """Close the simulation."""
        self._link.close()

    def write(self, data: bytes) -> None:
        """Take bytes, unless the board hangs or boots."""
        self._begun = self._begun or bool(data)
        if self._off:
            return
        if not self._filters_input:
            self._link.write(data)
            return
        *lines, self._input = (self._input + data).split(b"\n")
        for line in lines:
            self._link.write(self._taken(line) + b"\n")

    def _taken(self, line: bytes) -> bytes:
        """Return what the board takes of a line."""
        if "at-comma" in self._quirks:
            line = line[: line.rfind(b",") + 1]
        if "no-comma" in self._quirks and line.rstrip().endswith(b","):
            line = b",".join(line.split(b",")[:-2])
        if self._dead_motor is not None or self._runaway is not None:
            for reading in Decoder().feed(line + b"\n"):
                speeds = [0.0 if speed is None else speed for speed in reading.speeds]
                if self._dead_motor is not None:
                    speeds[self._dead_motor] = 0.0
                if self._runaway is not None and (asked := speeds[self._runaway]):
                    most = min(abs(asked) + RUNAWAY_SPEED, self._top)
                    speeds[self._runaway] = math.copysign(most, asked)
                line = encode(speeds).rstrip()
        return line

    def advance(self, period: float) -> bytes:
        """Let time pass, and return what the board sends meanwhile."""
        lines = [self._sent(line) for line in self._link.advance(period).splitlines(keepends=True)]
        self._elapsed += period if self._begun else 0.0
        if self._elapsed >= self._wakes_at:
            self._off, self._stops_at = False, self._elapsed + self._pause
            self._wakes_at = math.inf
        if self._off:
            return b""
        if lines and self._elapsed >= self._stops_at:
            return self._stop(lines[0])
        return b"".join(lines)

    def _stop(self, line: bytes) -> bytes:
        """Stop in the middle of a line, with the motors off."""
        self._link.write(b"\n" + encode(ZERO))
        self._off = True
        if "resets" in self._quirks:
            self._wakes_at = self._elapsed + BOOT_TIME
        return line[: len(line) // 2]

    def _sent(self, line: bytes) -> bytes:
        """Return how the board writes a line of feedback."""
        if self._style is None and not self._scales:
            return line
        for reading in self._decoder.feed(line):
            self._told = reading.over(self._told)
        speeds = [own * factor for own, factor in zip(self._told, self._factors, strict=True)]
        if self._style is None:
            return encode(speeds, trailing_comma=self._comma)
        return _written(speeds, self._style, comma=self._comma)


def _letter(wheel: str | None, config: RobotConfig, part: str) -> int | None:
    """Return the index of the letter of a wheel's motor or encoder."""
    if not wheel:
        return None
    return MOTORS.index(getattr(getattr(config.wheels, wheel), part))


def _style(quirks: Quirks) -> Callable[[float], str] | None:
    """Return how the board writes a number; None for the protocol's way."""
    if "unpadded" in quirks:
        return "{:.2f}".format
    return "{:5.2f}".format if "padded-space" in quirks else None


def _written(speeds: Sequence[float], style: Callable[[float], str], *, comma: bool) -> bytes:
    """Return a line with numbers in a style of the board's own."""
    parts = [
        f"{motor}{'n' if speed < 0.0 else 'p'}{style(abs(speed))}"
        for motor, speed in zip(MOTORS, speeds, strict=True)
    ]
    return (",".join(parts) + ("," if comma else "") + "\r\n").encode()
