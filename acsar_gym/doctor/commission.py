"""Finds how a board is wired and programmed, by turning its wheels: one by one, then together."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from acsar_gym.config import RobotConfig
from acsar_gym.doctor import wiring
from acsar_gym.doctor.checks import Check
from acsar_gym.doctor.feedback import resets, rounded
from acsar_gym.doctor.listening import Ear
from acsar_gym.doctor.response import Delays, TimeOut, Together
from acsar_gym.doctor.spinning import Answer, spun, stand, takes_last_value
from acsar_gym.errors import ConfigError, printable
from acsar_gym.protocol import MOTORS, WHEELS
from acsar_gym.safety.layer import Safety

SPIN = 3.0
"""Wheel speed of the checks [rad/s]; 0.15 m/s at the rim of the usual wheel."""
SLOW = 0.1
"""A command that takes longer to show is worth a warning [s]."""
RATE_WITHIN = 0.05
"""A feedback rate is as configured within this share."""
TIMEOUT_WITHIN = 0.03
"""A time-out is as configured within this [s]."""
ATTEMPTS = 5
"""How often a question is asked again."""
DELAY, TIMEOUT = "command to feedback", "stops when commands stop"
"""Names of checks."""
NAMES = ", ".join(f"{letter} {name}" for letter, name in zip(MOTORS, WHEELS, strict=True))

ASSUMED = """\
An assumption: the wire can't tell swapped or reversed encoders from motors. Watch the wheels,
and say what turned: acsar-gym doctor DEVICE --spin --saw b a d c --out FILE"""
"""Remark above a wiring that nobody saw."""
Ask = Callable[[str], str]
"""Asks whoever watches the robot."""


@dataclass
class Commission:
    """What is asked of a commissioning, and what it found.

    Attributes:
        eyes: which wheel was seen to turn for each letter; None: nobody looked, unless `ask`.
        ask: asks for that after each letter; None: don't ask.
        changes: fields of the config that differ from it, as found.
        finished: whether all was found.
        assumed: whether the wiring is one of several that answer alike.
    """

    eyes: Sequence[wiring.Seen] | None = None
    ask: Ask | None = None
    changes: dict[str, Any] = field(default_factory=dict)
    finished: bool = False
    assumed: bool = False

    def run(self, ear: Ear, config: RobotConfig) -> Iterator[Check]:
        """Turn the wheels; yield what was found.

        Args:
            ear: hears the board.
            config: of the robot.

        Raises:
            LinkError: the board is lost, or wheels keep turning.
            ConfigError: what was seen can't be.
        """
        speed = min(Safety(config).bounded((SPIN, SPIN, SPIN, SPIN), (0.0, 0.0, 0.0), 0.0))
        stand(ear, speed)
        answers = self._answers(ear, config, speed)
        if ear.gaps:
            yield resets(ear.gaps)
            return
        if ear.decoder.notes:
            yield _said(ear.decoder.notes)
        found = wiring.wiring(answers, self.eyes, config)
        yield from wiring.checks(answers, self.eyes, config, found)
        heard = [answer for answer in answers if answer.encoder is not None]
        if not heard:
            yield _nothing_turns()
            return
        if not all(answer.is_right for answer in answers):
            for name in ("line end", DELAY, TIMEOUT):
                yield Check(name, "skip", "needs wheels that turn as commanded", "mend them first")
            return
        yield self._line_end(ear, config, heard, speed)
        if found != config.wheels:
            self._note(config, wheels=found.model_dump())
            self.assumed = wiring.assumed(config, found, self.eyes)
        letters = [answer.letter for answer in heard]
        encoders = {answer.encoder for answer in heard if answer.encoder is not None}
        together = Together(ear, letters, encoders, speed)
        yield _delay(together.delays(ear.rate))
        yield self._time_out(together.time_out(), config)
        self._note_rate(config, ear.rate)
        if ear.gaps:
            yield resets(ear.gaps)
        self.finished = not ear.gaps

    def save(self, config: RobotConfig, path: Path) -> Check:
        """Write a robot with what was found."""
        try:
            robot = config.with_(**self.changes)
        except ConfigError as error:
            return Check("robot file", "fail", f"not written: {error}", "change that field first")
        try:
            robot.save(path, {"wheels": ASSUMED} if self.assumed else None)
        except ConfigError as error:
            return Check("robot file", "fail", str(error), "give another file with --out")
        differing = ", ".join(_names(self.changes)) or "nothing differs"
        if self.assumed:
            return Check(
                "robot file",
                "warn",
                f"{path}: {differing}; which wheel is left or right is an assumption, or which way "
                "it turns",
                f"watch one wheel with --spin --saw ...; then use --robot {path}",
            )
        return Check("robot file", "ok", f"{path}: {differing}", f"use --robot {path}")

    def _answers(self, ear: Ear, config: RobotConfig, speed: float) -> list[Answer]:
        """Turn one wheel after the other, and ask what was seen.

        Lines have a trailing comma, unless no wheel at all turns with it, or not the last one.
        """
        for comma in (True, False):
            ear.trailing_comma = comma
            answers, said = [], []
            for letter in range(4):
                answers.append(spun(ear, letter, speed))
                if self.ask is not None:
                    said.append(_asked(self.ask, letter, config))
                    ear.clear()
                if ear.gaps:
                    break
            if ear.gaps or any(answer.moving for answer in answers):
                break
        if ear.trailing_comma and not answers[-1].moving and len(answers) == len(MOTORS):
            answers[-1] = self._without_comma(ear, answers[-1], speed)
        if self.ask is not None:
            self.eyes = wiring.eyes_of(said)
        return answers

    def _without_comma(self, ear: Ear, answer: Answer, speed: float) -> Answer:
        """Turn the last wheel once more, by lines without a trailing comma."""
        ear.trailing_comma = False
        again = spun(ear, answer.letter, speed)
        ear.trailing_comma = not again.moving
        return again if again.moving else answer

    def _line_end(
        self, ear: Ear, config: RobotConfig, heard: Sequence[Answer], speed: float
    ) -> Check:
        """Find whether the board takes a value at its comma or at the line's end."""
        wanted = ear.trailing_comma
        if takes_last_value(ear, heard[-1].letter, speed, comma=not wanted):
            return Check("line end", "ok", "a value is taken at the line's end, and at its comma")
        self._note(config, trailing_comma=wanted)
        text = (
            "a value is taken at its comma: the last one needs a trailing comma"
            if wanted
            else "the last value is taken without a trailing comma only"
        )
        if wanted == config.trailing_comma:
            return Check("line end", "ok", text)
        return Check("line end", "warn", text, f"use trailing_comma: {str(wanted).lower()}")

    def _time_out(self, found: TimeOut | None, config: RobotConfig) -> Check:
        """Say how soon the board stops by itself."""
        configured = config.firmware.command_timeout or math.inf
        after = math.inf if found is None else round(found.after, 2)
        if after != configured and not abs(after - configured) <= TIMEOUT_WITHIN:
            self._note(config, firmware={"command_timeout": None if found is None else after})
        if found is None:
            return Check(
                TIMEOUT, "fail", "the wheels keep turning", "add a command time-out to the firmware"
            )
        stands = (
            "" if found.standing is None else f"; the wheels stand after {found.standing:.2f} s"
        )
        return Check(TIMEOUT, "ok", f"{found.after:.2f} s after the last command{stands}")

    def _note_rate(self, config: RobotConfig, rate: float) -> None:
        """Note the feedback rate, if it isn't the configured one."""
        if abs(rate / config.feedback_rate - 1.0) > RATE_WITHIN:
            self._note(config, firmware={"feedback_rate": rounded(rate)})

    def _note(self, config: RobotConfig, **changes: Any) -> None:
        """Note fields that differ from the config's."""
        for name, value in changes.items():
            if isinstance(value, dict):
                self.changes[name] = {**self.changes.get(name, {}), **value}
            elif getattr(config, name) != value:
                self.changes[name] = value


def _names(changes: dict[str, Any]) -> list[str]:
    """Return the names of changed fields, those of sections with a dot."""
    names = []
    for name, value in changes.items():
        inner = value if isinstance(value, dict) and name != "wheels" else None
        names += [f"{name}.{field}" for field in inner] if inner else [name]
    return names


def _asked(ask: Ask, letter: int, config: RobotConfig) -> str:
    """Ask which wheel turned while a letter was commanded forward, until the answer makes sense."""
    wheel = next(k for k, one in enumerate(config.wheels.each) if one.motor == MOTORS[letter])
    own = MOTORS[wheel] + ("n" if config.wheels.each[wheel].motor_sign == -1 else "")
    question = f"{MOTORS[letter]} was commanded forward: which wheel turned ({NAMES}; "
    question += "n behind it: backward; "
    for _ in range(ATTEMPTS):
        said = ask(f"{question}none; Enter: {own})? ").strip() or own
        with contextlib.suppress(ConfigError):
            wiring.seen(said, letter)
            return said
    raise ConfigError("no answer makes sense: start again, or add --yes")


def _said(notes: Sequence[str]) -> Check:
    """Show what the board says in text; that it cuts a motor is a failure."""
    cut = any(note[1:].startswith(" cut:") for note in notes)
    return Check(
        "the board says",
        "fail" if cut else "warn",
        printable("; ".join(notes)),
        "a wheel that turns against its motor: set ENCODER_REVERSED or MOTOR_REVERSED in the "
        "board's program; a stalled one: look what blocks it, and at its encoder's plug",
    )


def _delay(found: Delays | None) -> Check:
    """Say how soon a command shows."""
    if found is None:
        return Check(
            DELAY, "fail", "not all wheels turn", "check the motors' power and every encoder"
        )
    slow = found.shortest > SLOW
    return Check(
        DELAY,
        "warn" if slow else "ok",
        f"{found.shortest * 1000.0:.1f} ms from a command's last byte to the first that shows it; "
        f"{found.longest * 1000.0:.1f} ms with the wait for a line",
        "raise the baud rate; set the USB adapter's latency timer to 1 ms" if slow else "",
    )


def _nothing_turns() -> Check:
    return Check(
        DELAY,
        "fail",
        "no wheel turns",
        "check the motors' power and every encoder",
    )
