"""The job `identify`: logs in; findings, a validated fit, a table and a robot's file out."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.table import Table

from acsar_gym.config import Measured, RobotConfig, update_measured
from acsar_gym.config.robot import MISFIT
from acsar_gym.errors import AcsarError, ConfigError
from acsar_gym.links import Link
from acsar_gym.protocol import MOTORS, PRINTED_STEP, WHEELS
from acsar_gym.recording import Recorder
from acsar_gym.recording.reader import read
from acsar_gym.recording.types import WireLog
from acsar_gym.tools.sysid import board_log
from acsar_gym.tools.sysid.board import HIGHEST_RATIO, LOWEST_RATIO, likely_units, measure_rate
from acsar_gym.tools.sysid.board_log import BoardTrack, Estimate, Floats
from acsar_gym.tools.sysid.excitation import drive_excitation
from acsar_gym.tools.sysid.fit import (
    BOARD_PARAMETERS,
    DELAY,
    NORMAL_MEDIAN,
    TIMEOUT,
    WHEEL_PARAMETERS,
    WINDOW,
    MotorFit,
    Parameter,
    configured_times,
    configured_wheel,
    fit_tracks,
)
from acsar_gym.tools.sysid.pairs import check_same_robot

IDENTIFY_METHOD = "identify"
FITS = "fits"
"""What a robot's file says of a model that fits; otherwise `MISFIT` and the error."""
SHORTEST_LOG = 5.0
"""Log of which a part can be held out [s]."""
NORMAL_QUANTILE = 1.96
INTERVAL_FACTOR = 2.5
"""Factor on intervals, so that those of four wheels hold together in 19 of 20 simulated robots: the
twin's answer is a mean over phases."""
CLEARLY_NARROWER = 0.3
"""A parameter is found if its interval is at most this share of its prior's."""
LEAST_DEADBAND = 0.15
"""Boards that compute in integers let wheels stand at slower speeds than this [rad/s]."""
NO_RAMP = 1e6
"""Acceleration of a board without a ramp [rad/s^2]; the largest of the field."""
LONG_PAUSE = 2.0
"""A board that keeps turning so long without commands has no time-out [s]."""
GAP_NOISE = 0.1
"""By how much wheel speeds differ if one drive is repeated, RMS [rad/s]: what `gap` can't see.

The same commands, with other phases of the board's clocks: 0.04 to 0.06, 0.1 at most (median and
maximum of pairs; simulated robots and tests/integer_board.py; `pytest -s -m slow
tests/tools/sysid/test_integer_board.py -k repeated` prints some)."""
NOISES = 2.0
"""A model fits if its held-out error is at most so many noises, or `GAP_NOISE`s if that is more."""
DAMAGED_SHARE = 0.03
"""Share of lines, the worst, that may be damaged and don't count."""
SAME_RATE = 0.05
"""A feedback rate is as configured within this share."""
LEAST_RATE_SHARE = 0.002
"""Half width of the rate's interval, as a share: clocks differ by that much."""
SAME_WINDOW = 0.02
"""Averaging times that differ by less than this are nearly the same for a drive [s]."""
SAME_STEP = 0.01
"""Steps of printed speeds that differ by less than this share are the same."""
COUNT_SHARE = 0.1
"""A count that must be finer is this share of the printed step."""
DELAY_QUANTILES = np.linspace(0.05, 0.95, 10)
"""Quantiles of the delays of single steps."""
INFORMATIVE_SHARE = 0.2
"""A block shows a delay if it has this share of the median block's information."""
NEVER_TURNED = "this wheel never turned"
DELAY_NAME = BOARD_PARAMETERS[DELAY].name
TIMEOUT_NAME = BOARD_PARAMETERS[TIMEOUT].name
RATE_NAME = "firmware.feedback_rate"
QUANTUM_NAME = "encoder.quantum"
SHOWN_UNITS = {
    "motor.time_constant": (1e3, "ms"),
    "motor.gain": (1.0, ""),
    "motor.acceleration": (1.0, "rad/s^2"),
    "motor.deadband": (1.0, "rad/s"),
    DELAY_NAME: (1e3, "ms"),
    TIMEOUT_NAME: (1e3, "ms"),
    RATE_NAME: (1.0, "Hz"),
    "encoder.window": (1e3, "ms"),
    QUANTUM_NAME: (1.0, "rad/s"),
}
"""Factor and unit in which each parameter is shown."""


@dataclass(frozen=True)
class ParameterFinding:
    """One parameter of one wheel, or of the board.

    Attributes:
        name: Field of the robot's file, such as "motor.gain".
        wheel: Letter of the wheel, "a" to "d"; "" for all.
        value: Value in the field's unit; None if it isn't known, or if there is none.
        low: Lower end of the 95 % interval.
        high: Upper end.
        before: Configured value.
        note: Why it isn't known, or what it means.
        told: Whether it goes into the robot's file.
    """

    name: str
    wheel: str = ""
    value: float | None = None
    low: float | None = None
    high: float | None = None
    before: float | None = None
    note: str = ""
    told: bool = False

    def tell(self, estimate: Estimate, note: str = "") -> ParameterFinding:
        """A copy with a value and its interval."""
        return replace(self, **estimate._asdict(), note=note, told=True)


class HeldOutErrors(NamedTuple):
    """Error of the wheel speeds on the part of the log that the fit didn't see, RMS [rad/s]."""

    before: float
    """With the robot as configured."""
    after: float
    """As fitted; of the wheel that fits worst."""
    noise: float
    """What is expected of that wheel's lines if the model is right."""
    share: float
    """Part of the log that was held out."""

    @property
    def fits(self) -> bool:
        """Whether the error is close to the noise."""
        return self.after <= NOISES * max(self.noise, GAP_NOISE)


@dataclass(frozen=True, eq=False)
class Identification:
    """What an identification found.

    Attributes:
        config: Robot as it was.
        findings: Findings, one for each parameter.
        held_out: Validation; None if nothing was fitted.
        delays: Quantiles of delays of single steps, on top of the fitted delay [s].
        duration: Length of the logs [s].
        logs: Hashes of the logs.
    """

    config: RobotConfig
    findings: tuple[ParameterFinding, ...]
    held_out: HeldOutErrors | None
    delays: tuple[float, ...]
    duration: float
    logs: tuple[str, ...] = ()

    @property
    def dead(self) -> tuple[str, ...]:
        """Names of the wheels that never turned."""
        letters = {
            finding.wheel or MOTORS for finding in self.findings if finding.note == NEVER_TURNED
        }
        return tuple(
            name for letter, name in zip(MOTORS, WHEELS, strict=True) if letter in "".join(letters)
        )

    @property
    def misfit(self) -> str:
        """In which way the model doesn't describe the board; empty if it does."""
        for finding in self.findings:
            if finding.name != "motor.gain" or not (finding.value and finding.before):
                continue
            ratio = finding.value / finding.before
            if not LOWEST_RATIO <= ratio <= HIGHEST_RATIO:
                wheels = f"wheel {finding.wheel}" if finding.wheel else "every wheel"
                units = likely_units(ratio, self.config)
                return f"{wheels} reports {ratio:.2f} times the expected speed: {units}"
        if self.held_out is None or self.held_out.fits:
            return ""
        errors = self.held_out
        missed = f"wheel speeds are missed by {errors.after:.2f} rad/s RMS"
        return f"{missed}, where the noise is {errors.noise:.2f}"

    @property
    def verdict(self) -> str:
        """What the robot's file says of the model."""
        return MISFIT + self.misfit if self.misfit else FITS

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

        # A rate that is as configured is nothing new.
        if not any(finding.told and not _is_known_rate(finding) for finding in self.findings):
            dead = f" ({', '.join(self.dead)} never turned)" if self.dead else ""
            raise AcsarError(
                f"nothing to write: nothing new was found{dead}; the table says what is missing"
            )

        if self.misfit and not anyway:
            raise AcsarError(
                f"nothing to write: the model {self.verdict}; a twin would answer otherwise than "
                "this board; --anyway writes the file"
            )

    def robot(self) -> RobotConfig:
        """Make the robot with what was found; the rest stays as it was.

        If the model doesn't fit, values have no intervals, and the robot's file says so.

        Raises:
            ConfigError: what was found contradicts another field, and the message says which.
        """
        changes: dict[str, Any] = {"motor": {}, "firmware": {}, "encoder": {}}
        measured: dict[str, Measured | None] = {}
        for finding in self.findings:
            if not finding.told:
                continue
            section, field = finding.name.split(".")
            name = finding.name
            value = None if finding.value is None else round_digits(finding.value)
            if finding.wheel:
                name += f".{finding.wheel}"
                four = [getattr(self.config.motor.of_wheel(wheel), field) for wheel in range(4)]
                changes[section].setdefault(field, four)[MOTORS.index(finding.wheel)] = value
            else:
                changes[section][field] = value
            measured[name] = None
            if finding.low is not None and finding.high is not None and not self.misfit:
                measured[name] = Measured(
                    low=round_digits(finding.low),
                    high=round_digits(finding.high),
                    method=IDENTIFY_METHOD,
                    logs=self.logs,
                )

        if self.delays:
            changes["firmware"]["delay_samples"] = self.delays
        if (counts := self._choose_counts(changes["encoder"])) is not None:
            changes["encoder"]["counts_per_revolution"] = counts
            measured["encoder.counts_per_revolution"] = None
        if self.held_out is not None:
            changes |= {"motor_fit": self.verdict, "motor_fit_logs": self.logs}
        intervals = update_measured(self.config.measured, measured)
        return self.config.with_(**changes, measured=intervals)

    def _choose_counts(self, encoder: dict[str, Any]) -> int | None:
        """Choose finer counts per turn if those configured are coarser than the printed numbers."""
        window = float(encoder.get("window", self.config.encoder.window))
        (quantum,) = (finding.value for finding in self.findings if finding.name == QUANTUM_NAME)
        coarse = quantum is not None and _count_speed(self.config, window) >= 2.0 * quantum
        if quantum is None or self.held_out is None or not coarse:
            return None
        return min(math.ceil(2.0 * math.pi / (COUNT_SHARE * quantum * window)), 10_000_000)

    def as_dict(self) -> dict[str, Any]:
        """Format for JSON."""
        return {
            "findings": [asdict(finding) for finding in self.findings],
            "held_out": self.held_out._asdict() if self.held_out else None,
            "model": self.verdict if self.held_out else None,
            "delays": list(self.delays),
            "duration": self.duration,
            "logs": list(self.logs),
        }


def identify_files(paths: Sequence[Path], config: RobotConfig | None) -> Identification:
    """Identify a robot from recordings.

    Args:
        paths: Recordings of one robot.
        config: The robot; None for the one that was recorded.

    Raises:
        ConfigError: a file can't be read, or they are of different robots.
    """
    recordings = [(str(path), read(path)) for path in paths]
    check_same_robot(recordings, "identify")
    robot = config or recordings[0][1].config
    logs = [
        board_log.resend_twists(episode.wire, recording.config, robot)
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
    digest = hashlib.sha256(log.sent_stamps.tobytes() + log.got_stamps.tobytes())
    digest.update(b"".join((*log.sent, *log.got)))
    return identify_logs([log], config, [digest.hexdigest()[:16]])


def identify_logs(
    logs: Sequence[WireLog], config: RobotConfig, hashes: Sequence[str] = ()
) -> Identification:
    """Identify the board and motors of one robot from what its wire carried.

    Args:
        logs: Logs of the wire, one for each episode.
        config: The robot; what the logs don't show stays as it is.
        hashes: Hashes of the logs' files, for the robot's file.

    Raises:
        ConfigError: the logs hold no commands, or no feedback.
        AcsarError: a wheel doesn't answer its own command.
    """
    tracks = board_log.decode_tracks(logs, config)
    if not tracks:
        raise ConfigError("the log holds no commands, or no feedback to them: nothing to identify")
    duration = sum(track.duration for track in tracks)
    speeds = np.concatenate([track.speeds for track in tracks])
    quantum = board_log.find_quantum(speeds)
    turning = np.flatnonzero(np.abs(speeds).max(axis=0) > board_log.TURNING_SPEED / 2.0).tolist()
    fit = None
    if duration >= SHORTEST_LOG:
        board_log.check_wheel_order(tracks)
        step = quantum.value if quantum else 0.0
        fit = fit_tracks(tracks, turning, config, step) if turning else None

    missing = f"{duration:.1f} s of log: needs {SHORTEST_LOG:g} s or more"
    findings = [
        *_find_wheels(fit, config, turning, missing),
        *_find_times(fit, config, missing),
        _find_rate(tracks, config),
        _find_quantum(quantum, config),
    ]
    delayed = any(finding.name == DELAY_NAME and finding.told for finding in findings)
    return Identification(
        config=config,
        findings=tuple(findings),
        held_out=None if fit is None else _validate(fit, config),
        delays=sample_delays(fit) if fit is not None and delayed else (),
        duration=duration,
        logs=tuple(hashes),
    )


def _validate(fit: MotorFit, config: RobotConfig) -> HeldOutErrors | None:
    """Compare the error on the held-out lines with the noise; None without such lines."""
    problem = fit.problem
    held_out = problem.held_out
    if not held_out.any():
        return None
    residuals = fit.residuals[:, held_out]
    noise = estimate_noise(fit)[:, held_out]

    # The most damaged lines don't count.
    kept = math.ceil((1.0 - DAMAGED_SHARE) * residuals.shape[1])
    usual = np.argsort(np.abs(residuals) / noise, axis=1)[:, :kept]
    errors = _rms(np.take_along_axis(residuals, usual, axis=1))
    noises = _rms(np.take_along_axis(noise, usual, axis=1))
    worst = int(np.argmax(errors / np.maximum(noises, GAP_NOISE)))

    models = [configured_wheel(config, wheel) for wheel in problem.wheels]
    configured = problem.residuals(problem.join(models, configured_times(config)))[:, held_out]
    return HeldOutErrors(
        before=float(_rms(configured).max()),
        after=float(errors[worst]),
        noise=float(noises[worst]),
        share=float(np.mean(held_out)),
    )


def _rms(rows: Floats) -> Floats:
    return np.asarray(np.sqrt(np.mean(rows**2, axis=1)))


def estimate_noise(fit: MotorFit) -> Floats:
    """Estimate the noise of lines: what they scatter, and what the phase of a loop does to them.

    Returns:
        Standard deviations [rad/s], (wheels, lines).
    """
    blur = fit.jacobian[:, :, DELAY] * fit.problem.responder.dt
    jumps = np.median(np.abs(np.diff(fit.residuals, axis=1)), axis=1, keepdims=True)
    scatter = NORMAL_MEDIAN / math.sqrt(2.0) * jumps
    rounding = max(fit.problem.responder.rounding.step, PRINTED_STEP) / math.sqrt(12.0)
    return np.asarray(np.hypot(blur, np.maximum(scatter, rounding)))


def _estimate(fit: MotorFit, row: Parameter, place: int) -> Estimate | None:
    """A fitted number, or its logarithm; None if the log doesn't narrow its interval."""
    value = float(fit.x[place])
    sigma = math.sqrt(float(fit.spread[place, place]))
    half = max(row.resolution, NORMAL_QUANTILE * INTERVAL_FACTOR * sigma) + float(fit.slack[place])
    low = value - half
    high = value + half
    coarse = max(fit.problem.responder.rounding.step, LEAST_DEADBAND)
    if row.name == "motor.deadband" and value < coarse:
        low = 0.0  # slower wheels report zero, deadband or not
        high = max(high, coarse)
    is_narrow = high - low <= 2.0 * CLEARLY_NARROWER * NORMAL_QUANTILE * row.deviation
    return Estimate(value, low, high) if is_narrow and row.from_fit(value) < row.bounds[1] else None


def _find_wheels(
    fit: MotorFit | None, config: RobotConfig, turning: Sequence[int], missing: str
) -> Iterator[ParameterFinding]:
    """Findings of the four motors; the same for all if the wheels' intervals agree."""
    for column, row in enumerate(WHEEL_PARAMETERS):
        field = row.name.removeprefix("motor.")
        four = [
            ParameterFinding(
                row.name, letter, before=float(getattr(config.motor.of_wheel(wheel), field))
            )
            for wheel, letter in enumerate(MOTORS)
        ]
        estimates: dict[int, Estimate] = {}
        for wheel, finding in enumerate(four):
            note = NEVER_TURNED
            if wheel in turning:
                place = len(WHEEL_PARAMETERS) * turning.index(wheel) + column
                estimate = None if fit is None else _estimate(fit, row, place)
                estimates |= {} if estimate is None else {wheel: estimate}
                note = missing if fit is None else row.missing
            four[wheel] = replace(finding, note=note)

        if len(estimates) == len(WHEELS) and (common := _merge(list(estimates.values()))):
            estimates = dict.fromkeys(estimates, common)
        for wheel, estimate in estimates.items():
            four[wheel] = _tell_wheel(four[wheel], row, estimate)
        are_alike = len({replace(finding, wheel="") for finding in four}) == 1
        yield from [replace(four[0], wheel="")] if are_alike else four


def _merge(estimates: Sequence[Estimate]) -> Estimate | None:
    """The mean of the wheels, if it lies in each one's interval."""
    values, lows, highs = np.array(estimates).T
    mean = float(np.average(values, weights=(highs - lows) ** -2.0))
    if not ((lows <= mean) & (mean <= highs)).all():
        return None
    return Estimate(mean, float(lows.min()), float(highs.max()))


def _tell_wheel(finding: ParameterFinding, row: Parameter, estimate: Estimate) -> ParameterFinding:
    """Turn an estimate into what the file has: of a ramp, the acceleration."""
    value, low, high = (row.from_fit(number) for number in estimate)
    if row.name != "motor.acceleration":
        return finding.tell(Estimate(value, max(0.0, low), high))
    fastest = 1.0 / high
    if low < row.resolution:
        note = f"no ramp, or one faster than {fastest:.0f} rad/s^2"
        return finding.tell(Estimate(NO_RAMP, fastest, NO_RAMP), note)
    return finding.tell(Estimate(1.0 / value, fastest, 1.0 / low))


def _find_times(fit: MotorFit | None, config: RobotConfig, missing: str) -> list[ParameterFinding]:
    """Findings of the board's delay, averaging time and time-out."""
    configured = (
        config.firmware.command_delay,
        config.encoder.window,
        config.firmware.command_timeout,
    )
    delay, window, timeout = (
        ParameterFinding(row.name, before=value, note=missing if fit is None else row.missing)
        for row, value in zip(BOARD_PARAMETERS, configured, strict=True)
    )
    if fit is None:
        return [delay, window, timeout]

    # The twin averages over whole loops, and as configured if that is hardly another time. If the
    # configured time can't be true, any is better.
    dt = fit.problem.responder.dt
    fitted = fit.times.window
    averages = config.encoder.window
    estimate = _estimate(fit, BOARD_PARAMETERS[WINDOW], WINDOW)
    if estimate is None and fit.times.delay + (fitted - averages) / 2.0 < -dt:
        estimate = Estimate(fitted, 0.0, 2.0 * fitted + BOARD_PARAMETERS[WINDOW].resolution)
    if estimate is not None:
        if abs(averages - fitted) > SAME_WINDOW:
            averages = max(1, round(fitted / dt)) * dt
        window = window.tell(Estimate(averages, max(1e-3, estimate.low), estimate.high))

    # What is best known is the delay to the middle of the window.
    estimate = _estimate(fit, BOARD_PARAMETERS[DELAY], DELAY)
    if estimate is not None:
        value = max(0.0, estimate.value + (fitted - averages) / 2.0)
        low = max(0.0, min(value, estimate.low))
        in_ros = all(track.in_ros for track in fit.problem.tracks)
        note = "from publishing to the stamp that shows it" if in_ros else "on top of the wire"
        delay = delay.tell(Estimate(value, low, max(value, estimate.high)), note)
    return [delay, window, _find_timeout(timeout, fit)]


def _find_timeout(finding: ParameterFinding, fit: MotorFit) -> ParameterFinding:
    """The command time-out, or that there is none."""
    longest = max(track.longest_pause for track in fit.problem.tracks)
    estimate = _estimate(fit, BOARD_PARAMETERS[TIMEOUT], TIMEOUT)
    if fit.times.timeout < longest - board_log.PAUSE_GAP / 2.0:
        loop = fit.problem.responder.dt  # a board looks once a loop
        return (
            finding.tell(Estimate(*(end - loop / 2.0 for end in estimate))) if estimate else finding
        )
    if longest < LONG_PAUSE:
        return finding
    note = f"none: the wheels kept turning for {longest:.1f} s without commands"
    return replace(finding, note=note, told=True)


def _find_rate(tracks: Sequence[BoardTrack], config: RobotConfig) -> ParameterFinding:
    """The rate of the lines, as `doctor` measures it."""
    finding = ParameterFinding(RATE_NAME, before=config.feedback_rate)
    rates = [measure_rate(track.stamps.tolist(), track.numbers.tolist()) for track in tracks]
    rate = float(np.average(rates, weights=[len(track.stamps) for track in tracks]))
    if not 0.0 < rate <= config.firmware.loop_rate:
        return replace(finding, note=f"{rate:.0f} Hz, unlike any that a twin has")
    half = LEAST_RATE_SHARE * rate
    return finding.tell(Estimate(rate, rate - half, rate + half))


def _is_known_rate(finding: ParameterFinding) -> bool:
    """Whether this is the rate of lines that the robot's file has."""
    if finding.name != RATE_NAME or not finding.value or not finding.before:
        return False
    return abs(finding.value / finding.before - 1.0) < SAME_RATE


def _find_quantum(quantum: Estimate | None, config: RobotConfig) -> ParameterFinding:
    """The step of the printed speeds."""
    finding = ParameterFinding(QUANTUM_NAME, before=config.encoder.quantum)
    if quantum is None:
        return replace(finding, note="too few different speeds: drive slowly and fast")
    note = "finer than the two decimals of a line show"
    if quantum.low > 0.0:
        if abs(quantum.value / _count_speed(config, config.encoder.window) - 1.0) > SAME_STEP:
            return finding.tell(quantum)
        note = "whole encoder counts, as configured"
    return replace(finding, **quantum._asdict(), note=note)


def _count_speed(config: RobotConfig, window: float) -> float:
    """Speed of one encoder count in an averaging window [rad/s]."""
    return 2.0 * math.pi / (config.encoder.counts_per_revolution * window)


def sample_delays(fit: MotorFit) -> tuple[float, ...]:
    """Quantiles of the delays of single steps, on top of the fitted one [s]; at least zero.

    Each block of the log has a delay of its own: the shift that explains its residuals best.
    """
    blocks = fit.problem.blocks()
    slopes = fit.jacobian[:, :, DELAY]
    information = np.bincount(blocks, (slopes**2).sum(axis=0))
    shifts = -np.bincount(blocks, (slopes * fit.residuals).sum(axis=0))
    informed = information > INFORMATIVE_SHARE * np.median(information[information > 0.0])
    extra = np.quantile(shifts[informed] / information[informed], DELAY_QUANTILES)
    return tuple(round(float(delay), 5) for delay in np.maximum(0.0, extra))


def round_digits(value: float) -> float:
    """Round to four significant digits, for a file."""
    return float(f"{value:.4g}")


def identification_table(found: Identification) -> Table:
    """Draw the findings; a parameter that wasn't found is kept, and a note gives the reason."""
    caption = f"{found.duration:.1f} s of log"
    if (errors := found.held_out) is not None:
        caption += (
            f"; wheel speeds on the {errors.share:.0%} that the fit didn't see: "
            f"{errors.after:.3f} rad/s RMS, where the noise is {errors.noise:.3f}; "
            f"{errors.before:.3f} as configured before\nthe model {found.verdict}"
        )

    table = Table(title="acsar-gym identify", title_justify="left", caption=caption)
    table.caption_justify = "left"
    for column in ("parameter", "wheel", "value", "95 % interval", "before", "note"):
        table.add_column(column, overflow="fold")

    for finding in found.findings:
        factor, unit = SHOWN_UNITS[finding.name]
        value = "none" if finding.told else "kept"
        interval = ""
        if finding.value is not None and finding.value != NO_RAMP:
            value = f"{_format_number(finding.value, factor)} {unit}".strip()
            ends = (_format_number(end, factor) for end in (finding.low, finding.high))
            interval = " to ".join(ends)
        wheel = finding.wheel or ("all" if finding.name.startswith("motor.") else "")
        cells = (value, interval, _format_number(finding.before, factor), finding.note)
        table.add_row(finding.name, wheel, *cells)
    return table


def _format_number(value: float | None, factor: float) -> str:
    if value is None:
        return "none"
    scaled = value * factor
    return f"{scaled:.1f}" if abs(scaled) >= 100.0 else f"{scaled:.3g}"
