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
from acsar_gym.errors import AcsarError, ConfigError
from acsar_gym.links import Link
from acsar_gym.protocol import MOTORS, WHEELS
from acsar_gym.recording import Recorder
from acsar_gym.recording.pairs import check_same_robot
from acsar_gym.recording.reader import read
from acsar_gym.recording.types import WireLog
from acsar_gym.tools.sysid import board_log, parameter_findings
from acsar_gym.tools.sysid.board_log import decode_track
from acsar_gym.tools.sysid.excitation import drive_excitation
from acsar_gym.tools.sysid.fit import MotorFit, configured_times, configured_wheel
from acsar_gym.tools.sysid.model_check import ModelCheck, check_model, measure_parts
from acsar_gym.tools.sysid.parameter_findings import ParameterFinding
from acsar_gym.tools.sysid.twist_controller import SEPARATION_NAME, fit_twists, resend_twists

IDENTIFY_METHOD = "identify"
COUNTS_FIELD = "counts_per_revolution"
SAME_RATE = 0.05
"""A feedback rate is as configured within this share."""
COUNT_SHARE = 0.1
"""Where counts must be made up, one count is this share of the printed step."""
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
    SEPARATION_NAME: (1.0, "m"),
}
"""Factor and unit in which each parameter is shown."""


def identify_files(paths: Sequence[Path], config: RobotConfig | None) -> Identification:
    """Identify a robot from recordings.

    Args:
        paths: of recordings of one robot.
        config: of the robot; None for the one that was recorded.

    Raises:
        ConfigError: a file can't be read, or they are of different robots.
    """
    recordings = [(str(path), read(path)) for path in paths]
    check_same_robot(recordings, "identify")
    robot = config or recordings[0][1].config
    logs = [
        resend_twists(episode.wire, recording.config, robot)
        for _, recording in recordings
        for episode in recording.episodes
    ]
    hashes = [digest for _, recording in recordings for digest in sorted(recording.sources)]
    return identify_logs(logs, robot, hashes)


def identify_device(
    link: Link, config: RobotConfig, duration: float, recorder: Recorder | None = None
) -> Identification:
    """Drive the manoeuvre, and identify the robot from it. Errors as for `drive_excitation`."""
    log = drive_excitation(link, config, duration, recorder)
    if recorder is not None and recorder.path is not None and not recorder.problem:
        return identify_logs([log], config, [read(recorder.path).sha256])
    whole = hashlib.sha256(log.sent_stamps.tobytes() + log.got_stamps.tobytes())
    whole.update(b"".join((*log.sent, *log.got)))
    return identify_logs([log], config, [whole.hexdigest()[:16]])


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
        AcsarError: a wheel doesn't answer its own command.
    """
    tracks = [one for one in (decode_track(log, config) for log in logs) if one is not None]
    if not tracks:
        raise ConfigError("the log holds no commands, or no feedback to them: nothing to identify")
    board_log.check_wheel_order(tracks)
    known = board_log.check_identifiability(tracks)
    fit, controller = fit_twists(tracks, config, known)
    parts = () if fit is None else measure_parts(fit)
    board = parameter_findings.find_board(fit, config, known, tracks)
    delayed = any(one.name == parameter_findings.DELAY_NAME and one.told for one in board)
    return Identification(
        config,
        (*parameter_findings.find_wheels(fit, config, known, parts), *board, *controller),
        None if fit is None else _validate(fit, config),
        parameter_findings.sample_delays(fit) if fit and delayed else (),
        sum(one.duration for one in tracks),
        tuple(hashes),
        None if fit is None else check_model(fit, config, parts),
    )


def _validate(fit: MotorFit, config: RobotConfig) -> HeldOutErrors | None:
    """Validate a fit on the held-out lines; None where there are none."""
    problem = replace(fit.problem, held_out=True)
    if not problem.count:
        return None
    configured = [configured_wheel(config, wheel) for wheel in problem.wheels]
    errors = []
    for wheels, times in ((configured, configured_times(config)), (fit.wheels, fit.times)):
        rest = [problem.residuals_of(k, wheel, times) for k, wheel in enumerate(wheels)]
        errors.append(float(np.sqrt(np.mean(np.concatenate(rest) ** 2))))
    measured = np.concatenate([problem.measured(k) for k in range(len(problem.wheels))])
    lines = sum(len(one.stamps) for one in problem.tracks)
    signal = float(np.sqrt(np.mean(measured**2)))
    return HeldOutErrors(errors[0], errors[1], problem.count / lines, signal)


@dataclass(frozen=True)
class HeldOutErrors:
    """Error of the wheel speeds on the part of the log that the fit didn't see, RMS [rad/s]."""

    before: float
    after: float
    share: float
    """Of the log that was held out."""
    signal: float
    """The wheel speeds themselves on that part, RMS [rad/s]."""


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
        model: whether the model describes the board; None where too little was fitted.
    """

    config: RobotConfig
    findings: tuple[ParameterFinding, ...]
    held_out: HeldOutErrors | None
    delays: tuple[float, ...]
    duration: float
    logs: tuple[str, ...] = ()
    model: ModelCheck | None = None

    @property
    def dead(self) -> tuple[str, ...]:
        """Names of the wheels that never turned."""
        never = "".join(
            one.wheel or MOTORS
            for one in self.findings
            if one.name in board_log.WHEEL_PARAMETERS and one.note == board_log.NEVER_TURNED
        )
        return tuple(name for letter, name in zip(MOTORS, WHEELS, strict=True) if letter in never)

    def check(self, *, anyway: bool = False) -> None:
        """Check that this is worth a robot's file.

        Raises:
            AcsarError: it isn't, and why.
        """
        if len(self.dead) == len(WHEELS):
            raise AcsarError(
                "nothing to write: no wheel turned; check the motors' power and every encoder, "
                "with 'acsar-gym doctor DEVICE --spin' ('acsar-gym doctor ros2')"
            )
        dead = f" ({', '.join(self.dead)} never turned)" if self.dead else ""
        told = {one.name: one for one in self.findings if one.told}
        rate = told.pop(parameter_findings.RATE_NAME, None)
        if rate is not None and rate.value is not None and rate.before is not None:
            same = abs(rate.value / rate.before - 1.0) < SAME_RATE
            told |= {} if same else {parameter_findings.RATE_NAME: rate}
        if not told:
            raise AcsarError(
                f"nothing to write: nothing new was found{dead}; the table says what is missing"
            )
        if self.model is not None and self.model.pattern and not anyway:
            hint = ""
            if any(one.name == SEPARATION_NAME for one in self.findings):
                hint = "; are linear_limits and angular_limits of the file those of its controller?"
            raise AcsarError(
                f"nothing to write: the model {self.model.verdict}{hint}; a twin would answer "
                "otherwise than this board; --anyway writes the file"
            )

    def robot(self) -> RobotConfig:
        """Make the robot with what was found; the rest stays as it was.

        Where the model doesn't fit, values have no intervals, and the robot's file says so.

        Raises:
            ConfigError: what was found contradicts another field, and the message says which.
        """
        changes: dict[str, Any] = {"motor": {}, "firmware": {}, "encoder": {}, "ros2": {}}
        measured: dict[str, Measured | None] = {}
        misfit = self.model is not None and bool(self.model.pattern)
        for one in self.findings:
            if not one.told:
                continue
            section, field = one.name.split(".")
            value = None if one.value is None else round_digits(one.value)
            if one.wheel:
                own = [getattr(self.config.motor.of_wheel(w), field) for w in range(4)]
                four = changes[section].setdefault(field, own)
                four[MOTORS.index(one.wheel)] = value
            else:
                changes[section][field] = value
            interval = None
            if one.low is not None and one.high is not None and not misfit:
                low, high = round_digits(one.low), round_digits(one.high)
                interval = Measured(low=low, high=high, method=IDENTIFY_METHOD, logs=self.logs)
            measured[f"{one.name}.{one.wheel}" if one.wheel else one.name] = interval
        if self.delays:
            changes["firmware"]["delay_samples"] = self.delays
        counts = self._make_up_counts(changes["encoder"].get("window", self.config.encoder.window))
        if counts is not None:
            changes["encoder"][COUNTS_FIELD] = counts
            measured[f"encoder.{COUNTS_FIELD}"] = None
        if self.model is not None:
            changes |= {"motor_fit": self.model.verdict, "motor_fit_logs": self.logs}
        return self.config.with_(
            **changes, measured=update_measured(self.config.measured, measured)
        )

    def _make_up_counts(self, window: float) -> int | None:
        """Counts per turn where those configured would be coarser than the printed numbers."""
        quantum = next(one for one in self.findings if one.name == parameter_findings.QUANTUM_NAME)
        coarse = 2.0 * math.pi / (self.config.encoder.counts_per_revolution * window)
        if (
            quantum.value is None
            or quantum.note == parameter_findings.COUNTED_NOTE
            or not self.held_out
        ):
            return None
        if coarse < 2.0 * quantum.value:
            return None
        return min(math.ceil(2.0 * math.pi / (COUNT_SHARE * quantum.value * window)), 10_000_000)

    def as_dict(self) -> dict[str, Any]:
        """Format for JSON."""
        return {
            "findings": [asdict(one) for one in self.findings],
            "held_out": asdict(self.held_out) if self.held_out else None,
            "model": self.model._asdict() | {"verdict": self.model.verdict} if self.model else None,
            "delays": list(self.delays),
            "duration": self.duration,
            "logs": list(self.logs),
        }


def round_digits(value: float) -> float:
    """Round to four significant digits, for a file."""
    return float(f"{value:.4g}")


def identification_table(found: Identification) -> Table:
    """Draw the findings; what a log can't tell has no number, but a reason."""
    caption = f"{found.duration:.1f} s of log"
    if (error := found.held_out) is not None:
        caption += (
            f"; wheel speeds on the {error.share:.0%} that the fit didn't see: "
            f"{error.after:.3f} rad/s RMS, {error.before:.3f} as configured before"
        )
    if (model := found.model) is not None:
        caption += (
            f"\nthe model {model.verdict} ({model.place}: {model.error:.3f} rad/s RMS, where the "
            f"noise is {model.noise:.3f}"
            f"{', less than a repeated drive differs by' if model.harmless else ''})"
        )
    drawn = Table(title="acsar-gym identify", title_justify="left", caption=caption)
    drawn.caption_justify = "left"
    for column in ("parameter", "wheel", "value", "95 % interval", "before", "note"):
        drawn.add_column(column, overflow="fold")
    for one in found.findings:
        factor, unit = SHOWN_UNITS[one.name]
        known = one.value is not None and one.value != parameter_findings.NO_RAMP
        value = "none" if one.told else "kept"
        interval = ""
        if known:
            value = f"{_format_number(one.value, factor)} {unit}".strip()
            if one.low is not None and one.high is not None:
                ends = (_format_number(end, factor) for end in (one.low, one.high))
                interval = " to ".join(ends)
        told = one.value is not None or one.told
        drawn.add_row(
            one.name,
            one.wheel or ("all" if one.name.startswith("motor.") else ""),
            value,
            interval,
            _format_number(one.before, factor),
            one.note if told else f"[yellow]can't tell:[/] {one.note}",
        )
    return drawn


def _format_number(value: float | None, factor: float) -> str:
    if value is None:
        return "none"
    scaled = value * factor
    return f"{scaled:.1f}" if abs(scaled) >= 100.0 else f"{scaled:.3g}"
