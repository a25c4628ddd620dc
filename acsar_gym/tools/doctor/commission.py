"""Finds how a board is wired and programmed, by turning its wheels: one by one, then together."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from acsar_gym.config import RobotConfig, WheelConfig, WheelsConfig
from acsar_gym.errors import ConfigError, escape_unprintable, show_value
from acsar_gym.protocol import MOTORS, WHEELS
from acsar_gym.safety.layer import Safety
from acsar_gym.tools.doctor import ratios
from acsar_gym.tools.doctor.board import (
    BoardProbe,
    CommandTimeout,
    ResponseDelays,
    StepResponse,
    WheelAnswer,
    report_resets,
    round_rate,
    spin_wheel,
    stop_wheels,
    takes_last_value,
)
from acsar_gym.tools.doctor.checks import Check

SeenWheel = tuple[int, int] | None
"""Which wheel was seen to turn, and 1 for forward, -1 for backward; None if none turned."""
OTHER_SIDE = (1, 0, 3, 2)
"""Indices of the wheels on the other side."""
WATCH_ADVICE = "watch: a turns front right, b front left, c rear left, d rear right, forward"
AS_ROBOT_FILE = "as the robot's file says"
UNLESS_BACKWARD = " (or its motor, if the wheel turned backward)"


def parse_seen(answer: str, letter: int) -> SeenWheel:
    """Read what somebody saw while one letter was commanded forward.

    Args:
        answer: letter of the wheel that turned, with n for backward (or p for forward) behind it;
            "none" if none turned; empty for the letter's own wheel.
        letter: index of the commanded letter.

    Raises:
        ConfigError: it says none of these.
    """
    said = answer.strip().lower()
    if said in ("none", "0"):
        return None
    said = said or MOTORS[letter]
    if said[0] in MOTORS and said[1:] in ("", "p", "n"):
        return MOTORS.index(said[0]), -1 if said[1:] == "n" else 1
    raise ConfigError(
        f"{show_value(answer)}: write the wheel that turned (a front right, b front left, "
        "c rear left, "
        "d rear right), an n behind it if it turned backward, or none"
    )


def parse_all_seen(said: Sequence[str]) -> list[SeenWheel]:
    """Read what was seen for a, b, c, d; ConfigError where it can't be. See `seen`."""
    if len(said) != len(MOTORS):
        raise ConfigError(
            f"--saw {' '.join(said)}: must be four, the wheels that turned for a, b, c and d, such "
            "as b a d c; DEVICE stands before the options"
        )
    eyes = [parse_seen(answer, letter) for letter, answer in enumerate(said)]
    wheels = [saw[0] for saw in eyes if saw is not None]
    if len(set(wheels)) < len(wheels):
        raise ConfigError(f"{' '.join(said)}: one wheel turned for two letters: look again")
    return eyes


def infer_wiring(
    answers: Sequence[WheelAnswer], eyes: Sequence[SeenWheel] | None, config: RobotConfig
) -> WheelsConfig:
    """Infer the wiring; wheels of which nothing is known keep their letters, or those left.

    Args:
        answers: of the encoders, for the letters a, b, c, d.
        eyes: what was seen to turn, for each; None if nobody looked: motors are then taken to be
            where the robot's file says.
        config: of the robot, as its file says.
    """
    own = [(MOTORS.index(wheel.motor), wheel.motor_sign) for wheel in config.wheels.each]
    letters = [letter for letter, _ in own]
    motors: dict[int, tuple[int, int]] = {}
    encoders: dict[int, tuple[int, int]] = {}
    for answer in answers:
        wheel = letters.index(answer.letter)
        saw = (wheel, own[wheel][1]) if eyes is None else eyes[answer.letter]
        if saw is None:
            continue
        wheel, way = saw
        motors[wheel] = answer.letter, way
        if answer.encoder is not None and answer.encoder not in {e for e, _ in encoders.values()}:
            sign = answer.sign * way if answer.is_right else config.wheels.each[wheel].sign
            encoders[wheel] = answer.encoder, sign
    heard = [(MOTORS.index(wheel.encoder), wheel.sign) for wheel in config.wheels.each]
    return _config(_filled(motors, own), _filled(encoders, heard))


def _filled(
    known: dict[int, tuple[int, int]], own: Sequence[tuple[int, int]]
) -> dict[int, tuple[int, int]]:
    """Give the other wheels their own letters and signs, or letters that are left."""
    left = set(range(4)) - {letter for letter, _ in known.values()}
    filled = dict(known)
    others = [wheel for wheel in range(4) if wheel not in known]
    for wheel in sorted(others, key=lambda wheel: own[wheel][0] not in left):
        filled[wheel] = own[wheel] if own[wheel][0] in left else (min(left), 1)
        left.discard(filled[wheel][0])
    return filled


def _config(
    motors: dict[int, tuple[int, int]], encoders: dict[int, tuple[int, int]]
) -> WheelsConfig:
    fields: dict[str, Any] = {
        letter: {
            "motor": MOTORS[motors[wheel][0]],
            "motor_sign": motors[wheel][1],
            "encoder": MOTORS[encoders[wheel][0]],
            "sign": encoders[wheel][1],
        }
        for wheel, letter in enumerate(MOTORS)
    }
    return WheelsConfig(**fields)


def check_wiring(
    answers: Sequence[WheelAnswer],
    eyes: Sequence[SeenWheel] | None,
    config: RobotConfig,
    found: WheelsConfig,
) -> Iterator[Check]:
    """Say what was found about each wheel, and about all of them.

    Args:
        answers: of the encoders, for the letters a, b, c, d.
        eyes: what was seen to turn; None if nobody looked.
        config: as it was configured.
        found: the wiring that was inferred.
    """
    for wheel, name in enumerate(WHEELS):
        yield _wheel(wheel, name, answers, eyes, config, found.each[wheel])
    yield _sides(answers, eyes, config, found)


def _wheel(
    wheel: int,
    name: str,
    answers: Sequence[WheelAnswer],
    eyes: Sequence[SeenWheel] | None,
    config: RobotConfig,
    found: WheelConfig,
) -> Check:
    """Say what was found about one wheel."""
    answer = answers[MOTORS.index(found.motor)]
    heard = MOTORS[answer.encoder] if answer.encoder is not None else None
    if heard is None or heard != found.encoder:
        return _dead(wheel, name, answer, eyes)
    way = "forward" if found.sign == 1 else "backward"
    turns = f"motor {found.motor}" + (" reversed" if found.motor_sign == -1 else "")
    text = f"{turns}, encoder {heard} counts {way}, measured/commanded {abs(answer.ratio):.2f}"
    if len(answer.moving) > 1:
        others = ", ".join(MOTORS[k] for k in answer.moving[1:])
        return Check(name, "fail", f"{text}; encoder {others} turns with it", "check its wires")
    if not answer.is_right:
        text = f"{turns}, encoder {heard}: {ratios.describe_wheel(answer)}"
        return Check(name, "fail", text, ratios.explain_wheel(answer, answers, config))
    if found == config.wheels.each[wheel]:
        return Check(name, "ok", text)
    return Check(
        name,
        "warn",
        f"{text}: {_different(found, wheel, config.wheels, looked=eyes is not None)}",
        _mapping(wheel, found),
    )


def _different(found: WheelConfig, wheel: int, file: WheelsConfig, *, looked: bool) -> str:
    """Say how a wheel's wiring differs from that in the robot's file, or from its letter's."""
    own, parts = file.each[wheel], []
    if found.motor != own.motor:
        parts.append("its motor has another letter")
    if found.motor_sign != own.motor_sign:
        parts.append("its motor is reversed")
    if found.encoder != own.encoder:
        other = [one.encoder for one in file.each].index(found.encoder)
        parts.append(f"its encoder is swapped with that of {WHEELS[other]}")
    if found.sign != own.sign:
        parts.append("its encoder is reversed" + ("" if looked else UNLESS_BACKWARD))
    return " and ".join(parts) + _unlike(file)


def _unlike(file: WheelsConfig) -> str:
    """Say that a wiring differs from that in the robot's file, if it has one."""
    return "" if file == WheelsConfig() else ", unlike in the robot's file"


def _mapping(wheel: int, found: WheelConfig) -> str:
    """Return the YAML that maps a wheel."""
    usual = WheelConfig(motor=MOTORS[wheel], encoder=MOTORS[wheel])
    fields = {
        name: getattr(found, name)
        for name in WheelConfig.model_fields
        if getattr(found, name) != getattr(usual, name)
    }
    inner = ", ".join(f"{name}: {value}" for name, value in fields.items())
    return f"swap the wires, or use wheels: {{{MOTORS[wheel]}: {{{inner}}}}}"


def _dead(wheel: int, name: str, answer: WheelAnswer, eyes: Sequence[SeenWheel] | None) -> Check:
    """Say that a wheel or its encoder is dead."""
    letter = MOTORS[answer.letter]
    if answer.encoder is not None:
        other = MOTORS[answer.encoder]
        return Check(
            name, "fail", f"encoder {other} answers to motor {letter}, too", "check its wires"
        )
    found = f"dead: no encoder answers to motor {letter}"
    if eyes is None:
        return Check(
            name,
            "fail",
            f"{found}; the wire can't tell whether the motor or the encoder is dead",
            f"look whether {name} turns: if it does, check its encoder, otherwise its motor",
        )
    if any(saw is not None and saw[0] == wheel for saw in eyes):
        return Check(name, "fail", f"{found}: its encoder is dead", "check the encoder's plug")
    return Check(name, "fail", f"{found}: its motor is dead", "check the motor's plug and driver")


def is_assumed(config: RobotConfig, found: WheelsConfig, eyes: Sequence[SeenWheel] | None) -> bool:
    """Whether a wiring was found that the wire alone can't tell from another one."""
    return eyes is None and found != config.wheels


def _sides(
    answers: Sequence[WheelAnswer],
    eyes: Sequence[SeenWheel] | None,
    config: RobotConfig,
    found: WheelsConfig,
) -> Check:
    """Say whether the sides are swapped, and what only eyes can tell."""
    same = found == config.wheels
    if eyes is not None:
        return _judge_seen(_as_seen(answers, eyes), config.wheels, same=same)
    own = config.wheels.each
    heard = [wheel for wheel in range(4) if _answered(answers, found.each[wheel])]
    if heard and all(found.each[w].encoder == own[OTHER_SIDE[w]].encoder for w in heard):
        return Check(
            "wiring",
            "warn",
            "left and right are swapped, of the encoders or of the motors: that it is the encoders "
            "is an assumption, and the robot turns the wrong way where it isn't so",
            f"{WATCH_ADVICE}; where a turned front left, say --saw b a d c",
        )
    if not same:
        return Check(
            "wiring",
            "warn",
            "that encoders are swapped or reversed, and not motors, is an assumption",
            f"{WATCH_ADVICE}; otherwise say what turned, such as --saw b a d c",
        )
    if config.wheels != WheelsConfig():
        return Check("wiring", "ok", AS_ROBOT_FILE)
    return Check(
        "wiring",
        "ok",
        "only eyes see a motor and an encoder that are swapped or reversed together",
        f"{WATCH_ADVICE}; otherwise say what turned, such as --saw b a d c",
    )


def _judge_seen(text: str, file: WheelsConfig, *, same: bool) -> Check:
    """Say whether what was seen is what the robot's file says, and that it counts."""
    if not same:
        fix = "what was seen counts: write it into a robot's file with --out FILE"
        return Check("wiring", "warn", f"{text}{_unlike(file)}", fix)
    return Check("wiring", "ok", text if file == WheelsConfig() else f"{text}, {AS_ROBOT_FILE}")


def _answered(answers: Sequence[WheelAnswer], found: WheelConfig) -> bool:
    """Whether an encoder answered to a wheel's motor."""
    return answers[MOTORS.index(found.motor)].encoder is not None


def _as_seen(answers: Sequence[WheelAnswer], eyes: Sequence[SeenWheel]) -> str:
    """Say which sides are swapped where somebody looked."""
    heard = [answer for answer in answers if answer.encoder is not None]
    crossed = bool(heard) and all(each.encoder == OTHER_SIDE[each.letter] for each in heard)
    saw = [(letter, each[0]) for letter, each in enumerate(eyes) if each is not None]
    mirrored = bool(saw) and all(wheel == OTHER_SIDE[letter] for letter, wheel in saw)
    swapped = [w for w, so in (("motors", mirrored), ("encoders", crossed != mirrored)) if so]
    return f"left and right {' and '.join(swapped)} are swapped" if swapped else "as seen"


SPIN_SPEED = 3.0
"""Wheel speed of the checks [rad/s]; 0.15 m/s at the rim of the usual wheel."""
SLOW_RESPONSE = 0.1
"""A command that takes longer to show is worth a warning [s]."""
RATE_TOLERANCE = 0.05
"""A feedback rate is as configured within this share."""
TIMEOUT_TOLERANCE = 0.03
"""A time-out is as configured within this [s]."""
MAX_QUESTIONS = 5
"""How often a question is asked again."""
DELAY_CHECK, TIMEOUT_CHECK = "command to feedback", "stops when commands stop"
"""Names of checks."""
WHEEL_NAMES = ", ".join(f"{letter} {name}" for letter, name in zip(MOTORS, WHEELS, strict=True))

ASSUMPTION_REMARK = """\
An assumption: the wire can't tell swapped or reversed encoders from motors. Watch the wheels,
and say what turned: acsar-gym doctor DEVICE --spin --saw b a d c --out FILE"""
"""Remark above a wiring that nobody saw."""
AskWatcher = Callable[[str], str]
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

    eyes: Sequence[SeenWheel] | None = None
    ask: AskWatcher | None = None
    changes: dict[str, Any] = field(default_factory=dict)
    finished: bool = False
    assumed: bool = False

    def run(self, ear: BoardProbe, config: RobotConfig) -> Iterator[Check]:
        """Turn the wheels; yield what was found.

        Args:
            ear: hears the board.
            config: of the robot.

        Raises:
            LinkError: the board is lost, or wheels keep turning.
            ConfigError: what was seen can't be.
        """
        speed = min(
            Safety(config).bounded(
                (SPIN_SPEED, SPIN_SPEED, SPIN_SPEED, SPIN_SPEED), (0.0, 0.0, 0.0), 0.0
            )
        )
        stop_wheels(ear, speed)
        answers = self._answers(ear, config, speed)
        if ear.gaps:
            yield report_resets(ear.gaps)
            return
        if ear.decoder.notes:
            yield _said(ear.decoder.notes)
        found = infer_wiring(answers, self.eyes, config)
        yield from check_wiring(answers, self.eyes, config, found)
        heard = [answer for answer in answers if answer.encoder is not None]
        if not heard:
            yield _nothing_turns()
            return
        if not all(answer.is_right for answer in answers):
            for name in ("line end", DELAY_CHECK, TIMEOUT_CHECK):
                yield Check(name, "skip", "needs wheels that turn as commanded", "mend them first")
            return
        yield self._line_end(ear, config, heard, speed)
        if found != config.wheels:
            self._note(config, wheels=found.model_dump())
            self.assumed = is_assumed(config, found, self.eyes)
        letters = [answer.letter for answer in heard]
        encoders = {answer.encoder for answer in heard if answer.encoder is not None}
        together = StepResponse(ear, letters, encoders, speed)
        yield _delay(together.delays(ear.rate))
        yield self._time_out(together.time_out(), config)
        self._note_rate(config, ear.rate)
        if ear.gaps:
            yield report_resets(ear.gaps)
        self.finished = not ear.gaps

    def save(self, config: RobotConfig, path: Path) -> Check:
        """Write a robot with what was found."""
        try:
            robot = config.with_(**self.changes)
        except ConfigError as error:
            return Check("robot file", "fail", f"not written: {error}", "change that field first")
        try:
            robot.save(path, {"wheels": ASSUMPTION_REMARK} if self.assumed else None)
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

    def _answers(self, ear: BoardProbe, config: RobotConfig, speed: float) -> list[WheelAnswer]:
        """Turn one wheel after the other, and ask what was seen.

        Lines have a trailing comma, unless no wheel at all turns with it, or not the last one.
        """
        for comma in (True, False):
            ear.trailing_comma = comma
            answers, said = [], []
            for letter in range(4):
                answers.append(spin_wheel(ear, letter, speed))
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
            self.eyes = parse_all_seen(said)
        return answers

    def _without_comma(self, ear: BoardProbe, answer: WheelAnswer, speed: float) -> WheelAnswer:
        """Turn the last wheel once more, by lines without a trailing comma."""
        ear.trailing_comma = False
        again = spin_wheel(ear, answer.letter, speed)
        ear.trailing_comma = not again.moving
        return again if again.moving else answer

    def _line_end(
        self, ear: BoardProbe, config: RobotConfig, heard: Sequence[WheelAnswer], speed: float
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

    def _time_out(self, found: CommandTimeout | None, config: RobotConfig) -> Check:
        """Say how soon the board stops by itself."""
        configured = config.firmware.command_timeout or math.inf
        after = math.inf if found is None else round(found.after, 2)
        if after != configured and not abs(after - configured) <= TIMEOUT_TOLERANCE:
            self._note(config, firmware={"command_timeout": None if found is None else after})
        if found is None:
            return Check(
                TIMEOUT_CHECK,
                "fail",
                "the wheels keep turning",
                "add a command time-out to the firmware",
            )
        stands = (
            "" if found.standing is None else f"; the wheels stand after {found.standing:.2f} s"
        )
        return Check(TIMEOUT_CHECK, "ok", f"{found.after:.2f} s after the last command{stands}")

    def _note_rate(self, config: RobotConfig, rate: float) -> None:
        """Note the feedback rate, if it isn't the configured one."""
        if abs(rate / config.feedback_rate - 1.0) > RATE_TOLERANCE:
            self._note(config, firmware={"feedback_rate": round_rate(rate)})

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


def _asked(ask: AskWatcher, letter: int, config: RobotConfig) -> str:
    """Ask which wheel turned while a letter was commanded forward, until the answer makes sense."""
    wheel = next(k for k, one in enumerate(config.wheels.each) if one.motor == MOTORS[letter])
    own = MOTORS[wheel] + ("n" if config.wheels.each[wheel].motor_sign == -1 else "")
    question = f"{MOTORS[letter]} was commanded forward: which wheel turned ({WHEEL_NAMES}; "
    question += "n behind it: backward; "
    for _ in range(MAX_QUESTIONS):
        said = ask(f"{question}none; Enter: {own})? ").strip() or own
        with contextlib.suppress(ConfigError):
            parse_seen(said, letter)
            return said
    raise ConfigError("no answer makes sense: start again, or add --yes")


def _said(notes: Sequence[str]) -> Check:
    """Show what the board says in text; that it cuts a motor is a failure."""
    cut = any(note[1:].startswith(" cut:") for note in notes)
    return Check(
        "the board says",
        "fail" if cut else "warn",
        escape_unprintable("; ".join(notes)),
        "a wheel that turns against its motor: set ENCODER_REVERSED or MOTOR_REVERSED in the "
        "board's program; a stalled one: look what blocks it, and at its encoder's plug",
    )


def _delay(found: ResponseDelays | None) -> Check:
    """Say how soon a command shows."""
    if found is None:
        return Check(
            DELAY_CHECK, "fail", "not all wheels turn", "check the motors' power and every encoder"
        )
    slow = found.shortest > SLOW_RESPONSE
    return Check(
        DELAY_CHECK,
        "warn" if slow else "ok",
        f"{found.shortest * 1000.0:.1f} ms from a command's last byte to the first that shows it; "
        f"{found.longest * 1000.0:.1f} ms with the wait for a line",
        "raise the baud rate; set the USB adapter's latency timer to 1 ms" if slow else "",
    )


def _nothing_turns() -> Check:
    return Check(
        DELAY_CHECK,
        "fail",
        "no wheel turns",
        "check the motors' power and every encoder",
    )
