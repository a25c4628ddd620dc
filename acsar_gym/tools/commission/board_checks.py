"""The checks of a board: each yields a row of the doctor's table."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import chain
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
    EFFECT_TIME,
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
TURNING_SPEED = 0.5
"""Wheels that report more than this while zero is commanded seem to turn [rad/s]."""
SLOW_RESPONSE = 0.1
"""A delay above this is worth a warning [s]."""
SAME_RATE = 0.05
"""A feedback rate is as configured within this share."""
SAME_TIMEOUT = 0.03
"""A time-out is as configured within this [s]."""

FATAL = ("echo", "resets", "command letters", "measured speeds")
"""Rows that appear only if a board can't be used, and that end the checks."""
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
    """The checks of a board, and what they found.

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
        self.probe = BoardProbe(link, self.config)

        # Wheels turn as fast as the limits of the robot's file allow, at most.
        four = (SPIN_SPEED, SPIN_SPEED, SPIN_SPEED, SPIN_SPEED)
        self.speed = min(Safety(self.config).bounded(four, (0.0, 0.0, 0.0), 0.0))
        self.turned = wheels_of_file(self.config.wheels) if self.seen is None else self.seen

        rows = [self._listen(link.device)]
        if self.spin:
            rows += [self._spin(), self._check_line_end(), self._check_answers()]
            rows += [self._check_wheels(), self._measure_times(), self._check_resets()]
        for row in chain.from_iterable(rows):
            yield row
            if row.name in FATAL:
                self.is_usable = False
                return
        if not self.spin:
            for name in ("wiring", DELAY_CHECK, TIMEOUT_CHECK):
                yield Check(name, "skip", "needs turning wheels", "lift the robot and add --spin")

    def _listen(self, device: str) -> Iterator[Check]:
        """Check what a board sends while zero is commanded."""
        # The probe is no command of the protocol, so that no board answers it by itself. An echo
        # may come later than a link waits for it when it opens.
        probe = self.probe
        probe.drive(ECHO_PROBE, ECHO_TIME)
        if ECHO_PROBE in probe.tail:
            error = echo_error(device)
            yield Check("echo", "fail", error.found, error.fix)

        lines = probe.measure_rate(self.config.period)
        expected = self.config.feedback_rate
        yield warn_if(
            probe.rate < 0.9 * expected,
            "feedback rate",
            f"{probe.rate:.1f} lines/s, {expected:g} expected",
            "set firmware.feedback_rate to what the board sends, or speed the board up",
        )

        # The newest complete line, as the last line may be incomplete.
        line = probe.tail.rpartition(b"\n")[0].rpartition(b"\n")[2].strip()
        yield Check("line format", "ok", shown_bytes(line))

        decoder = probe.decoder
        refused = sum(decoder.refused.values())
        sample = f", such as in {shown_bytes(decoder.sample)}" if refused else ""
        yield warn_if(
            refused > 0,
            "line quality",
            f"{refused} bad parts in {decoder.lines} lines{sample}",
            "check the cable, ground and baud rate",
        )

        # The median, as a noisy encoder of a wheel at rest counts in both directions.
        turning = np.abs(np.median(lines.speeds, axis=0)) > TURNING_SPEED
        if turning.any():
            letters = ", ".join(MOTORS[place] for place in np.flatnonzero(turning))
            yield Check(
                "standing",
                "warn",
                f"{letters}: feedback isn't zero while zero is commanded",
                "a wheel at rest: check its encoder; a turning wheel: what else commands the board",
            )
        yield from self._check_resets()

    def _check_resets(self) -> Iterator[Check]:
        """Find a board that was reset."""
        if self.probe.gaps:
            silences = ", ".join(f"{gap:.1f} s" for gap in self.probe.gaps)
            fix = "check its power supply, which motors may draw down, and its watchdog"
            yield Check("resets", "fail", f"the board was reset: silent for {silences}", fix)

    def _drive(self, command: Speeds | bytes, duration: float, **options: float) -> Floats:
        """Command speeds as `BoardProbe.drive` does, and stop. Returns the lines' speeds."""
        speeds = self.probe.drive(command, duration, **options).speeds
        self.probe.stop_wheels(self.speed)
        return speeds

    def _command(self, letters: str) -> Speeds:
        """Return the command that turns the wheels of some letters forward."""
        a, b, c, d = (self.speed * (letter in letters) for letter in MOTORS)
        return a, b, c, d

    def _turning(self, speeds: Floats) -> Floats:
        """Return the lines of a turning wheel."""
        return np.asarray(speeds[np.abs(speeds).max(axis=1) > STANDING_SHARE * self.speed])

    def _check_line_end(self) -> Iterator[Check]:
        """Find whether the last value of a line is taken with, or without, a trailing comma.

        The value is that of wheel d. Nothing is found if it doesn't turn.
        """
        self.probe.stop_wheels(self.speed)
        # Boards that parse up to a comma lose the last value without it. Others refuse an empty
        # value.
        with_comma = self._takes_last_value(comma=True)
        without_comma = self._takes_last_value(comma=False)
        self.probe.trailing_comma = with_comma or not without_comma
        if with_comma and without_comma:
            finding = "a value is taken at the line's end, and at its comma"
            yield Check("line end", "ok", finding)
        if with_comma == without_comma:
            return

        # A board that takes both forms needs no change.
        differs = with_comma != self.config.trailing_comma
        if differs:
            self.changes["trailing_comma"] = with_comma
        finding = "the last value is taken without a trailing comma only"
        if with_comma:
            finding = "a value is taken at its comma: the last one needs a trailing comma"
        fix = f"use trailing_comma: {str(with_comma).lower()}"
        yield warn_if(differs, "line end", finding, fix)

    def _takes_last_value(self, *, comma: bool) -> bool:
        """Return whether wheel d turns, whose value ends each line.

        The board gets only one line: some boards take a value at the first comma of the next line.
        """
        self.probe.trailing_comma = comma
        lines = self.probe.drive(self._command("d"), SINGLE_COMMAND_TIME, interval=math.inf)

        # Either form of zero alone may miss the value of one wheel.
        self.probe.trailing_comma = True
        self._drive(BOTH_ZEROS, STOP_TIME, interval=STOP_TIME / 2.0)
        return len(self._turning(lines.speeds)) > 0

    def _spin(self) -> Iterator[Check]:
        """Turn one wheel after the other, before any other check turns one.

        A person notes which wheel turns first, second, third and fourth.
        """
        self.probe.stop_wheels(self.speed)
        letters = MOTORS
        for comma in (True, False):
            self.probe.trailing_comma = comma
            for letter in letters:
                lines = self.probe.drive(self._command(letter), SPIN_TIME)
                self.probe.stop_wheels(self.speed)
                self.answers[letter] = WheelAnswer.of(lines, self.speed)
                yield from self._check_resets()

            # Some boards take no line with a trailing comma, others not its last value.
            if self.answers["d"].encoder:
                return
            if any(answer.encoder for answer in self.answers.values()):
                letters = "d"

    def _check_answers(self) -> Iterator[Check]:
        """Report what can't be a wheel's answer."""
        # The text of our own firmware names a wheel whose motor it has switched off.
        if notes := self.probe.decoder.notes:
            is_cut = any(note[1:].startswith(" cut:") for note in notes)
            yield Check(
                "the board says",
                "fail" if is_cut else "warn",
                escape_unprintable("; ".join(notes)),
                f"a wheel that turns against its motor: set ENCODER_REVERSED or MOTOR_REVERSED "
                f"{IN_PROGRAM}; a stalled wheel: look what blocks it, and at its encoder's plug",
            )

        # No encoder answered: try the other case before calling all wheels dead.
        if not any(answer.encoder for answer in self.answers.values()):
            self.probe.upper_case = True
            if len(self._turning(self._drive(self._command(MOTORS), SPIN_TIME))):
                yield Check(
                    "command letters",
                    "fail",
                    "the board takes upper-case letters only: AP03.00 turns a wheel, ap03.00 "
                    "doesn't",
                    f"take lower-case letters {IN_PROGRAM}, as the wire has them",
                )

        # Encoders never follow four odd speeds with two decimals at once, to the last digit.
        a, b, c, d = (round(share * self.speed, 2) for share in ODD_SHARES)
        turning = self._turning(self._drive((a, b, c, d), SET_POINT_TIME))
        if len(turning) and np.abs(turning - (a, b, c, d)).max() <= 1.5 * PRINTED_STEP:
            yield Check(
                "measured speeds",
                "fail",
                "feedback is what was commanded, at once and to the last digit: the board's set "
                "points, or an echo in its own words",
                f"send what the encoders measure {IN_PROGRAM}",
            )

    def _check_wheels(self) -> Iterator[Check]:
        """Report how each wheel is wired, whether it turns as commanded, and the wiring."""
        for letter, name, configured in zip(MOTORS, WHEELS, self.config.wheels.each, strict=True):
            yield self._check_wheel(letter, name, configured)

        # Only users can see motors and encoders apart.
        self.wiring = infer_wiring(self.answers, self.turned)
        if self.wiring is not None:
            yield self._check_wiring(self.wiring)

    def _check_wheel(self, wheel: str, name: str, configured: WheelConfig) -> Check:
        # The letter that turns this wheel, as seen or as the robot's file says.
        motor = next((letter for letter, turn in self.turned.items() if turn.wheel == wheel), "")
        answer = self.answers.get(motor)
        if answer is None or not answer.encoder:
            finding = f"dead: no encoder answers to motor {motor or '(none turned it)'}"
            if self.seen is None:
                finding += "; the wire can't tell whether the motor or the encoder is dead"
                fix = f"look whether {name} turns: if it does, check its encoder, otherwise its "
                return Check(name, "fail", finding, f"{fix}motor")
            dead = "encoder" if motor else "motor"
            return Check(name, "fail", f"{finding}: its {dead} is dead", f"check the {dead}'s plug")

        wiring = wire_wheel(motor, self.turned[motor], answer)
        reversed_motor = " reversed" if wiring.motor_sign == -1 else ""
        counts = "forward" if wiring.sign == 1 else "backward"
        finding = (
            f"motor {motor}{reversed_motor}, encoder {wiring.encoder} counts {counts}, "
            f"measured/commanded {answer.ratio:.2f}"
        )
        if not answer.is_right:
            finding += ", and stopped although the command went on" if answer.has_stopped else ""
            return Check(name, "fail", finding, explain_speed(motor, answer, self.config))

        # Wires that touch make encoders turn together.
        faults = [f"encoder {encoder} turns with it" for encoder in answer.encoders[1:]] + [
            f"encoder {wiring.encoder} answers to motor {letter}, too"
            for letter, answered in self.answers.items()
            if letter != motor and answered.encoder == wiring.encoder
        ]
        if faults:
            return Check(name, "fail", f"{finding}; {', '.join(faults)}", "check its wires")
        if wiring == configured:
            return Check(name, "ok", finding)

        usual = WheelConfig(motor=wheel, encoder=wheel).model_dump()
        fields = wiring.model_dump().items()
        changed = ", ".join(f"{key}: {value}" for key, value in fields if value != usual[key])
        fix = f"swap the wires, or use wheels: {{{wheel}: {{{changed}}}}}"
        return Check(name, "warn", f"{finding}, unlike in the robot's file", fix)

    def _check_wiring(self, wiring: WheelsConfig) -> Check:
        """Compare the wiring with that of the robot's file, or with ours if there is no file."""
        is_usual = self.config.wheels == WheelsConfig()
        is_seen = self.seen is not None
        finding = describe_sides(wiring) or ("as seen" if is_seen else "as the encoders answer")
        if wiring == self.config.wheels:
            if is_usual and not is_seen:
                finding = "only eyes see a motor and an encoder that are swapped or reversed "
                return Check("wiring", "ok", f"{finding}together", WATCH_ADVICE)
            finding += "" if is_usual else ", as the robot's file says"
            return Check("wiring", "ok", finding)

        finding += "" if is_usual else ", unlike in the robot's file"
        if is_seen:
            fix = "what was seen counts: write it into a robot's file with --out FILE"
            return Check("wiring", "warn", finding, fix)
        finding += "; that encoders are swapped or reversed, and not motors, is an assumption"
        return Check("wiring", "warn", finding, WATCH_ADVICE)

    def _measure_times(self) -> Iterator[Check]:
        """Report how long a command takes to show, and how soon the board stops by itself."""
        # Times are measured with all wheels, which must turn as commanded.
        is_right = all(answer.is_right for answer in self.answers.values())
        if self.wiring is None or not is_right:
            for name in (DELAY_CHECK, TIMEOUT_CHECK):
                yield Check(name, "skip", "needs wheels that turn as commanded", "fix them first")
            return
        if self.wiring != self.config.wheels:
            self.changes["wheels"] = self.wiring.model_dump()

        times = measure_board(self.probe, self.speed)
        self.times = times
        if times.delays:
            yield warn_if(
                times.delay > SLOW_RESPONSE,
                DELAY_CHECK,
                f"{1e3 * times.delay:.0f} ms from a command's last byte to the first that shows "
                f"it, the median of {len(times.delays)}, {1e3 * max(times.delays):.0f} ms at most",
                "raise the baud rate; set the USB adapter's latency timer to 1 ms",
            )
        else:
            finding = f"a command had no effect within {EFFECT_TIME:g} s"
            yield Check(DELAY_CHECK, "fail", finding, "check the motors' power and every encoder")
        yield self._check_timeout(times)

    def _check_timeout(self, times: BoardTimes) -> Check:
        """Report how soon the board stops by itself, and note what differs from the file."""
        timeout = times.command_timeout
        if math.isnan(timeout):
            fix = "does the board repeat old lines, or is this computer busy? Try again"
            return Check(TIMEOUT_CHECK, "fail", "another time at each trial", fix)

        # Fields that are as configured stay as they are in the file.
        never = math.isinf(timeout)
        firmware: dict[str, float | None] = {}
        if not math.isclose(self.config.feedback_rate, times.feedback_rate, rel_tol=SAME_RATE):
            firmware["feedback_rate"] = times.feedback_rate
        configured = self.config.firmware.command_timeout or math.inf
        if not math.isclose(configured, timeout, abs_tol=SAME_TIMEOUT):
            firmware["command_timeout"] = None if never else round(timeout, 2)
        if firmware:
            self.changes["firmware"] = firmware
        if never:
            fix = "add a command time-out to the firmware"
            return Check(TIMEOUT_CHECK, "fail", "the wheels keep turning", fix)
        finding = f"{timeout:.2f} s after the last command"
        if math.isfinite(times.standstill):
            finding += f"; the wheels are at rest after {times.standstill:.2f} s"
        return Check(TIMEOUT_CHECK, "ok", finding)

    def save(self, path: Path) -> Check:
        """Write the robot with the changes."""
        name = "robot file"
        if not self.is_usable or self.times is None or math.isnan(self.times.command_timeout):
            finding = f"{path} isn't written: not all was found"
            return Check(name, "skip", finding, "fix what failed, and start again")

        # Without eyes, the wire can't tell which wheel a letter turns.
        is_assumed = self.seen is None and "wheels" in self.changes
        remarks = {"wheels": ASSUMPTION_REMARK} if is_assumed else {}
        try:
            robot = self.config.with_(**self.changes)
            robot.save(path, remarks, outdated=(ASSUMPTION_REMARK,))
        except ConfigError as error:
            return Check(name, "fail", f"not written: {error}", "change that first")

        fields = [field for field in self.changes if field != "firmware"]
        fields += [f"firmware.{field}" for field in self.changes.get("firmware", ())]
        finding = f"{path}: {', '.join(fields) or 'nothing differs'}"
        if is_assumed:
            finding += "; which wheel is left or right, or which way it turns, is an assumption"
        return Check(name, "warn" if is_assumed else "ok", finding, f"use --robot {path}")


def explain_speed(letter: str, answer: WheelAnswer, config: RobotConfig) -> str:
    """Advise on a wheel that doesn't turn as commanded.

    A board with a speed loop drives its wheel away from the command if the loop meets the wrong
    sign, or the encoder of another wheel. No robot's file can help.
    """
    if answer.encoder != letter:
        return f"swap the wires, or the encoder's pins {IN_PROGRAM}"
    if answer.ratio < 0.0:
        return f"set ENCODER_REVERSED {IN_PROGRAM} (MOTOR_REVERSED, if the wheel turned backward)"
    if answer.has_stopped:
        return "check the plugs of motor and encoder, and the motor's driver"
    return likely_units(answer.ratio, config)
