"""Boards that fail, or that are wired and programmed in other ways than the robot's.

`python tests/boards.py emulate --quirk swapped-motors` serves one on a pseudo-terminal.

A quirk is a name such as `at-comma`, or a name and a value such as `dead-wheel=c`. Quirks of wiring
and timing change the emulated robot's config, those of motors lie between firmware and body, and
the others change the bytes at the board's connector.
"""

from __future__ import annotations

import math
import sys
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.errors import LinkLostError
from acsar_gym.links import open_link
from acsar_gym.links.base import Arrivals, Link, LinkWrapper
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
MOTOR_QUIRKS = ("backward-gain", "overshoot", "reversal-hold")
"""Quirks of motors, outside the model that `identify` fits. Their value is a number."""
CONFIG_QUIRKS = {
    "swapped-encoders",
    "swapped-motors",
    "reversed-encoder",
    "reversed-motor",
    "no-timeout",
    "command-timeout",
    "feedback-rate",
}
BYTE_QUIRKS = {
    "at-comma": "",
    "no-comma": "",
    "dead-wheel": "",
    "dead-encoder": "",
    "runaway": "",
    "feedback-factor": "",
    "frozen": "1",  # s after its first command
    "resets": "1",  # every so many seconds
    "echo": "0.005",  # how late each command comes back [s]
    "stale": "3",  # how often a line is repeated for STALE_TIME [s]
    "set-points": "",  # the commanded speeds as feedback
    "upper-case-commands": "",
    "unpadded": "",
    "padded-space": "",
}
"""Quirks of bytes, and their values if none is given."""
MIRRORED_LETTERS = str.maketrans("abcd", "badc")
"""Letters of the wheels on the other side."""

Quirks = dict[str, str]
"""Names and values."""


def parse_quirks(quirks: Sequence[str]) -> Quirks:
    """Quirks such as "at-comma" and "dead-wheel=c" by name."""
    parsed: Quirks = {}
    for quirk in quirks:
        name, _, value = quirk.partition("=")
        assert name in {*MOTOR_QUIRKS, *CONFIG_QUIRKS, *BYTE_QUIRKS}, quirk
        parsed[name] = value or BYTE_QUIRKS.get(name, "")
    return parsed


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
        for device in ("encoder", "motor"):
            if f"swapped-{device}s" in quirks:
                wheel[device] = wheel[device].translate(MIRRORED_LETTERS)
    for name, sign in (("reversed-encoder", "sign"), ("reversed-motor", "motor_sign")):
        if name in quirks:
            wheels[quirks[name]][sign] *= -1
    return config.with_(firmware=firmware, wheels=wheels)


def make_link(name: str, config: RobotConfig, quirks: Quirks) -> Link:
    """Make a simulated robot with these quirks. The config has those of wiring and timing."""
    if quirks.keys().isdisjoint(MOTOR_QUIRKS):
        link = open_link(name, config)
    else:
        motors: Any = QuirkyMotors  # all that a body has
        link = SimulatedLink(config, lambda: motors(make_body(name, config), config, quirks))
    return QuirkyLink(link, config, quirks) if quirks.keys() - MOTOR_QUIRKS else link


def board(*names: str, robot: RobotConfig | None = None) -> QuirkyLink:
    """Make a board in simulated time that has these quirks, with the robot's own parameters."""
    quirks = parse_quirks(names)
    config = apply_to_config(quirks, robot or RobotConfig())
    return QuirkyLink(open_link("planar", config), config, quirks)


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
        self._top_speed = config.motor.max_speed

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
        self._pause = float(quirks.get("frozen") or quirks.get("resets") or math.inf)
        self.reset(Scene())

    def reset(self, scene: Scene) -> None:
        """Reset robot and board."""
        self.inner.reset(scene)
        self._input = b""
        self._command = b""
        self._echoes: deque[tuple[float, bytes]] = deque()
        self._decoder = Decoder()
        self._speeds: Speeds = ZERO
        self._sent = b""
        self._arrived: list[tuple[float, bytes]] = []
        self._clock = 0.0
        self._since_start = 0.0
        self._stops_at = self._pause
        self._wakes_at = -math.inf

    @property
    def arrivals(self) -> Arrivals:
        """When the lines of the newest period arrived [s]."""
        return self._arrived

    @property
    def _is_off(self) -> bool:
        return self._since_start < self._wakes_at

    def write(self, data: bytes) -> None:
        """Take bytes, unless the board hangs or boots."""
        if data:
            self._since_start = max(self._since_start, 1e-9)
        if self._is_off:
            return
        *lines, self._input = (self._input + data).split(b"\n")
        for line in lines:
            if command := line.strip():
                self._command = command + b"\r\n"
                if "echo" in self._quirks:
                    due = self._clock + float(self._quirks["echo"])
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
        self._arrived = []
        self._clock += period
        if self._since_start > 0.0:
            self._since_start += period
        if self._is_off:
            return b""
        if sent and self._since_start >= self._stops_at:  # in mid-line, with the motors off
            self.inner.write(b"\n" + encode(ZERO))
            is_restarted = "resets" in self._quirks
            self._wakes_at = self._since_start + BOOT_TIME if is_restarted else math.inf
            self._stops_at = self._wakes_at + self._pause
            return sent[0][: len(sent[0]) // 2]

        stamps = [stamp for stamp, _ in self.inner.arrivals]
        self._arrived = list(zip(stamps, sent, strict=False))
        echoes = []
        while self._echoes and self._echoes[0][0] <= self._clock:
            echoes.append(self._echoes.popleft()[1])
        return b"".join([*echoes, *sent])

    def _send(self, line: bytes) -> bytes:
        """Return how the board writes a line of feedback."""
        is_repeated = self._clock % float(self._quirks.get("stale", "inf")) <= STALE_TIME
        if "stale" not in self._quirks or not is_repeated or not self._sent:
            self._sent = self._write_speeds(line)
        return self._sent

    def _write_speeds(self, line: bytes) -> bytes:
        """Return a line with the speeds that the board reports, in its own numbers."""
        if "set-points" in self._quirks:
            commands = Decoder().feed(self._command)
            return encode(commands[-1].over(ZERO), trailing_comma=self._comma) if commands else line
        width = {"unpadded": "", "padded-space": "5"}
        form = [width[quirk] for quirk in width if quirk in self._quirks]
        if not form and self._factors == [1.0] * len(MOTORS):
            return line

        for reading in self._decoder.feed(line):
            self._speeds = reading.over(self._speeds)
        speeds = [speed * factor for speed, factor in zip(self._speeds, self._factors, strict=True)]
        if not form:
            return encode(speeds, trailing_comma=self._comma)
        parts = [
            f"{motor}{'n' if speed < 0.0 else 'p'}{abs(speed):{form[0]}.2f}"
            for motor, speed in zip(MOTORS, speeds, strict=True)
        ]
        return (",".join(parts) + "," * self._comma + "\r\n").encode()


class LikeABoard(LinkWrapper):
    """A simulated robot that is real for the driver."""

    is_real = True
    truth = None
    lateness = 0.0


class Overshooting(LikeABoard):
    """A board whose speed loops overshoot, by a quarter of a step."""

    DAMPING = 0.4
    FREQUENCY = 15.0
    SUBSTEP = 0.001

    def __init__(self, link: Link) -> None:
        super().__init__(link)
        self._decoder = Decoder()
        self._set_points: Speeds = ZERO
        self._speeds = np.zeros(4)
        self._rates = np.zeros(4)

    def advance(self, period: float) -> bytes:
        readings = self._decoder.feed(super().advance(period))
        if readings:
            self._set_points = readings[-1].over(self._set_points)
        for _ in range(round(period / self.SUBSTEP)):
            pull = self.FREQUENCY**2 * (np.array(self._set_points) - self._speeds)
            self._rates += self.SUBSTEP * (pull - 2.0 * self.DAMPING * self.FREQUENCY * self._rates)
            self._speeds += self.SUBSTEP * self._rates
        return encode(self._speeds.tolist()) if readings else b""


class Fault(NamedTuple):
    """Factors of what motors get and encoders send, and the order in which speeds are sent."""

    commands: NDArray[np.float64] = np.ones(4)
    feedback: NDArray[np.float64] = np.ones(4)
    order: tuple[int, ...] = (0, 1, 2, 3)


FAULTS: dict[str, Callable[[NDArray[np.bool_]], Fault]] = {
    "dead": lambda wheel: Fault(commands=np.where(wheel, 0.0, 1.0)),
    "blocked": lambda wheel: Fault(feedback=np.where(wheel, 0.0, 1.0)),
    "reversed": lambda wheel: Fault(feedback=np.where(wheel, -1.0, 1.0)),
    "twice as fast": lambda wheel: Fault(feedback=np.where(wheel, 2.0, 1.0)),
    "all twice as fast": lambda _: Fault(feedback=np.full(4, 2.0)),
    "swapped sides": lambda _: Fault(order=(1, 0, 3, 2)),
    "all zero": lambda _: Fault(feedback=np.zeros(4)),
}
"""Faults by name. Their argument is a mask of the faulty wheels."""


def make_fault(kind: str, wheel: int) -> Fault:
    """Return a fault by name, of one wheel or of all."""
    return FAULTS[kind](np.arange(4) == wheel)


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
            commands = self._find_fault().commands
            super().write(encode((commands * self.sent).tolist()))

    def advance(self, period: float) -> bytes:
        for line in super().advance(period).splitlines(keepends=True):
            if self._rng.random() >= self._dropped:
                delay = self._rng.uniform(-0.5 * period, 2.0 * LINE_JITTER - 0.5 * period)
                self._lines.append((self.now() + delay, line))

        lines = b""
        while self._lines and self._lines[0][0] <= self.now():
            for reading in self._feedback.feed(self._lines.popleft()[1]):
                fault = self._find_fault()
                speeds = fault.feedback * reading.over(ZERO)
                a, b, c, d = speeds[list(fault.order)].tolist()
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

    first = sys.argv.index("--quirk") if "--quirk" in sys.argv else len(sys.argv)
    end = first + 1
    while end < len(sys.argv) and not sys.argv[end].startswith("--"):
        end += 1
    quirks = parse_quirks(sys.argv[first + 1 : end])
    del sys.argv[first:end]

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
