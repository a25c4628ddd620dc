"""The job `identify`: logs in; findings, a validated fit, a table and a robot's file out."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from acsar_gym.config import Measured, RobotConfig, update_measured
from acsar_gym.errors import ConfigError, IdentificationError
from acsar_gym.links import Link
from acsar_gym.protocol import MOTORS, WHEELS
from acsar_gym.recording import Recorder
from acsar_gym.recording.reader import read
from acsar_gym.recording.replay import check_same_robot
from acsar_gym.recording.types import WireLog
from acsar_gym.tools.sysid import identifiability, parameter_findings
from acsar_gym.tools.sysid.excitation import drive_excitation
from acsar_gym.tools.sysid.fit import MotorFit, configured_times, configured_wheel, fit_motors
from acsar_gym.tools.sysid.identifiability import NEVER_TURNED, check_identifiability
from acsar_gym.tools.sysid.parameter_findings import NO_RAMP, ParameterFinding
from acsar_gym.tools.sysid.response import BoardTimes, WheelModel
from acsar_gym.tools.sysid.tracks import decode_track

IDENTIFY_METHOD = "identify"
COUNTS_FIELD = "counts_per_revolution"
SAME_RATE = 0.05
"""A feedback rate is as configured within this share."""
POOR_FIT_SHARE = 0.3
"""A fit with a larger error than this share of the wheel speeds isn't written."""
WRITTEN_DIGITS = 4
"""Significant digits of written numbers."""
COUNT_SHARE = 0.1
"""Where counts must be made up, one count is this share of the printed step."""


@dataclass(frozen=True)
class HeldOutErrors:
    """Error of the wheel speeds on the part of the log that the fit didn't see, RMS [rad/s]."""

    before: float
    after: float
    share: float
    """Of the log that was held out."""
    signal: float
    """The wheel speeds themselves on that part, RMS [rad/s]."""

    @property
    def poor(self) -> bool:
        """Whether the fit explains too little of the wheel speeds to be used."""
        return self.after > POOR_FIT_SHARE * self.signal


@dataclass(frozen=True, eq=False)
class Identification:
    """What an identification found.

    Attributes:
        config: of the robot, as it was.
        findings: for each parameter, or why the log can't tell it.
        held_out: the validation; None where nothing was fitted.
        delays: quantiles of delays of single steps, on top of the fitted one [s].
        duration: of the logs [s].
        logs: hashes of the logs.
    """

    config: RobotConfig
    findings: tuple[ParameterFinding, ...]
    held_out: HeldOutErrors | None
    delays: tuple[float, ...]
    duration: float
    logs: tuple[str, ...] = ()

    @property
    def told(self) -> bool:
        """Whether something new was found; a feedback rate as configured is nothing new."""
        return any(
            one.told
            and (one.name != parameter_findings.RATE_NAME or not _alike(one.value, one.before))
            for one in self.findings
        )

    @property
    def dead(self) -> tuple[str, ...]:
        """Names of the wheels that never turned."""
        never = {one.wheel for one in self.findings if one.note == NEVER_TURNED}
        return tuple(WHEELS[MOTORS.index(letter)] for letter in sorted(never))

    def check(self) -> None:
        """Check that this is worth a robot's file; IdentificationError says why it isn't."""
        dead = f" ({', '.join(self.dead)} never turned)" if self.dead else ""
        if not self.told:
            raise IdentificationError(
                f"nothing to write: nothing new was found{dead}; the table says what is missing"
            )
        if self.held_out is not None and self.held_out.poor:
            raise IdentificationError(
                f"nothing to write: the fit misses {self.held_out.after:.2f} of "
                f"{self.held_out.signal:.2f} rad/s (RMS) on what it didn't see: check that the "
                "wheels turn freely, and the wiring with 'acsar-gym doctor DEVICE --spin'"
            )

    def robot(self) -> RobotConfig:
        """Make the robot with what was found; the rest stays as it was.

        Raises:
            ConfigError: what was found contradicts another field, and the message says which.
        """
        changes: dict[str, dict[str, Any]] = {"motor": {}, "firmware": {}, "encoder": {}}
        found: dict[str, Measured | None] = {}
        for one in self.findings:
            if one.told:
                self._add(one, changes)
                found[f"{one.name}.{one.wheel}" if one.wheel else one.name] = self._measured(one)
        if self.delays:
            changes["firmware"]["delay_samples"] = self.delays
        counts = self._counts(changes["encoder"])
        if COUNTS_FIELD in counts["encoder"]:
            found[f"encoder.{COUNTS_FIELD}"] = None
        measured = update_measured(self.config.measured, found)
        return self.config.with_(**changes | {"measured": measured} | counts)

    def _add(self, one: ParameterFinding, changes: dict[str, dict[str, Any]]) -> None:
        """Add one finding to the changes of its section."""
        section, field = one.name.split(".")
        value = None if one.value is None else round_digits(one.value)
        if not one.wheel:
            changes[section][field] = value
            return
        k = MOTORS.index(one.wheel)
        four = changes[section].setdefault(
            field, [getattr(self.config.motor.of_wheel(w), field) for w in range(4)]
        )
        four[k] = value

    def _measured(self, one: ParameterFinding) -> Measured | None:
        """The interval of one finding, for the robot's `measured`."""
        if one.low is None or one.high is None:
            return None
        return Measured(
            low=round_digits(one.low),
            high=round_digits(one.high),
            method=IDENTIFY_METHOD,
            logs=self.logs,
        )

    def _counts(self, encoder: dict[str, Any]) -> dict[str, dict[str, Any]]:
        """Counts per turn where those configured would be coarser than the printed numbers."""
        step = next(
            one.value for one in self.findings if one.name == parameter_findings.QUANTUM_NAME
        )
        window = encoder.get("window", self.config.encoder.window)
        own = 2.0 * math.pi / (self.config.encoder.counts_per_revolution * window)
        counted = any(one.note == parameter_findings.COUNTED_NOTE for one in self.findings)
        if step is None or counted or own < 2.0 * step or not self.held_out:
            return {"encoder": encoder}
        fine = math.ceil(2.0 * math.pi / (COUNT_SHARE * step * window))
        return {"encoder": {**encoder, COUNTS_FIELD: min(fine, 10_000_000)}}

    def as_dict(self) -> dict[str, Any]:
        """Format for JSON."""
        return {
            "findings": [asdict(one) for one in self.findings],
            "held_out": asdict(self.held_out) if self.held_out else None,
            "delays": list(self.delays),
            "duration": self.duration,
            "logs": list(self.logs),
        }


def _alike(value: float | None, before: float | None) -> bool:
    """Whether two feedback rates are the same."""
    return value is not None and before is not None and abs(value / before - 1.0) < SAME_RATE


def round_digits(value: float) -> float:
    """Round to four significant digits, for a file."""
    return float(f"{value:.{WRITTEN_DIGITS}g}")


def identify_logs(
    logs: Sequence[WireLog], config: RobotConfig, hashes: Sequence[str] = ()
) -> Identification:
    """Identify the board and motors of one robot from what its wire carried.

    Args:
        logs: of the wire, one for each episode.
        config: of the robot; what the logs can't tell stays.
        hashes: of the logs' files, for the robot's file.

    Raises:
        ConfigError: the logs hold no commands, or no feedback.
        IdentificationError: a wheel doesn't answer its own command.
    """
    tracks = [one for one in (decode_track(log, config) for log in logs) if one is not None]
    if not tracks:
        raise ConfigError("the log holds no commands, or no feedback to them: nothing to identify")
    identifiability.check_wheel_order(tracks)
    known = check_identifiability(tracks)
    fit = fit_motors(tracks, config, known)
    findings = [
        *parameter_findings.find_wheels(fit, config, known),
        *parameter_findings.find_board(fit, config, known, tracks),
    ]
    delay = next(one for one in findings if one.name == parameter_findings.DELAY_NAME)
    return Identification(
        config,
        tuple(findings),
        _held_out(fit, config),
        parameter_findings.sample_delays(fit) if fit and delay.told else (),
        sum(one.duration for one in tracks),
        tuple(hashes),
    )


def _held_out(fit: MotorFit | None, config: RobotConfig) -> HeldOutErrors | None:
    """Validate a fit on the held-out lines."""
    if fit is None:
        return None
    problem = replace(fit.problem, held_out=True)
    if not problem.count:
        return None
    configured = [configured_wheel(config, wheel) for wheel in problem.wheels]
    lines = sum(len(one.stamps) for one in problem.tracks)

    def error(wheels: Sequence[WheelModel], clock: BoardTimes) -> float:
        rest = [problem.residuals_of(k, wheel, clock) for k, wheel in enumerate(wheels)]
        return float(np.sqrt(np.mean(np.concatenate(rest) ** 2)))

    measured = np.concatenate([problem.measured(k) for k in range(len(problem.wheels))])
    return HeldOutErrors(
        error(configured, configured_times(config)),
        error(fit.motors, fit.clock),
        problem.count / lines,
        float(np.sqrt(np.mean(measured**2))),
    )


SHOWN_UNITS = {
    "motor.time_constant": (1e3, "ms"),
    "motor.gain": (1.0, ""),
    "motor.acceleration": (1.0, "rad/s^2"),
    "motor.deadband": (1.0, "rad/s"),
    "firmware.command_delay": (1e3, "ms"),
    "firmware.command_timeout": (1e3, "ms"),
    "firmware.feedback_rate": (1.0, "Hz"),
    "encoder.window": (1e3, "ms"),
    "encoder.quantum": (1.0, "rad/s"),
}
"""Factor and unit in which each parameter is shown."""


def identification_table(found: Identification) -> Table:
    """Draw the findings; what a log can't tell has no number, but a reason."""
    drawn = Table(title="acsar-gym identify", title_justify="left", caption=_caption(found))
    drawn.caption_justify = "left"
    for column in ("parameter", "wheel", "value", "95 % interval", "before", "note"):
        drawn.add_column(column, overflow="fold")
    for one in found.findings:
        factor, unit = SHOWN_UNITS[one.name]
        drawn.add_row(
            one.name,
            one.wheel or ("all" if one.name.startswith("motor.") else ""),
            _value(one, factor, unit),
            _interval(one, factor),
            _number(one.before, factor),
            one.note if one.value is not None or one.told else f"[yellow]can't tell:[/] {one.note}",
        )
    return drawn


def _value(one: ParameterFinding, factor: float, unit: str) -> str:
    if one.value is None or one.value == NO_RAMP:
        return "none" if one.told else "-"
    return f"{_number(one.value, factor)} {unit}".strip()


def _interval(one: ParameterFinding, factor: float) -> str:
    if one.low is None or one.high is None or one.value == NO_RAMP:
        return ""
    return f"{_number(one.low, factor)} to {_number(one.high, factor)}"


def _number(value: float | None, factor: float) -> str:
    if value is None:
        return "none"
    scaled = value * factor
    return f"{scaled:.1f}" if abs(scaled) >= 100.0 else f"{scaled:.3g}"


def _caption(found: Identification) -> str:
    """Say how well the fit predicts what it didn't see."""
    log = f"{found.duration:.1f} s of log"
    if found.held_out is None:
        return log
    one = found.held_out
    return (
        f"{log}; wheel speeds on the {one.share:.0%} that the fit didn't see: "
        f"{one.after:.3f} rad/s RMS, {one.before:.3f} as configured before"
    )


def identify_files(paths: Sequence[Path], config: RobotConfig | None) -> Identification:
    """Identify a robot from recordings.

    Args:
        paths: of recordings of one robot.
        config: of the robot; None for the one that was recorded.

    Raises:
        ConfigError: a file can't be read, or they are of different robots.
    """
    recordings = [(path, read(path)) for path in paths]
    check_same_robot([(str(path), recording) for path, recording in recordings], "identify")
    logs = [episode.wire for _, recording in recordings for episode in recording.episodes]
    hashes = [recording.sha256 for _, recording in recordings]
    return identify_logs(logs, config or recordings[0][1].config, hashes)


def identify_device(
    link: Link, config: RobotConfig, duration: float, recorder: Recorder | None = None
) -> Identification:
    """Drive the manoeuvre, and identify the robot from it. Errors as for `manoeuvre.drive`."""
    log = drive_excitation(link, config, duration, recorder)
    path = None if recorder is None or recorder.problem else recorder.path
    return identify_logs([log], config, [hash_log(log) if path is None else read(path).sha256])


def hash_log(log: WireLog) -> str:
    """First 16 hex digits of the SHA-256 of what a wire carried."""
    whole = hashlib.sha256(log.sent_stamps.tobytes() + log.got_stamps.tobytes())
    whole.update(b"".join(log.sent + log.got))
    return whole.hexdigest()[:16]
