"""Finds how a board is wired and programmed, by turning its wheels: one by one, then together."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import Any

from acsar_gym.config import RobotConfig, WheelConfig, WheelsConfig
from acsar_gym.errors import ConfigError, escape_unprintable, show_value
from acsar_gym.protocol import MOTORS, WHEELS
from acsar_gym.safety.layer import Safety
from acsar_gym.tools.commission.checks import Check, warn_if
from acsar_gym.tools.sysid.board import (
    RATIO_TOLERANCE,
    RESPONSE_TRIALS,
    BoardProbe,
    StepResponse,
    WheelAnswer,
    find_stale,
    likely_units,
    sends_set_points,
    spin_wheel,
    stop_wheels,
    takes_last_value,
    takes_upper_case,
)

SPIN_SPEED = 3.0
"""Wheel speed of the checks [rad/s]; 0.15 m/s at the rim of the usual wheel."""
SLOW_RESPONSE = 0.1
"""A command that takes longer to show is worth a warning [s]."""
RATE_TOLERANCE = 0.05
"""A feedback rate is as configured within this share."""
TIMEOUT_TRIALS, SAME_TIMEOUT = 4, 0.06
"""Most measurements of a time-out, of which two must differ by less than this [s]."""
EXACT_RATIO = 0.005
"""A measured speed is exactly the commanded one within this share."""
TIMEOUT_TOLERANCE = 0.03
"""A time-out is as configured within this [s]."""
HIGHEST_SPEED = 99.9
"""Speed above which a line with two digits may have cut a speed off [rad/s]."""
MAX_QUESTIONS = 5
"""How often a question is asked again."""
DELAY_CHECK, TIMEOUT_CHECK = "command to feedback", "stops when commands stop"
"""Names of checks."""
WHEEL_NAMES = ", ".join(f"{letter} {name}" for letter, name in zip(MOTORS, WHEELS, strict=True))
OTHER_SIDE = (1, 0, 3, 2)
"""Indices of the wheels on the other side."""

ASSUMPTION_REMARK = """\
An assumption: the wire can't tell swapped or reversed encoders from motors. Watch the wheels,
and say what turned: acsar-gym doctor DEVICE --spin --saw b a d c --out FILE"""
"""Remark above a wiring that nobody saw."""
WATCH_ADVICE = "watch: a turns front right, b front left, c rear left, d rear right, forward"
AS_ROBOT_FILE = "as the robot's file says"
IN_PROGRAM = "in the board's program"
REVERSED_FIX = f"set ENCODER_REVERSED {IN_PROGRAM} (MOTOR_REVERSED, if the wheel turned backward)"
SWAPPED_FIX = f"swap the wires, or the encoder's pins {IN_PROGRAM}"
"""What mends a board whose own speed loop meets the wrong sign, or the encoder of another wheel: it
drives its wheel away from the command, whatever the robot's file says."""
NOTHING_TURNS = "check the motors' power and every encoder"

AskWatcher = Callable[[str], str]
"""Asks whoever watches the robot."""
SeenWheel = tuple[int, int] | None
"""Which wheel was seen to turn, and 1 for forward, -1 for backward; None if none turned."""


def parse_seen(answer: str, letter: int) -> SeenWheel:
    """Read what somebody saw while one letter was commanded forward.

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
        f"{show_value(answer)}: write the wheel that turned (a front right, b front left, c rear "
        "left, d rear right), an n behind it if it turned backward, or none"
    )


def parse_all_seen(said: Sequence[str]) -> list[SeenWheel]:
    """Read what was seen for a, b, c, d; ConfigError where it can't be. See `parse_seen`."""
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

    def run(self, probe: BoardProbe, config: RobotConfig) -> Iterator[Check]:
        """Turn the wheels; yield what was found.

        Raises:
            LinkError: the board is lost, or wheels keep turning.
            ConfigError: what was seen can't be.
        """
        four = (SPIN_SPEED, SPIN_SPEED, SPIN_SPEED, SPIN_SPEED)
        speed = min(Safety(config).bounded(four, (0.0, 0.0, 0.0), 0.0))
        stop_wheels(probe, speed)
        answers = self._spin_each(probe, config, speed)
        if probe.gaps:
            yield report_resets(probe.gaps)
            return
        if notes := probe.decoder.notes:
            yield _report_notes(notes)
        if (refusal := _refuse_board(probe, answers, speed)) is not None:
            yield refusal
            return
        wiring = infer_wiring(answers, self.eyes, config)
        yield from check_wiring(answers, self.eyes, config, wiring)
        heard = [answer for answer in answers if answer.encoder is not None]
        if not heard:
            yield Check(DELAY_CHECK, "fail", "no wheel turns", NOTHING_TURNS)
            return
        if not all(answer.is_right for answer in answers):
            for name in ("line end", DELAY_CHECK, TIMEOUT_CHECK):
                yield Check(name, "skip", "needs wheels that turn as commanded", "mend them first")
            return
        if wiring != config.wheels:
            self.changes["wheels"] = wiring.model_dump()
            self.assumed = self.eyes is None  # the wire alone can't tell it from another wiring
        yield from self._measure_board(probe, config, heard, speed)

    def _measure_board(
        self,
        probe: BoardProbe,
        config: RobotConfig,
        heard: Sequence[WheelAnswer],
        speed: float,
    ) -> Iterator[Check]:
        """Measure how a board answers whose wheels turn as commanded."""
        yield self._check_line_end(probe, config, heard[-1].letter, speed)
        encoders = {answer.encoder for answer in heard if answer.encoder is not None}
        response = StepResponse(probe, [answer.letter for answer in heard], encoders, speed)
        yield report_delays(response.measure_delays())
        timed, agreed = self._check_timeout(response, config)
        yield timed
        if abs(probe.rate / config.feedback_rate - 1.0) > RATE_TOLERANCE:
            self._note_firmware("feedback_rate", probe.rate)
        if probe.gaps:
            yield report_resets(probe.gaps)
        stale = find_stale(probe.lines, speed)
        if stale is not None:
            yield Check(
                "stale feedback",
                "fail",
                f"the board repeats old lines: after some that were the same a wheel's speed "
                f"jumped by {stale[0]:.2f} rad/s from one line to the next, where it usually "
                f"changes by {stale[1]:.2f} at most",
                f"measure anew for each line {IN_PROGRAM}, or send none",
            )
        self.finished = agreed and not probe.gaps and stale is None

    def save(self, config: RobotConfig, path: Path, *, force: bool = False) -> Check:
        """Write a robot with what was found; `force` replaces a file that isn't a robot's."""
        try:
            robot = config.with_(**self.changes)
        except ConfigError as error:
            return Check("robot file", "fail", f"not written: {error}", "change that field first")
        try:
            remarks = {"wheels": ASSUMPTION_REMARK} if self.assumed else {}
            robot.save(path, remarks, outdated=(ASSUMPTION_REMARK,), force=force)
        except ConfigError as error:
            return Check("robot file", "fail", str(error), "give another file with --out")
        names = [name for name in self.changes if name != "firmware"]
        names += [f"firmware.{name}" for name in self.changes.get("firmware", ())]
        differing = ", ".join(names) or "nothing differs"
        if self.assumed:
            return Check(
                "robot file",
                "warn",
                f"{path}: {differing}; which wheel is left or right is an assumption, or which way "
                "it turns",
                f"watch one wheel with --spin --saw ...; then use --robot {path}",
            )
        return Check("robot file", "ok", f"{path}: {differing}", f"use --robot {path}")

    def _spin_each(self, probe: BoardProbe, config: RobotConfig, speed: float) -> list[WheelAnswer]:
        """Turn one wheel after the other, and ask what was seen.

        Lines have a trailing comma, unless no wheel at all turns with it, or not the last one.
        """
        for comma in (True, False):
            probe.trailing_comma = comma
            answers, said = [], []
            for letter in range(4):
                answers.append(spin_wheel(probe, letter, speed))
                if self.ask is not None:
                    said.append(_ask_seen(self.ask, letter, config))
                    probe.clear()
                if probe.gaps:
                    break
            if probe.gaps or any(answer.moving for answer in answers):
                break
        if probe.trailing_comma and not answers[-1].moving and len(answers) == len(MOTORS):
            probe.trailing_comma = False
            again = spin_wheel(probe, answers[-1].letter, speed)
            probe.trailing_comma = not again.moving
            answers[-1] = again if again.moving else answers[-1]
        if self.ask is not None:
            self.eyes = parse_all_seen(said)
        return answers

    def _check_line_end(
        self, probe: BoardProbe, config: RobotConfig, letter: int, speed: float
    ) -> Check:
        """Find whether the board takes a value at its comma or at the line's end."""
        wanted = probe.trailing_comma
        if takes_last_value(probe, letter, speed, comma=not wanted):
            return Check("line end", "ok", "a value is taken at the line's end, and at its comma")
        differs = wanted != config.trailing_comma
        if differs:
            self.changes["trailing_comma"] = wanted
        found = "the last value is taken without a trailing comma only"
        if wanted:
            found = "a value is taken at its comma: the last one needs a trailing comma"
        return warn_if(differs, "line end", found, f"use trailing_comma: {str(wanted).lower()}")

    def _check_timeout(self, response: StepResponse, config: RobotConfig) -> tuple[Check, bool]:
        """Say how soon the board stops by itself, and whether two measurements agree on it."""
        seen: list[float] = []
        while (timed := response.measure_timeout()) is not None:
            alike = [other for other in seen if abs(timed[0] - other) < SAME_TIMEOUT]
            if alike:
                timed = 0.5 * (timed[0] + alike[0]), timed[1]
                break
            seen.append(timed[0])
            if len(seen) == TIMEOUT_TRIALS:
                listed = ", ".join(f"{after:.2f}" for after in seen)
                said = f"another time at each trial: {listed} s"
                fix = "does the board repeat old lines, or is this computer busy? Try again"
                return Check(TIMEOUT_CHECK, "fail", said, fix), False
        configured = config.firmware.command_timeout or math.inf
        after = math.inf if timed is None else round(timed[0], 2)
        if after != configured and not abs(after - configured) <= TIMEOUT_TOLERANCE:
            self._note_firmware("command_timeout", None if timed is None else after)
        if timed is None:
            fix = "add a command time-out to the firmware"
            return Check(TIMEOUT_CHECK, "fail", "the wheels keep turning", fix), True
        stands = f"; the wheels stand after {timed[1]:.2f} s" if timed[1] else ""
        return Check(TIMEOUT_CHECK, "ok", f"{after:.2f} s after the last command{stands}"), True

    def _note_firmware(self, name: str, value: float | None) -> None:
        self.changes.setdefault("firmware", {})[name] = value


def report_resets(gaps: Sequence[float]) -> Check:
    """Say that the board was reset."""
    silent = ", ".join(f"{gap:.1f} s" for gap in gaps)
    return Check(
        "resets",
        "fail",
        f"the board was reset: silent for {silent}",
        "check its power supply, which motors may draw down, and its watchdog",
    )


def _report_notes(notes: Sequence[str]) -> Check:
    """Say what the board has said in lines of text."""
    return Check(
        "the board says",
        "fail" if any(note[1:].startswith(" cut:") for note in notes) else "warn",
        escape_unprintable("; ".join(notes)),
        "a wheel that turns against its motor: set ENCODER_REVERSED or MOTOR_REVERSED in the "
        "board's program; a stalled one: look what blocks it, and at its encoder's plug",
    )


def _refuse_board(probe: BoardProbe, answers: Sequence[WheelAnswer], speed: float) -> Check | None:
    """Name a board whose feedback can't be used, or that takes other commands; None for others."""
    if not any(answer.moving for answer in answers):
        if not takes_upper_case(probe, speed):
            return None
        return Check(
            "command letters",
            "fail",
            "the board takes upper-case letters only: AP03.00 turns a wheel, ap03.00 doesn't",
            f"take lower-case letters {IN_PROGRAM}, as the wire has them",
        )
    exact = all(abs(abs(each.ratio) - 1.0) < EXACT_RATIO for each in answers if each.moving)
    if not exact or not sends_set_points(probe, speed):
        return None
    return Check(
        "measured speeds",
        "fail",
        "feedback is what was commanded, at once and to the last digit: the board's set points, or "
        "an echo in its own words",
        f"send what the encoders measure {IN_PROGRAM}",
    )


def report_delays(delays: Sequence[float]) -> Check:
    """Say how long commands take to show."""
    if not delays:
        return Check(DELAY_CHECK, "fail", "not all wheels turn", NOTHING_TURNS)
    usual, latest = median(delays), delays[math.ceil(0.95 * len(delays)) - 1]
    early = RESPONSE_TRIALS - len(delays)
    left_out = f"; {early} of {RESPONSE_TRIALS} left out: wheels still crept" if early else ""
    return warn_if(
        usual > SLOW_RESPONSE,
        DELAY_CHECK,
        f"{1e3 * usual:.0f} ms from a command's last byte to the first that shows it, the median "
        f"of {len(delays)}; 95 % within {1e3 * latest:.0f} ms{left_out}",
        "raise the baud rate; set the USB adapter's latency timer to 1 ms",
    )


def _ask_seen(ask: AskWatcher, letter: int, config: RobotConfig) -> str:
    """Ask which wheel turned while a letter was commanded forward, until the answer makes sense."""
    wheel = next(k for k, one in enumerate(config.wheels.each) if one.motor == MOTORS[letter])
    usual = MOTORS[wheel] + ("n" if config.wheels.each[wheel].motor_sign == -1 else "")
    question = f"{MOTORS[letter]} was commanded forward: which wheel turned ({WHEEL_NAMES}; "
    question += "n behind it: backward; "
    for _ in range(MAX_QUESTIONS):
        said = ask(f"{question}none; Enter: {usual})? ").strip() or usual
        with contextlib.suppress(ConfigError):
            parse_seen(said, letter)
            return said
    raise ConfigError("no answer makes sense: start again, or add --yes")


# The wiring that answers show


def infer_wiring(
    answers: Sequence[WheelAnswer], eyes: Sequence[SeenWheel] | None, config: RobotConfig
) -> WheelsConfig:
    """Infer the wiring; wheels of which nothing is known keep their letters, or those left."""
    file = config.wheels.each
    file_motors = [(MOTORS.index(wheel.motor), wheel.motor_sign) for wheel in file]
    file_encoders = [(MOTORS.index(wheel.encoder), wheel.sign) for wheel in file]
    letters = [letter for letter, _ in file_motors]
    motors: dict[int, tuple[int, int]] = {}
    encoders: dict[int, tuple[int, int]] = {}
    for answer in answers:
        wheel = letters.index(answer.letter)
        saw = (wheel, file_motors[wheel][1]) if eyes is None else eyes[answer.letter]
        if saw is None:
            continue
        wheel, way = saw
        motors[wheel] = answer.letter, way
        if answer.encoder is not None and answer.encoder not in {e for e, _ in encoders.values()}:
            sign = answer.sign * way if answer.is_right else file[wheel].sign
            encoders[wheel] = answer.encoder, sign
    for parts, in_file in ((motors, file_motors), (encoders, file_encoders)):
        left = set(range(4)) - {letter for letter, _ in parts.values()}
        others = [wheel for wheel in range(4) if wheel not in parts]
        for wheel in sorted(others, key=lambda wheel: in_file[wheel][0] not in left):
            parts[wheel] = in_file[wheel] if in_file[wheel][0] in left else (min(left), 1)
            left.discard(parts[wheel][0])
    return WheelsConfig.model_validate(
        {
            letter: {
                "motor": MOTORS[motors[wheel][0]],
                "motor_sign": motors[wheel][1],
                "encoder": MOTORS[encoders[wheel][0]],
                "sign": encoders[wheel][1],
            }
            for wheel, letter in enumerate(MOTORS)
        }
    )


def check_wiring(
    answers: Sequence[WheelAnswer],
    eyes: Sequence[SeenWheel] | None,
    config: RobotConfig,
    found: WheelsConfig,
) -> Iterator[Check]:
    """Say what was found about each wheel, and about all of them."""
    for wheel in range(4):
        yield _check_wheel(wheel, answers, eyes, config, found.each[wheel])
    file = config.wheels
    if eyes is not None:
        yield _check_seen_sides(answers, eyes, file, same=found == file)
        return
    heard = [
        wheel
        for wheel in range(4)
        if answers[MOTORS.index(found.each[wheel].motor)].encoder is not None
    ]
    saw = "say what turned, such as --saw b a d c"
    if heard and all(found.each[w].encoder == file.each[OTHER_SIDE[w]].encoder for w in heard):
        yield Check(
            "wiring",
            "warn",
            "left and right are swapped, of the encoders or of the motors: that it is the encoders "
            "is an assumption, and the robot turns the wrong way where it isn't so",
            f"{WATCH_ADVICE}; where a turned front left, say --saw b a d c",
        )
    elif found != file:
        assumption = "that encoders are swapped or reversed, and not motors, is an assumption"
        yield Check("wiring", "warn", assumption, f"{WATCH_ADVICE}; otherwise {saw}")
    elif file != WheelsConfig():
        yield Check("wiring", "ok", AS_ROBOT_FILE)
    else:
        unseen = "only eyes see a motor and an encoder that are swapped or reversed together"
        yield Check("wiring", "ok", unseen, f"{WATCH_ADVICE}; otherwise {saw}")


def _unlike_file(file: WheelsConfig) -> str:
    """Say that a wiring differs from that in the robot's file, if it has one."""
    return "" if file == WheelsConfig() else ", unlike in the robot's file"


def _check_seen_sides(
    answers: Sequence[WheelAnswer], eyes: Sequence[SeenWheel], file: WheelsConfig, *, same: bool
) -> Check:
    """Say which sides are swapped where somebody looked, and whether the robot's file says so."""
    heard = [answer for answer in answers if answer.encoder is not None]
    crossed = bool(heard) and all(each.encoder == OTHER_SIDE[each.letter] for each in heard)
    saw = [(letter, each[0]) for letter, each in enumerate(eyes) if each is not None]
    mirrored = bool(saw) and all(wheel == OTHER_SIDE[letter] for letter, wheel in saw)
    swapped = [w for w, so in (("motors", mirrored), ("encoders", crossed != mirrored)) if so]
    said = f"left and right {' and '.join(swapped)} are swapped" if swapped else "as seen"
    if not same:
        fix = "what was seen counts: write it into a robot's file with --out FILE"
        return Check("wiring", "warn", said + _unlike_file(file), fix)
    return Check("wiring", "ok", said if file == WheelsConfig() else f"{said}, {AS_ROBOT_FILE}")


def _check_wheel(
    wheel: int,
    answers: Sequence[WheelAnswer],
    eyes: Sequence[SeenWheel] | None,
    config: RobotConfig,
    found: WheelConfig,
) -> Check:
    """Say what was found about one wheel."""
    name, file = WHEELS[wheel], config.wheels
    answer = answers[MOTORS.index(found.motor)]
    heard = MOTORS[answer.encoder] if answer.encoder is not None else None
    if heard is None:
        return _report_dead(wheel, answer.letter, eyes)
    if heard != found.encoder:
        text = f"encoder {heard} answers to motor {MOTORS[answer.letter]}, too"
        return Check(name, "fail", text, "check its wires")
    way = "forward" if found.sign == 1 else "backward"
    turns = f"motor {found.motor}" + (" reversed" if found.motor_sign == -1 else "")
    text = f"{turns}, encoder {heard} counts {way}, measured/commanded {abs(answer.ratio):.2f}"
    if len(answer.moving) > 1:
        others = ", ".join(MOTORS[k] for k in answer.moving[1:])
        return Check(name, "fail", f"{text}; encoder {others} turns with it", "check its wires")
    if not answer.is_right:
        text = f"{turns}, encoder {heard}: {_describe_speed(answer)}"
        return Check(name, "fail", text, _explain_speed(answer, answers, config))
    own = file.each[wheel]
    if found == own:
        return Check(name, "ok", text)
    usual = WheelConfig(motor=MOTORS[wheel], encoder=MOTORS[wheel]).model_dump()
    mapped = {key: value for key, value in found.model_dump().items() if value != usual[key]}
    inner = ", ".join(f"{key}: {value}" for key, value in mapped.items())
    return Check(
        name,
        "warn",
        f"{text}: {_describe_change(found, own, file, looked=eyes is not None)}",
        f"swap the wires, or use wheels: {{{MOTORS[wheel]}: {{{inner}}}}}",
    )


def _report_dead(wheel: int, letter: int, eyes: Sequence[SeenWheel] | None) -> Check:
    """Say that a wheel or its encoder is dead; only eyes can tell which."""
    name, found = WHEELS[wheel], f"dead: no encoder answers to motor {MOTORS[letter]}"
    if eyes is None:
        found += "; the wire can't tell whether the motor or the encoder is dead"
        fix = f"look whether {name} turns: if it does, check its encoder, otherwise its motor"
        return Check(name, "fail", found, fix)
    if any(saw is not None and saw[0] == wheel for saw in eyes):
        return Check(name, "fail", f"{found}: its encoder is dead", "check the encoder's plug")
    return Check(name, "fail", f"{found}: its motor is dead", "check the motor's plug and driver")


def _describe_change(
    found: WheelConfig, own: WheelConfig, file: WheelsConfig, *, looked: bool
) -> str:
    """Say how a wheel's wiring differs from that in the robot's file, or from its letter's."""
    parts = []
    if found.motor != own.motor:
        parts.append("its motor has another letter")
    if found.motor_sign != own.motor_sign:
        parts.append("its motor is reversed")
    if found.encoder != own.encoder:
        other = [one.encoder for one in file.each].index(found.encoder)
        parts.append(f"its encoder is swapped with that of {WHEELS[other]}")
    if found.sign != own.sign:
        unless = "" if looked else " (or its motor, if the wheel turned backward)"
        parts.append("its encoder is reversed" + unless)
    return " and ".join(parts) + _unlike_file(file)


def _describe_speed(answer: WheelAnswer) -> str:
    """Say what was measured of a wheel that isn't right."""
    if answer.stopped:
        way = "backward" if answer.sign == -1 else "forward"
        return f"turned {way}, and stood again although the command went on"
    measured = answer.ratio * answer.asked
    speeds = f"{measured:.2f} rad/s, {answer.asked:.2f} commanded"
    return f"measured/commanded {answer.ratio:.2f} ({speeds})"


def _explain_speed(answer: WheelAnswer, answers: Sequence[WheelAnswer], config: RobotConfig) -> str:
    """Say what to do about a wheel that isn't right: encoders in a loop, or units."""
    if answer.encoder != answer.letter:
        return SWAPPED_FIX
    ratio = abs(answer.ratio)
    alike = [
        other
        for other in answers
        if other.sign == 1 and math.isclose(other.ratio, ratio, rel_tol=RATIO_TOLERANCE)
    ]
    if answer.sign == -1 and not alike:  # no other wheel is as wrong and forward
        return REVERSED_FIX
    if answer.stopped:
        return "check the plugs of motor and encoder, and the motor's driver"
    fast = ratio * answer.asked > HIGHEST_SPEED
    return likely_units(ratio, config, fast=fast)
