"""Boards that fail, or that are wired and programmed in other ways than the robot's.

`python tests/boards.py emulate --quirk swapped-motors` serves one on a pseudo-terminal.

A quirk is a name such as `at-comma`, or a name and a value such as `dead-wheel=c`. Quirks of wiring
and timing change the emulated robot's config, those of motors lie between firmware and body, and
the others change the bytes at the board's connector.
"""

from __future__ import annotations

import argparse
import math
import re
import sys
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.errors import LinkLostError
from acsar_gym.links import open_link
from acsar_gym.links.base import Link, LinkWrapper
from acsar_gym.links.simulated import SimulatedLink
from acsar_gym.physics.bodies import make_body
from acsar_gym.physics.body import Body
from acsar_gym.protocol import MOTORS, ZERO, Decoder, Speeds, encode
from acsar_gym.worlds import Scene

BOOT_TIME = 1.5
"""Time for which a board is silent after a reset [s]."""
STALE_TIME = 0.3
"""Time for which a stale board repeats a line [s]."""
RUNAWAY_SPEED = 14.4
"""How much faster than commanded a wheel of `assets/firmware` turns if its encoder is reversed, so
that the speed loop drives it away from its command [rad/s]."""
LINE_JITTER = 0.01
"""Lines arrive up to this much early or late [s]."""
NAMES = {
    # Of motors, outside the model that `identify` fits: numbers.
    *("backward-gain", "overshoot", "reversal-hold"),
    # Of wiring and timing.
    *("swapped-encoders", "swapped-motors", "reversed-encoder", "reversed-motor"),
    *("no-timeout", "command-timeout", "feedback-rate"),
    # Of bytes. Times: from the first command until it is "frozen", between "resets", by which an
    # "echo" is late, and between the beginnings of STALE_TIME, in which it repeats a line [s].
    *("at-comma", "no-comma", "dead-wheel", "dead-encoder", "runaway", "feedback-factor"),
    *("frozen", "resets", "echo", "stale", "set-points", "upper-case-commands"),
    *("unpadded", "padded-space"),
}
"""Names of quirks. "set-points" sends the commanded speeds as feedback."""
MIRRORED_LETTERS = str.maketrans("abcd", "badc")
"""Letters of the wheels on the other side."""

Quirks = dict[str, str]
"""Names and values."""


def parse_quirks(quirks: Sequence[str]) -> Quirks:
    """Quirks such as "at-comma" and "dead-wheel=c" by name."""
    parsed = {name: value for name, _, value in (quirk.partition("=") for quirk in quirks)}
    assert parsed.keys() <= NAMES, quirks
    return parsed


def apply_to_config(quirks: Quirks, config: RobotConfig) -> RobotConfig:
    """Return the config of a robot with these quirks of wiring and timing."""
    firmware: dict[str, Any] = {}
    for name in ("command-timeout", "feedback-rate"):
        if name in quirks:
            firmware[name.replace("-", "_")] = float(quirks[name])
    if "no-timeout" in quirks:
        firmware["command_timeout"] = None

    wheels: dict[str, dict[str, Any]] = config.wheels.model_dump()
    for wheel in wheels.values():
        for device in ("encoder", "motor"):
            if f"swapped-{device}s" in quirks:
                wheel[device] = wheel[device].translate(MIRRORED_LETTERS)
    for name, sign in (("reversed-encoder", "sign"), ("reversed-motor", "motor_sign")):
        if name in quirks:
            wheels[quirks[name]][sign] *= -1
    return config.with_(firmware=firmware, wheels=wheels)


def make_link(name: str, config: RobotConfig, quirks: Quirks) -> Link:
    """Make a simulated robot with these quirks. The config has those of wiring and timing."""
    if not quirks:
        return open_link(name, config)
    motors: Any = QuirkyMotors  # all that a body has
    link = SimulatedLink(config, lambda: motors(make_body(name, config), config, quirks))
    return QuirkyLink(link, config, quirks)


def board(*names: str, robot: RobotConfig | None = None) -> Link:
    """Make a board in simulated time that has these quirks, with the robot's own parameters."""
    quirks = parse_quirks(names)
    link = make_link("planar", apply_to_config(quirks, robot or RobotConfig()), quirks)
    link.reset(Scene())
    return link


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

    arrivals: list[tuple[float, bytes]] = []  # noqa: RUF012 - set by each period

    def __init__(self, link: Link, config: RobotConfig, quirks: Quirks) -> None:
        super().__init__(link)
        self._quirks = quirks
        self._comma = config.trailing_comma
        self._top_speed = config.motor.max_speed
        self._pad = b"" if "unpadded" in quirks else b" " if "padded-space" in quirks else b"0"
        self._pause = float(quirks.get("frozen") or quirks.get("resets") or math.inf)

        def letter_of(quirk: str, part: str) -> int | None:
            """Return the index of the letter of a wheel's motor or encoder."""
            wheel = quirks.get(quirk)
            return MOTORS.index(getattr(getattr(config.wheels, wheel), part)) if wheel else None

        self._dead_motor = letter_of("dead-wheel", "motor")
        self._runaway = letter_of("runaway", "motor")
        self._factors = [float(quirks.get("feedback-factor", "1"))] * len(MOTORS)
        for name, factor in (("runaway", -1.0), ("dead-encoder", 0.0)):
            if (encoder := letter_of(name, "encoder")) is not None:
                self._factors[encoder] *= factor
        self.reset(Scene())

    def reset(self, scene: Scene) -> None:
        """Reset robot and board."""
        self.inner.reset(scene)
        self._input = b""
        self._command = b""
        self._echoes: deque[tuple[float, bytes]] = deque()
        self._sent = b""
        self.arrivals = []
        self._clock = 0.0
        self._stops_at = math.inf
        self._wakes_at = -math.inf

    def write(self, data: bytes) -> None:
        """Take bytes, unless the board hangs or boots."""
        if self._clock < self._wakes_at:
            return
        if data and self._stops_at == math.inf:
            self._stops_at = self._clock + self._pause
        *lines, self._input = (self._input + data).split(b"\n")
        for line in lines:
            if command := line.strip():
                self._command = command + b"\r\n"
                if "echo" in self._quirks:
                    due = self._clock + float(self._quirks["echo"] or 0.005)
                    self._echoes.append((due, self._command))
            self.inner.write(self._take(line) + b"\n")

    def _take(self, line: bytes) -> bytes:
        """Return what the board takes of a line."""
        if "upper-case-commands" in self._quirks:
            line = line.lower() if line == line.upper() else b""
        if "at-comma" in self._quirks:
            line = line[: line.rfind(b",") + 1]
        if "no-comma" in self._quirks and line.rstrip().endswith(b","):
            line = b",".join(line.split(b",")[:-2])
        if self._dead_motor is None and self._runaway is None:
            return line

        for reading in Decoder().feed(line + b"\n"):
            speeds = list(reading.over(ZERO))
            if self._dead_motor is not None:
                speeds[self._dead_motor] = 0.0
            if self._runaway is not None and (command := speeds[self._runaway]):
                fastest = min(abs(command) + RUNAWAY_SPEED, self._top_speed)
                speeds[self._runaway] = math.copysign(fastest, command)
            line = encode(speeds).rstrip()
        return line

    def advance(self, period: float) -> bytes:
        """Let time pass, and return what the board sends meanwhile."""
        lines = self.inner.advance(period).splitlines(keepends=True)
        sent = [self._send(line) for line in lines]
        self.arrivals = []
        self._clock += period
        if self._clock < self._wakes_at:
            return b""
        if sent and self._clock >= self._stops_at:  # in mid-line, with the motors off
            self.inner.write(b"\n" + encode(ZERO))
            self._wakes_at = self._clock + BOOT_TIME if "resets" in self._quirks else math.inf
            self._stops_at = self._wakes_at + self._pause
            return sent[0][: len(sent[0]) // 2]

        stamps = [stamp for stamp, _ in self.inner.arrivals]
        self.arrivals = list(zip(stamps, sent, strict=False))
        echoes = []
        while self._echoes and self._echoes[0][0] <= self._clock:
            echoes.append(self._echoes.popleft()[1])
        return b"".join([*echoes, *sent])

    def _send(self, line: bytes) -> bytes:
        """Return how the board writes a line of feedback."""
        every = float(self._quirks.get("stale", "inf"))
        if self._sent and every < math.inf and self._clock % every <= STALE_TIME:
            return self._sent
        repeats_commands = "set-points" in self._quirks and self._command
        for reading in Decoder().feed(self._command if repeats_commands else line):
            speeds = np.multiply(reading.over(ZERO), self._factors).tolist()
            line = encode(speeds, trailing_comma=self._comma)
        self._sent = re.sub(rb"(?<=[pn])0", self._pad, line)
        return self._sent


class LikeABoard(LinkWrapper):
    """A simulated robot that is real for the driver."""

    is_real = True
    truth = None
    lateness = 0.0


class Fault(NamedTuple):
    """What motors get of commands, and what encoders send of speeds: matrices (4, 4)."""

    commands: NDArray[np.float64] = np.eye(4)
    feedback: NDArray[np.float64] = np.eye(4)


FAULTS: dict[str, Callable[[NDArray[np.float64]], Fault]] = {
    "dead": lambda wheel: Fault(commands=np.eye(4) - wheel),
    "blocked": lambda wheel: Fault(feedback=np.eye(4) - wheel),
    "reversed": lambda wheel: Fault(feedback=np.eye(4) - 2.0 * wheel),
    "twice as fast": lambda wheel: Fault(feedback=np.eye(4) + wheel),
    "all twice as fast": lambda _: Fault(feedback=2.0 * np.eye(4)),
    "swapped sides": lambda _: Fault(feedback=np.eye(4)[[1, 0, 3, 2]]),
    "all zero": lambda _: Fault(feedback=np.zeros((4, 4))),
}
"""Faults by name. Their argument is a matrix (4, 4), which is 1 for the faulty wheel alone."""


def make_fault(kind: str, wheel: int) -> Fault:
    """Return a fault by name, of one wheel or of all."""
    return FAULTS[kind](np.diag(np.eye(4)[wheel]))


class FaultyBoard(LinkWrapper):
    """A simulated robot that is real for the driver, with late and lost lines, and a fault.

    Attributes:
        failed_at: Time from which on the wheels are commanded to turn with the fault [s]. NaN
            before it is known.
        sent: Newest command of the driver [rad/s].
        measured: Newest speeds that the driver gets [rad/s].

    Args:
        link: Simulated link.
        rng: Draws which lines are late or lost.
        fault: Fault of the wheels.
        after: Time from the first command that turns wheels to the fault [s].
        dropped: Share of lines that are lost, of commands and of feedback.
    """

    is_real = True
    lateness: float | None = 0.0

    def __init__(
        self,
        link: Link,
        rng: np.random.Generator,
        fault: Fault | None = None,
        *,
        after: float = 0.0,
        dropped: float = 0.0,
    ) -> None:
        super().__init__(link)
        self._rng = rng
        self._fault = fault
        self._after = after
        self._dropped = dropped

    def reset(self, scene: Scene) -> None:
        super().reset(scene)
        self.failed_at = math.nan
        self.sent: Speeds = ZERO
        self.measured: Speeds = ZERO
        self._commands = Decoder()
        self._feedback = Decoder()
        self._lines: deque[tuple[float, bytes]] = deque()

    def write(self, data: bytes) -> None:
        for reading in self._commands.feed(data):
            self.sent = reading.over(self.sent)
        if math.isnan(self.failed_at) and any(self.sent):
            self.failed_at = self.now() + self._after
        if self._rng.random() >= self._dropped:
            super().write(encode((self._find_fault().commands @ self.sent).tolist()))

    def advance(self, period: float) -> bytes:
        for line in super().advance(period).splitlines(keepends=True):
            if self._rng.random() >= self._dropped:
                delay = self._rng.uniform(-0.5 * period, 2.0 * LINE_JITTER - 0.5 * period)
                self._lines.append((self.now() + delay, line))

        lines = b""
        while self._lines and self._lines[0][0] <= self.now():
            for reading in self._feedback.feed(self._lines.popleft()[1]):
                a, b, c, d = (self._find_fault().feedback @ reading.over(ZERO)).tolist()
                self.measured = (a, b, c, d)
                lines += encode(self.measured)
        return lines

    def _find_fault(self) -> Fault:
        """Return the fault, once it is there."""
        if self._fault is not None and self.now() >= self.failed_at - 1e-9:
            return self._fault
        return Fault()


class FailingLink(LinkWrapper):
    """Fails in every episode, some time after the first command that turns wheels.

    Args:
        link: Link whose cable is pulled or whose board falls silent.
        after: Time until it fails [s].
        silent: Whether the board falls silent until the next reset. Otherwise its cable is pulled,
            so that the link is lost until it is opened again.
    """

    def __init__(self, link: Link, after: float, *, silent: bool = False) -> None:
        super().__init__(link)
        self._after = after
        self._silent = silent
        self._decoder = Decoder()
        self._fails_at = math.inf

    def open(self) -> None:
        self._fails_at = math.inf
        self.inner.open()

    def reset(self, scene: Scene) -> None:
        self._fails_at = math.inf
        self.inner.reset(scene)

    def write(self, data: bytes) -> None:
        if self._has_failed():
            return
        turning = any(reading.speeds != ZERO for reading in self._decoder.feed(data))
        if turning and self._fails_at == math.inf:
            self._fails_at = self.inner.now() + self._after
        self.inner.write(data)

    def advance(self, period: float) -> bytes:
        data = self.inner.advance(period)
        return b"" if self._has_failed() else data

    def _has_failed(self) -> bool:
        """Whether the board is silent. Raises LinkLostError if the cable is out."""
        failed = self.inner.now() >= self._fails_at
        if failed and not self._silent:
            self.inner.close()
            raise LinkLostError("robot0: lost while in use (unplugged)", "check the cable")
        return failed


def emulate() -> None:
    """Run `acsar-gym emulate` with the quirks that follow --quirk in the arguments."""
    from acsar_gym.tools.cli import main
    from acsar_gym.tools.emulation import board

    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--quirk", nargs="*", default=[])
    options, sys.argv[1:] = parser.parse_known_args()
    quirks = parse_quirks(options.quirk)
    emulator: Any = board
    sound = emulator.Emulator
    emulator.Emulator = lambda config, **more: sound(apply_to_config(quirks, config), **more)
    emulator.open_link = lambda body, config: make_link(body, config, quirks)
    main()


if __name__ == "__main__":
    emulate()
