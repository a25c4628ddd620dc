"""Boards that behave differently: ways in which real ones have been wired and programmed.

For tests; `python tests/quirks.py emulate --quirk swapped-motors` serves a pseudo-terminal.

A quirk is a name such as `at-comma`, or a name and a value such as `dead-wheel=c`. Those of wiring
and timing change the emulated robot's config, those of motors lie between firmware and body, and
the others change the bytes at the board's connector. What a config says already needs no quirk: an
instant encoder is `encoder.window` of one loop, saturation is `motor.max_speed`.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Sequence
from typing import Any

from acsar_gym.config import RobotConfig
from acsar_gym.links import open_link
from acsar_gym.links.base import Arrivals, Link, LinkWrapper
from acsar_gym.links.simulated import SimulatedLink
from acsar_gym.physics.bodies import make_body
from acsar_gym.physics.body import Body
from acsar_gym.protocol import MOTORS, ZERO, Decoder, Speeds, encode
from acsar_gym.worlds import Scene

BOOT_TIME, STALE_TIME = 1.5, 0.3
"""How long a board is silent after a reset, and a stale one repeats a line [s]."""
RUNAWAY_SPEED = 14.4
"""How much faster than commanded a wheel of `assets/firmware` turns where its encoder is reversed,
so that the speed loop drives it away from its command [rad/s]."""
WHEEL_QUIRKS = ("reversed-encoder", "reversed-motor", "dead-wheel", "dead-encoder", "runaway")
"""Quirks whose value is a wheel."""
MOTOR_QUIRKS = ("backward-gain", "overshoot", "reversal-hold")
"""Quirks of motors, outside the model that `identify` fits; their value is a number."""
DEFAULTS = {"frozen": "1", "resets": "1", "echo": "0.005", "stale": "3"}
"""Numbers where none is given: `echo` is how late each command comes back [s], `stale` how often a
line is repeated for `STALE_TIME` [s]."""
INPUT_QUIRKS = {
    "at-comma",
    "no-comma",
    "dead-wheel",
    "runaway",
    "echo",
    "set-points",
    "upper-case-commands",
}
"""Quirks of a board that look at single commands. `set-points` sends the commanded speeds as
feedback."""
QUIRK_NAMES = {
    *WHEEL_QUIRKS,
    *MOTOR_QUIRKS,
    *DEFAULTS,
    *INPUT_QUIRKS,
    "unpadded",
    "padded-space",
    "swapped-encoders",
    "swapped-motors",
    "no-timeout",
    "upper-case",
    "signs",
    "feedback-factor",
    "command-timeout",
    "feedback-rate",
}
MIRRORED_LETTERS = str.maketrans("abcd", "badc")
"""Letters of the wheels on the other side."""

Quirks = dict[str, str]
"""Names and values."""


def parse_quirks(quirks: Sequence[str]) -> Quirks:
    """Quirks such as "at-comma" and "dead-wheel=c" by name."""
    found: Quirks = {}
    for quirk in quirks:
        name, _, value = quirk.partition("=")
        assert name in QUIRK_NAMES, quirk
        found[name] = value or DEFAULTS.get(name, "")
    return found


def apply_to_config(quirks: Quirks, config: RobotConfig) -> RobotConfig:
    """Return the config of a robot with these quirks of wiring and timing."""
    firmware: dict[str, Any] = {}
    if "command-timeout" in quirks:
        firmware["command_timeout"] = float(quirks["command-timeout"])
    if "no-timeout" in quirks:
        firmware["command_timeout"] = None
    if "feedback-rate" in quirks:
        firmware["feedback_rate"] = float(quirks["feedback-rate"])
    wheels: dict[str, dict[str, Any]] = config.wheels.model_dump()
    for wheel in wheels.values():
        for part in ("encoder", "motor"):
            if f"swapped-{part}s" in quirks:
                wheel[part] = wheel[part].translate(MIRRORED_LETTERS)
    for name, sign in (("reversed-encoder", "sign"), ("reversed-motor", "motor_sign")):
        if name in quirks:
            wheels[quirks[name]][sign] *= -1
    return config.with_(firmware=firmware, wheels=wheels)


def make_link(name: str, config: RobotConfig, quirks: Quirks) -> Link:
    """Make a simulated robot with these quirks; the config has those of wiring and timing."""
    if quirks.keys().isdisjoint(MOTOR_QUIRKS):
        link = open_link(name, config)
    else:
        motors: Any = QuirkyMotors  # all that a body has
        link = SimulatedLink(config, lambda: motors(make_body(name, config), config, quirks))
    return QuirkyLink(link, config, quirks) if quirks.keys() - MOTOR_QUIRKS else link


class QuirkyMotors:
    """A body whose motors don't follow the firmware's set points as the model says.

    `backward-gain`: wheels turn by this factor slower (or faster) backward than forward.
    `overshoot`: an integrating controller drives the motor's lag T, so that a small step overshoots
    by this share M: u = integral of (set point - speed) / (4 zeta^2 T) with the damping
    zeta = -ln M / sqrt(pi^2 + ln^2 M) of a second-order system.
    `reversal-hold`: a wheel stands for this time whenever its set point changes sign [s].
    """

    def __init__(self, body: Body, config: RobotConfig, quirks: Quirks) -> None:
        self._body = body
        self._dt = 1.0 / config.firmware.loop_rate
        self._backward = float(quirks.get("backward-gain", "1"))
        self._hold = float(quirks.get("reversal-hold", "0"))
        self._rates: list[float] | None = None
        if "overshoot" in quirks:
            log = math.log(min(float(quirks["overshoot"]), 0.9))
            damping = -log / math.hypot(math.pi, log)
            lags = [max(config.motor.of_wheel(wheel).time_constant, self._dt) for wheel in range(4)]
            self._rates = [self._dt / (4.0 * damping**2 * lag) for lag in lags]
        self.reset(Scene())

    def __getattr__(self, name: str) -> Any:
        return getattr(self._body, name)  # all but the motors

    def reset(self, scene: Scene) -> None:
        """Reset the body and its motors."""
        self._body.reset(scene)
        self._signs = [0.0] * 4
        self._held = [math.inf] * 4
        self._controls = [0.0] * 4

    def step(self, set_points: Speeds) -> None:
        """Simulate one firmware loop with these set points [rad/s]."""
        a, b, c, d = (self._distort(wheel, aim) for wheel, aim in enumerate(set_points))
        self._body.step((a, b, c, d))

    def _distort(self, wheel: int, aim: float) -> float:
        """Return what a wheel's motor makes of a set point [rad/s]."""
        self._held[wheel] += self._dt
        if aim != 0.0:
            sign = math.copysign(1.0, aim)
            if sign == -self._signs[wheel]:
                self._held[wheel] = 0.0
            self._signs[wheel] = sign
        if self._held[wheel] < self._hold:
            aim = 0.0
        if aim < 0.0:
            aim *= self._backward
        if self._rates is not None:
            missing = aim - self._body.wheel_speeds[wheel]
            self._controls[wheel] += self._rates[wheel] * missing
            aim = self._controls[wheel]
        return aim


class QuirkyLink(LinkWrapper):
    """A simulated robot whose board differs in the bytes that it takes and sends."""

    def __init__(self, link: Link, config: RobotConfig, quirks: Quirks) -> None:
        super().__init__(link)
        self._quirks = quirks
        self._comma = config.trailing_comma

        def letter_of(quirk: str, part: str) -> int | None:
            """Return the index of the letter of a wheel's motor or encoder."""
            wheel = quirks.get(quirk)
            return MOTORS.index(getattr(getattr(config.wheels, wheel), part)) if wheel else None

        self._dead_motor = letter_of("dead-wheel", "motor")
        self._runaway = letter_of("runaway", "motor")
        self._top = config.motor.max_speed
        self._factors = [float(quirks.get("feedback-factor", "1"))] * len(MOTORS)
        for name, factor in (("runaway", -1.0), ("dead-encoder", 0.0)):
            if (encoder := letter_of(name, "encoder")) is not None:
                self._factors[encoder] *= factor
        self._filters_input = not INPUT_QUIRKS.isdisjoint(quirks)
        self._echo_delay = float(quirks.get("echo", "inf"))
        self._stale_every = float(quirks.get("stale", "inf"))
        self._format_speed: Callable[[float], str] | None = None
        if "unpadded" in quirks:
            self._format_speed = "{:.2f}".format
        elif "padded-space" in quirks:
            self._format_speed = "{:5.2f}".format
        self._pause = float(quirks.get("frozen") or quirks.get("resets") or math.inf)
        self.reset(Scene())

    def reset(self, scene: Scene) -> None:
        """Reset robot and board."""
        self.inner.reset(scene)
        self._input = b""
        self._decoder = Decoder()
        self._speeds: Speeds = ZERO
        self._arrived: list[tuple[float, bytes]] = []
        self._echoes: list[tuple[float, bytes]] = []
        self._command = self._repeated = b""
        self._begun = self._off = False
        self._clock = self._elapsed = 0.0
        self._stops_at, self._wakes_at = self._pause, math.inf

    @property
    def arrivals(self) -> Arrivals:
        """When the lines of the newest period arrived [s]."""
        return self._arrived

    def write(self, data: bytes) -> None:
        """Take bytes, unless the board hangs or boots."""
        self._begun = self._begun or bool(data)
        if self._off:
            return
        if not self._filters_input:
            self.inner.write(data)
            return
        *lines, self._input = (self._input + data).split(b"\n")
        for line in lines:
            if command := line.strip():
                self._command = command + b"\r\n"
                if "echo" in self._quirks:
                    self._echoes.append((self._clock + self._echo_delay, self._command))
            self.inner.write(self.take_line(line) + b"\n")

    def take_line(self, line: bytes) -> bytes:
        """Return what the board takes of a line."""
        if "upper-case-commands" in self._quirks:
            line = line.lower() if line == line.upper() else b""
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
        heard = self.inner.advance(period).splitlines(keepends=True)
        lines = [self._send(line) for line in heard]
        self._arrived = []
        self._clock += period
        self._elapsed += period if self._begun else 0.0
        if self._elapsed >= self._wakes_at:
            self._off, self._stops_at = False, self._elapsed + self._pause
            self._wakes_at = math.inf
        if self._off:
            return b""
        if lines and self._elapsed >= self._stops_at:  # in mid-line, with the motors off
            self.inner.write(b"\n" + encode(ZERO))
            self._off = True
            if "resets" in self._quirks:
                self._wakes_at = self._elapsed + BOOT_TIME
            return lines[0][: len(lines[0]) // 2]
        stamps = [stamp for stamp, _ in self.inner.arrivals]
        self._arrived = list(zip(stamps, lines, strict=False))
        due = sum(when <= self._clock for when, _ in self._echoes)
        echoes, self._echoes = self._echoes[:due], self._echoes[due:]
        return b"".join([*(echo for _, echo in echoes), *lines])

    def _send(self, line: bytes) -> bytes:
        """Return how the board writes a line of feedback."""
        line = self._write_speeds(line)
        if self._clock % self._stale_every > STALE_TIME or self._stale_every == math.inf:
            self._repeated = line
        line = self._repeated or line
        if "signs" in self._quirks:
            line = line.translate(bytes.maketrans(b"pn", b"+-"))
        return line.upper() if "upper-case" in self._quirks else line

    def _write_speeds(self, line: bytes) -> bytes:
        """Return a line with the speeds that the board reports, in its own numbers."""
        if "set-points" in self._quirks:
            commands = Decoder().feed(self._command)
            return encode(commands[-1].over(ZERO), trailing_comma=self._comma) if commands else line
        if self._format_speed is None and self._factors == [1.0] * len(MOTORS):
            return line
        for reading in self._decoder.feed(line):
            self._speeds = reading.over(self._speeds)
        speeds = [own * factor for own, factor in zip(self._speeds, self._factors, strict=True)]
        if self._format_speed is None:
            return encode(speeds, trailing_comma=self._comma)
        parts = [
            f"{motor}{'n' if speed < 0.0 else 'p'}{self._format_speed(abs(speed))}"
            for motor, speed in zip(MOTORS, speeds, strict=True)
        ]
        return (",".join(parts) + ("," if self._comma else "") + "\r\n").encode()


def emulate() -> None:
    """Run `acsar-gym emulate` with the quirks that follow --quirk in the arguments."""
    from acsar_gym.tools.cli import main
    from acsar_gym.tools.emulation import board

    begin = sys.argv.index("--quirk") if "--quirk" in sys.argv else len(sys.argv)
    end = begin + 1
    while end < len(sys.argv) and not sys.argv[end].startswith("--"):
        end += 1
    quirks = parse_quirks(sys.argv[begin + 1 : end])
    del sys.argv[begin:end]

    class QuirkyEmulator(board.Emulator):
        def __init__(self, config: RobotConfig, **options: Any) -> None:
            super().__init__(apply_to_config(quirks, config), **options)

    def make(body: str, config: RobotConfig) -> Link:
        return make_link(body, config, quirks)

    board.open_link = make  # type: ignore[assignment, attr-defined]
    board.Emulator = QuirkyEmulator  # type: ignore[misc]
    main()


if __name__ == "__main__":
    emulate()
