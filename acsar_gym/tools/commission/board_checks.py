"""The checks of a board: a list of functions, each of which returns a row of the doctor's table."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from acsar_gym.config import RobotConfig, WheelConfig, WheelsConfig
from acsar_gym.errors import ConfigError, escape_unprintable
from acsar_gym.links.base import Link
from acsar_gym.links.handshake import echo_error, shown_bytes
from acsar_gym.protocol import (
    ECHO_PROBE,
    MOTORS,
    PRINTED_STEP,
    WHEELS,
    ZERO,
    Speeds,
    encode,
    encode_line,
)
from acsar_gym.recording.types import Floats
from acsar_gym.safety.layer import Safety
from acsar_gym.tools.commission.checks import Check, warn_if
from acsar_gym.tools.commission.wiring import (
    SeenWheel,
    WheelAnswer,
    describe_sides,
    infer_wiring,
    wheels_of_file,
    wire_wheel,
)
from acsar_gym.tools.sysid.board import (
    SPIN_SPEED,
    SPIN_TIME,
    STANDING_SHARE,
    STOP_TIME,
    BoardProbe,
    BoardTimes,
    likely_units,
    measure_board,
)

BOTH_ZEROS = encode(ZERO, trailing_comma=False) + encode_line(*ZERO, b"")
"""Zero without a trailing comma, then without its line end."""
ECHO_TIME = 0.5
"""Longest time that an echo takes [s]."""
SINGLE_COMMAND_TIME = 0.7
"""Time in which a single command has an effect [s]. Many boards stop by themselves soon."""
ODD_SHARES = (0.83, 0.97, 0.89, 0.79)
"""Shares of the speed that four wheels are commanded, unlike any feedback of encoders."""
SET_POINT_TIME = 0.6
"""Time for which they are commanded [s]."""
SLOW_RESPONSE = 0.1
"""A delay above this is worth a warning [s]."""
SAME_RATE = 0.05
"""A feedback rate is as configured within this share."""
SAME_TIMEOUT = 0.03
"""A time-out is as configured within this [s]."""

IN_PROGRAM = "in the board's program"
DELAY_CHECK = "command to feedback"
TIMEOUT_CHECK = "stops when commands stop"
WATCH_ADVICE = (
    "watch: a turns front right, b front left, c rear left, d rear right, forward; otherwise say "
    "what turned, such as --saw b a d c"
)
ASSUMPTION_REMARK = """\
An assumption: the wire can't tell swapped or reversed encoders from motors. Watch the wheels,
and say what turned: acsar-gym doctor DEVICE --spin --saw b a d c --out FILE"""
"""Remark above a wiring that no user saw."""


@dataclass
class BoardExamination:
    """What the checks of a board share.

    Attributes:
        config: Robot configuration, as in the robot's file.
        spin: Whether wheels may be turned.
        seen: Which wheel was seen to turn for each letter. None if no user looked.
        answers: How encoders answer to each letter, once wheels have been turned.
        wiring: Wiring that the answers show. None if they show none.
        times: Measured times of the board. None before they are measured.
        changes: Fields that differ from `config`.
        is_usable: False ends the checks.
    """

    config: RobotConfig
    spin: bool = False
    seen: dict[str, SeenWheel] | None = None
    answers: dict[str, WheelAnswer] = field(default_factory=dict)
    wiring: WheelsConfig | None = None
    times: BoardTimes | None = None
    changes: dict[str, Any] = field(default_factory=dict)
    is_usable: bool = True

    def run(self, link: Link) -> Iterator[Check]:
        """Yield a row for each check of the board behind an open link, until it proves unusable.

        Raises:
            LinkError: The board is lost or silent, or its wheels keep turning.
        """
        self.device = link.device
        self.probe = BoardProbe(link, self.config)

        # Wheels turn as fast as the limits of the robot's file allow, at most.
        four = (SPIN_SPEED, SPIN_SPEED, SPIN_SPEED, SPIN_SPEED)
        self.speed = min(Safety(self.config).bounded(four, (0.0, 0.0, 0.0), 0.0))
        self.turned = wheels_of_file(self.config.wheels) if self.seen is None else self.seen
        for check in LISTENING + (SPINNING if self.spin else ()):
            row = check(self)
            if row is not None:
                yield row
            if not self.is_usable:
                return
        if not self.spin:
            for name in ("wiring", DELAY_CHECK, TIMEOUT_CHECK):
                yield Check(name, "skip", "needs turning wheels", "lift the robot and add --spin")

    def drive(self, command: Speeds | bytes, duration: float, **options: float) -> Floats:
        """Command speeds as `BoardProbe.drive` does, and stop. Returns the lines' speeds."""
        speeds = self.probe.drive(command, duration, **options).speeds
        self.probe.stop_wheels(self.speed)
        return speeds

    def command(self, letters: str) -> Speeds:
        """Return the command that turns the wheels of some letters forward."""
        a, b, c, d = (self.speed * (letter in letters) for letter in MOTORS)
        return a, b, c, d

    def turns(self, speeds: Floats) -> bool:
        """Return whether a wheel turned."""
        return bool(np.abs(speeds).max(initial=0.0) > STANDING_SHARE * self.speed)

    def refuse(self, name: str, finding: str, fix: str) -> Check:
        """End the checks with a failure."""
        self.is_usable = False
        return Check(name, "fail", finding, fix)

    def save(self, path: Path, *, force: bool = False) -> Check:
        """Write the robot with the changes. `force` replaces a file that isn't a robot's."""
        name = "robot file"
        if not self.is_usable or self.times is None or math.isnan(self.times.command_timeout):
            finding = f"{path} isn't written: not all was found"
            return Check(name, "skip", finding, "fix what failed, and start again")

        # Without eyes, the wire can't tell which wheel a letter turns.
        is_assumed = self.seen is None and "wheels" in self.changes
        try:
            remarks = {"wheels": ASSUMPTION_REMARK} if is_assumed else {}
            robot = self.config.with_(**self.changes)
            robot.save(path, remarks, outdated=(ASSUMPTION_REMARK,), force=force)
        except ConfigError as error:
            return Check(name, "fail", f"not written: {error}", "change that first")

        fields = [field for field in self.changes if field != "firmware"]
        fields += [f"firmware.{field}" for field in self.changes.get("firmware", ())]
        finding = f"{path}: {', '.join(fields) or 'nothing differs'}"
        if is_assumed:
            finding += "; which wheel is left or right, or which way it turns, is an assumption"
        return Check(name, "warn" if is_assumed else "ok", finding, f"use --robot {path}")


def check_echo(board: BoardExamination) -> Check | None:
    """Find a board that sends commands back, also later than a link waits for when it opens."""
    # The probe is no command of the protocol, so that no board answers it by itself.
    board.probe.drive(ECHO_PROBE, ECHO_TIME)
    if ECHO_PROBE not in board.probe.tail:
        return None
    error = echo_error(board.device)
    return board.refuse("echo", error.found, error.fix)


def check_feedback_rate(board: BoardExamination) -> Check:
    """Count lines while zero is commanded."""
    board.probe.measure_rate(board.config.period)
    rate = board.probe.rate
    expected = board.config.feedback_rate
    return warn_if(
        rate < 0.9 * expected,
        "feedback rate",
        f"{rate:.1f} lines/s, {expected:g} expected",
        "set firmware.feedback_rate to what the board sends, or speed the board up",
    )


def check_line_format(board: BoardExamination) -> Check:
    """Show the newest complete line."""
    # The last line may be incomplete.
    line = board.probe.tail.rpartition(b"\n")[0].rpartition(b"\n")[2].strip()
    return Check("line format", "ok", shown_bytes(line))


def check_line_quality(board: BoardExamination) -> Check:
    """Count damaged parts of lines."""
    decoder = board.probe.decoder
    refused = sum(decoder.refused.values())
    sample = f", such as in {shown_bytes(decoder.sample)}" if refused else ""
    return warn_if(
        refused > 0,
        "line quality",
        f"{refused} bad parts in {decoder.lines} lines{sample}",
        "check the cable, ground and baud rate",
    )


def check_resets(board: BoardExamination) -> Check | None:
    """Find a board that was reset."""
    if not board.probe.gaps:
        return None
    silences = ", ".join(f"{gap:.1f} s" for gap in board.probe.gaps)
    fix = "check its power supply, which motors may draw down, and its watchdog"
    return board.refuse("resets", f"the board was reset: silent for {silences}", fix)


def check_line_end(board: BoardExamination) -> Check | None:
    """Find whether the last value of a line is taken with, or without, a trailing comma.

    The value is that of wheel d. Nothing is found if it doesn't turn.
    """
    board.probe.stop_wheels(board.speed)
    # Boards that parse up to a comma lose the last value without it. Others refuse an empty value.
    with_comma = takes_last_value(board, comma=True)
    without_comma = takes_last_value(board, comma=False)
    board.probe.trailing_comma = with_comma or not without_comma
    if with_comma == without_comma:
        finding = "a value is taken at the line's end, and at its comma"
        return Check("line end", "ok", finding) if with_comma else None

    # A board that takes both forms needs no change.
    differs = with_comma != board.config.trailing_comma
    if differs:
        board.changes["trailing_comma"] = with_comma
    finding = "the last value is taken without a trailing comma only"
    if with_comma:
        finding = "a value is taken at its comma: the last one needs a trailing comma"
    return warn_if(differs, "line end", finding, f"use trailing_comma: {str(with_comma).lower()}")


def takes_last_value(board: BoardExamination, *, comma: bool) -> bool:
    """Return whether wheel d turns, whose value ends each line.

    The board gets only one line: some boards take a value at the first comma of the next line.
    """
    board.probe.trailing_comma = comma
    command = board.command("d")
    lines = board.probe.drive(command, SINGLE_COMMAND_TIME, interval=math.inf)

    # Either form of zero alone may miss the value of one wheel.
    board.probe.trailing_comma = True
    board.drive(BOTH_ZEROS, STOP_TIME, interval=STOP_TIME / 2.0)
    return board.turns(lines.speeds)


def spin_wheels(board: BoardExamination) -> Check | None:
    """Turn one wheel after the other, and report what the board says to that in text."""
    # A person watches which wheel turns, so that they turn one at a time.
    for letter in MOTORS:
        lines = board.probe.drive(board.command(letter), SPIN_TIME)
        board.probe.stop_wheels(board.speed)
        board.answers[letter] = WheelAnswer.of(lines, board.speed)
        if board.probe.gaps:
            return check_resets(board)

    # Which encoder answered to which letter, and which wheel that letter turned.
    board.wiring = infer_wiring(board.answers, board.turned)

    notes = board.probe.decoder.notes
    if not notes:
        return None

    # The text of our own firmware names a wheel whose motor it has switched off.
    is_cut = any(note[1:].startswith(" cut:") for note in notes)
    return Check(
        "the board says",
        "fail" if is_cut else "warn",
        escape_unprintable("; ".join(notes)),
        f"a wheel that turns against its motor: set ENCODER_REVERSED or MOTOR_REVERSED "
        f"{IN_PROGRAM}; a stalled wheel: look what blocks it, and at its encoder's plug",
    )


def check_command_letters(board: BoardExamination) -> Check | None:
    """Find a board that takes upper-case letters only."""
    if any(answer.encoders for answer in board.answers.values()):
        return None

    # No encoder answered: try the other case before calling all wheels dead.
    board.probe.upper_case = True
    if not board.turns(board.drive(board.command(MOTORS), SPIN_TIME)):
        return None
    return board.refuse(
        "command letters",
        "the board takes upper-case letters only: AP03.00 turns a wheel, ap03.00 doesn't",
        f"take lower-case letters {IN_PROGRAM}, as the wire has them",
    )


def check_set_points(board: BoardExamination) -> Check | None:
    """Find a board whose feedback is the command itself, at once and to the last digit."""
    # Odd numbers with two decimals, as no encoder's steps are.
    a, b, c, d = (round(share * board.speed, 2) for share in ODD_SHARES)
    command = (a, b, c, d)
    speeds = board.drive(command, SET_POINT_TIME)

    # Encoders never follow four odd speeds to the last digit.
    turning = speeds[np.abs(speeds).max(axis=1) > STANDING_SHARE * board.speed]
    if not len(turning) or np.abs(turning - command).max() > 1.5 * PRINTED_STEP:
        return None
    return board.refuse(
        "measured speeds",
        "feedback is what was commanded, at once and to the last digit: the board's set points, or "
        "an echo in its own words",
        f"send what the encoders measure {IN_PROGRAM}",
    )


def check_wheel(index: int, board: BoardExamination) -> Check:
    """Report how one wheel is wired, and whether it turns as commanded."""
    name = WHEELS[index]

    # The letter that turns this wheel, as seen or as the robot's file says.
    letter = next((x for x, turned in board.turned.items() if turned.wheel == MOTORS[index]), "")
    answer = board.answers.get(letter)
    if answer is None or not answer.encoders:
        finding = f"dead: no encoder answers to motor {letter or '(none turned it)'}"
        if board.seen is None:
            finding += "; the wire can't tell whether the motor or the encoder is dead"
            fix = f"look whether {name} turns: if it does, check its encoder, otherwise its motor"
            return Check(name, "fail", finding, fix)
        dead = "encoder" if letter else "motor"
        return Check(name, "fail", f"{finding}: its {dead} is dead", f"check the {dead}'s plug")

    wheel = wire_wheel(letter, board.turned[letter], answer)
    motor = f"motor {letter}" + (" reversed" if wheel.motor_sign == -1 else "")
    encoder = f"encoder {wheel.encoder} counts {'forward' if wheel.sign == 1 else 'backward'}"
    finding = f"{motor}, {encoder}, measured/commanded {answer.ratio:.2f}"
    if not answer.is_right:
        finding += ", and stopped although the command went on" if answer.has_stopped else ""
        return Check(name, "fail", finding, explain_speed(letter, answer, board.config))

    # Wires that touch make encoders turn together.
    faults = [f"encoder {encoder} turns with it" for encoder in answer.encoders[1:]] + [
        f"encoder {wheel.encoder} answers to motor {motor}, too"
        for motor, answered in board.answers.items()
        if motor != letter and answered.encoders[:1] == wheel.encoder
    ]
    if faults:
        return Check(name, "fail", f"{finding}; {', '.join(faults)}", "check its wires")
    if wheel == board.config.wheels.each[index]:
        return Check(name, "ok", finding)

    usual = WheelConfig(motor=MOTORS[index], encoder=MOTORS[index]).model_dump()
    fields = wheel.model_dump().items()
    changed = ", ".join(f"{key}: {value}" for key, value in fields if value != usual[key])
    fix = f"swap the wires, or use wheels: {{{MOTORS[index]}: {{{changed}}}}}"
    return Check(name, "warn", f"{finding}, unlike in the robot's file", fix)


def explain_speed(letter: str, answer: WheelAnswer, config: RobotConfig) -> str:
    """Advise on a wheel that doesn't turn as commanded.

    A board with a speed loop drives its wheel away from the command if the loop meets the wrong
    sign, or the encoder of another wheel. No robot's file can help.
    """
    if answer.encoders[0] != letter:
        return f"swap the wires, or the encoder's pins {IN_PROGRAM}"
    if answer.ratio < 0.0:
        return f"set ENCODER_REVERSED {IN_PROGRAM} (MOTOR_REVERSED, if the wheel turned backward)"
    if answer.has_stopped:
        return "check the plugs of motor and encoder, and the motor's driver"
    return likely_units(answer.ratio, config)


def check_wiring(board: BoardExamination) -> Check | None:
    """Compare the wiring with the robot's file. Only users can see motors and encoders apart."""
    if board.wiring is None:
        return None
    # The file's wiring is the reference, and ours if there is no file.
    is_usual = board.config.wheels == WheelsConfig()
    unseen = "as the encoders answer" if board.seen is None else "as seen"
    finding = describe_sides(board.wiring) or unseen
    if board.wiring == board.config.wheels:
        if board.seen is None and is_usual:
            finding = "only eyes see a motor and an encoder that are swapped or reversed together"
            return Check("wiring", "ok", finding, WATCH_ADVICE)
        return Check(
            "wiring", "ok", finding if is_usual else f"{finding}, as the robot's file says"
        )

    finding += "" if is_usual else ", unlike in the robot's file"
    if board.seen is not None:
        fix = "what was seen counts: write it into a robot's file with --out FILE"
        return Check("wiring", "warn", finding, fix)
    finding += "; that encoders are swapped or reversed, and not motors, is an assumption"
    return Check("wiring", "warn", finding, WATCH_ADVICE)


def check_delay(board: BoardExamination) -> Check:
    """Measure the board's times, and report how long a command takes to show."""
    # Times are measured with all wheels, which must turn as commanded.
    is_right = all(answer.is_right for answer in board.answers.values())
    if board.wiring is None or not is_right:
        return Check(DELAY_CHECK, "skip", "needs wheels that turn as commanded", "fix them first")
    if board.wiring != board.config.wheels:
        board.changes["wheels"] = board.wiring.model_dump()
    board.times = measure_board(board.probe, board.speed)
    delays = board.times.delays
    return warn_if(
        not board.times.delay < SLOW_RESPONSE,
        DELAY_CHECK,
        f"{1e3 * board.times.delay:.0f} ms from a command's last byte to the first that shows it, "
        f"the median of {len(delays)}, {1e3 * max(delays, default=math.nan):.0f} ms at most",
        "raise the baud rate; set the USB adapter's latency timer to 1 ms",
    )


def check_timeout(board: BoardExamination) -> Check:
    """Report how soon the board stops by itself."""
    times = board.times
    if times is None:
        return Check(TIMEOUT_CHECK, "skip", "needs wheels that turn as commanded", "fix them first")
    if math.isnan(times.command_timeout):
        fix = "does the board repeat old lines, or is this computer busy? Try again"
        return Check(TIMEOUT_CHECK, "fail", "another time at each trial", fix)

    # Fields that are as configured stay as they are in the file.
    firmware: dict[str, float | None] = {}
    if not math.isclose(board.config.feedback_rate, times.feedback_rate, rel_tol=SAME_RATE):
        firmware["feedback_rate"] = times.feedback_rate
    configured = board.config.firmware.command_timeout or math.inf
    if not math.isclose(configured, times.command_timeout, abs_tol=SAME_TIMEOUT):
        never = math.isinf(times.command_timeout)
        firmware["command_timeout"] = None if never else round(times.command_timeout, 2)
    if firmware:
        board.changes["firmware"] = firmware

    if math.isinf(times.command_timeout):
        fix = "add a command time-out to the firmware"
        return Check(TIMEOUT_CHECK, "fail", "the wheels keep turning", fix)
    return Check(TIMEOUT_CHECK, "ok", f"{times.command_timeout:.2f} s after the last command")


BoardCheck = Callable[[BoardExamination], Check | None]
LISTENING: tuple[BoardCheck, ...] = (
    check_echo,
    check_feedback_rate,
    check_line_format,
    check_line_quality,
    check_resets,
)
"""Checks that only command zero."""
SPINNING: tuple[BoardCheck, ...] = (
    check_line_end,
    spin_wheels,
    check_command_letters,
    check_set_points,
    *(partial(check_wheel, index) for index in range(4)),
    check_wiring,
    check_delay,
    check_timeout,
    check_resets,
)
"""Checks that turn wheels."""
