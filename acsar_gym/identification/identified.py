"""An identification as a whole: logs in; findings, a validated fit and a robot's file out."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from acsar_gym.config import Measured, RobotConfig, renewed
from acsar_gym.errors import ConfigError
from acsar_gym.identification import board, motors
from acsar_gym.identification.estimation import Estimate, clock_of, estimated, motor_of
from acsar_gym.identification.finding import Finding
from acsar_gym.identification.knowable import judged
from acsar_gym.identification.response import Clock, Wheel
from acsar_gym.identification.tracks import track
from acsar_gym.protocol import MOTORS
from acsar_gym.recording.wire_log import WireLog

METHOD = "identify"
COUNTS = "counts_per_revolution"
DIGITS = 4
"""Significant digits of written numbers."""
MARGIN = 0.1
"""Where counts must be made up, one count is this share of the printed step."""


@dataclass(frozen=True)
class HeldOut:
    """Error of the wheel speeds on the part of the log that the fit didn't see, RMS [rad/s]."""

    before: float
    after: float
    share: float
    """Of the log that was held out."""


@dataclass(frozen=True, eq=False)
class Identified:
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
    findings: tuple[Finding, ...]
    held_out: HeldOut | None
    delays: tuple[float, ...]
    duration: float
    logs: tuple[str, ...] = ()

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
        if COUNTS in counts["encoder"]:
            found[f"encoder.{COUNTS}"] = None
        measured = renewed(self.config.measured, found)
        return self.config.with_(**changes | {"measured": measured} | counts)

    def _add(self, one: Finding, changes: dict[str, dict[str, Any]]) -> None:
        """Add one finding to the changes of its section."""
        section, field = one.name.split(".")
        value = None if one.value is None else rounded(one.value)
        if not one.wheel:
            changes[section][field] = value
            return
        k = MOTORS.index(one.wheel)
        four = changes[section].setdefault(
            field, [getattr(self.config.motor.of_wheel(w), field) for w in range(4)]
        )
        four[k] = value

    def _measured(self, one: Finding) -> Measured | None:
        """The interval of one finding, for the robot's `measured`."""
        if one.low is None or one.high is None:
            return None
        return Measured(low=rounded(one.low), high=rounded(one.high), method=METHOD, logs=self.logs)

    def _counts(self, encoder: dict[str, Any]) -> dict[str, dict[str, Any]]:
        """Counts per turn where those configured would be coarser than the printed numbers."""
        step = next(one.value for one in self.findings if one.name == board.QUANTUM)
        window = encoder.get("window", self.config.encoder.window)
        own = 2.0 * math.pi / (self.config.encoder.counts_per_revolution * window)
        counted = any(one.note == board.COUNTED for one in self.findings)
        if step is None or counted or own < 2.0 * step or not self.held_out:
            return {"encoder": encoder}
        fine = math.ceil(2.0 * math.pi / (MARGIN * step * window))
        return {"encoder": {**encoder, COUNTS: min(fine, 10_000_000)}}

    def as_dict(self) -> dict[str, Any]:
        """Format for JSON."""
        return {
            "findings": [asdict(one) for one in self.findings],
            "held_out": asdict(self.held_out) if self.held_out else None,
            "delays": list(self.delays),
            "duration": self.duration,
            "logs": list(self.logs),
        }


def rounded(value: float) -> float:
    """Round to four significant digits, for a file."""
    return float(f"{value:.{DIGITS}g}")


def identified(
    logs: Sequence[WireLog], config: RobotConfig, hashes: Sequence[str] = ()
) -> Identified:
    """Identify the board and motors of one robot from what its wire carried.

    Args:
        logs: of the wire, one for each episode.
        config: of the robot; what the logs can't tell stays.
        hashes: of the logs' files, for the robot's file.

    Raises:
        ConfigError: the logs hold no commands, or no feedback.
    """
    tracks = [one for one in (track(log, config) for log in logs) if one is not None]
    if not tracks:
        raise ConfigError("the log holds no commands, or no feedback to them: nothing to identify")
    known = judged(tracks)
    fit = estimated(tracks, config, known)
    findings = [
        *motors.of_wheels(fit, config, known),
        *board.of_board(fit, config, known, tracks),
    ]
    delay = next(one for one in findings if one.name == board.DELAY)
    return Identified(
        config,
        tuple(findings),
        _held_out(fit, config),
        board.delay_samples(fit) if fit and delay.told else (),
        sum(one.duration for one in tracks),
        tuple(hashes),
    )


def _held_out(fit: Estimate | None, config: RobotConfig) -> HeldOut | None:
    """Validate a fit on the held-out lines."""
    if fit is None:
        return None
    problem = replace(fit.problem, held_out=True)
    if not problem.count:
        return None
    configured = [motor_of(config, wheel) for wheel in problem.wheels]
    lines = sum(len(one.stamps) for one in problem.tracks)

    def error(wheels: Sequence[Wheel], clock: Clock) -> float:
        rest = [problem.residuals_of(k, wheel, clock) for k, wheel in enumerate(wheels)]
        return float(np.sqrt(np.mean(np.concatenate(rest) ** 2)))

    return HeldOut(
        error(configured, clock_of(config)), error(fit.motors, fit.clock), problem.count / lines
    )
