"""The job `identify`: from logs to findings, a validated fit, a table and a robot's file."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.table import Column, Table

from acsar_gym.config import Measured, RobotConfig, update_measured
from acsar_gym.config.robot import MISFIT
from acsar_gym.config.sections import EncoderConfig
from acsar_gym.errors import AcsarError, ConfigError
from acsar_gym.links import Link
from acsar_gym.protocol import MOTORS, PRINTED_STEP, WHEELS
from acsar_gym.recording import Recorder
from acsar_gym.recording.reader import read
from acsar_gym.recording.types import Floats, WireLog
from acsar_gym.tools.sysid import board_log
from acsar_gym.tools.sysid.board import HIGHEST_RATIO, LOWEST_RATIO, likely_units, measure_rate
from acsar_gym.tools.sysid.board_log import BoardTrack, Estimate
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
    fit_tracks,
)
from acsar_gym.tools.sysid.tracks import check_same_robot

SHORTEST_LOG = 5.0
"""Shortest log of which a part can be held out [s]."""
NORMAL_QUANTILE = 1.96
INTERVAL_FACTOR = 2.5
"""Factor on intervals, so that those of four wheels hold together in 19 of 20 simulated robots. The
twin's answer is a mean over phases."""
CLEARLY_NARROWER = 0.3
"""A parameter is found if its interval is at most this share of its prior's."""
LEAST_DEADBAND = 0.15
"""Below this speed, wheels of boards that compute in integers are at rest [rad/s]."""
NO_RAMP = 1e6
"""Acceleration of a board without a ramp [rad/s^2]: the largest of the field."""
LONG_PAUSE = 2.0
"""A board whose wheels turn for this long without commands has no time-out [s]."""
LEAST_TIME = 1e-3
"""Lower end of intervals of times that can't be 0 [s]."""
GAP_NOISE = 0.1
"""Difference of wheel speeds if a drive is repeated, RMS [rad/s]. `gap` can't see less.

The same commands, with other phases of the board's clocks: 0.04 to 0.06, 0.1 at most (median and
maximum of 45 pairs of a drive, for simulated robots and for a board that computes in integers)."""
NOISES = 2.0
"""A model fits if its held-out error is at most this many times the noise, or `GAP_NOISE` if that
is larger."""
DAMAGED_SHARE = 0.03
"""Share of lines, the worst, that may be damaged and don't count."""
FEWEST_LINES = 20
SHORTEST_RATE_LOG = 1.0
"""Fewer lines, or a shorter log [s], show no rate: a few lines may all be early or late."""
LEAST_RATE_SHARE = 0.002
"""Half width of the rate's interval, as a share: clocks differ by that much."""
SAME_WINDOW = 0.02
"""Averaging times that differ by less than this are nearly the same for a drive [s]."""
SAME_STEP = 0.01
"""Steps of printed speeds that differ by less than this share are the same."""
COUNT_SHARE = 0.1
"""Encoder counts that are coarser than the printed step become this share of it."""
DELAY_QUANTILES = np.linspace(0.05, 0.95, 10)
"""Quantiles of the delays of single steps."""
INFORMATIVE_SHARE = 0.2
"""A block shows a delay if it has this share of the median block's information."""
NEVER_TURNED = "this wheel never turned"
RATE_NAME = "firmware.feedback_rate"
QUANTUM_NAME = "encoder.quantum"
SHOWN_UNITS = {
    "motor.time_constant": "ms",
    "motor.gain": "",
    "motor.acceleration": "rad/s^2",
    "motor.deadband": "rad/s",
    "firmware.command_delay": "ms",
    "firmware.command_timeout": "ms",
    RATE_NAME: "Hz",
    "encoder.window": "ms",
    QUANTUM_NAME: "rad/s",
}
"""Unit in which each parameter is shown."""


@dataclass(frozen=True)
class ParameterFinding:
    """A parameter of a wheel or of the board.

    Attributes:
        name: Field of the robot's file, such as "motor.gain".
        wheel: Letter of the wheel, "a" to "d". "" for all.
        value: Value in the field's unit. None if it isn't known, or if there is none.
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
        """Return a copy with a value and its interval."""
        return replace(self, **estimate._asdict(), note=note, told=True)


class HeldOutErrors(NamedTuple):
    """Error of the wheel speeds on the part of the log that the fit didn't see, RMS [rad/s]."""

    before: float
    """Error of the robot as configured, for the wheel that fits worst then."""
    after: float
    """Error of the robot as fitted, for the wheel that fits worst."""
    noise: float
    """Expected error of that wheel's lines if the model is right."""
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
        config: Robot as it was configured.
        findings: Findings, one for each parameter. The last is the step of printed speeds.
        held_out: Validation. None if nothing was fitted.
        delays: Quantiles of delays of single steps, on top of the fitted delay [s].
        duration: Length of the logs [s].
        logs: Hashes of the logs.
        dead: Names of the wheels that never turned.
    """

    config: RobotConfig
    findings: tuple[ParameterFinding, ...]
    held_out: HeldOutErrors | None
    delays: tuple[float, ...]
    duration: float
    logs: tuple[str, ...] = ()
    dead: tuple[str, ...] = ()

    @property
    def misfit(self) -> str:
        """In which way the model doesn't describe the board. Empty if it does."""
        # A gain that is far off is a wrong unit, whatever the error is.
        for finding in self.findings:
            ratio = 1.0
            if finding.name == "motor.gain" and finding.value and finding.before:
                ratio = finding.value / finding.before
            if not LOWEST_RATIO <= ratio <= HIGHEST_RATIO:
                wheels = f"wheel {finding.wheel}" if finding.wheel else "every wheel"
                units = likely_units(ratio, self.config)
                return f"{wheels} reports {ratio:.2f} times the expected speed: {units}"
        if self.held_out is None or self.held_out.fits:
            return ""
        missed = f"wheel speeds are missed by {self.held_out.after:.2f} rad/s RMS"
        return f"{missed}, where the noise is {self.held_out.noise:.2f}"

    @property
    def verdict(self) -> str:
        """Whether the model fits, as the robot's file states it."""
        return MISFIT + self.misfit if self.misfit else "fits"

    def check(self, *, anyway: bool = False) -> None:
        """Check that this is worth a robot's file.

        Raises:
            AcsarError: It isn't. The message gives the reason.
        """
        # The most useful reason comes first.
        if len(self.dead) == len(WHEELS):
            raise AcsarError(
                "nothing to write: no wheel turned; check the motors' power and every encoder, "
                "with 'acsar-gym doctor DEVICE --spin' ('acsar-gym doctor ros2')"
            )

        if not any(finding.told and finding.name != RATE_NAME for finding in self.findings):
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
        """Make the robot with what was found. Other fields stay as they were.

        If the model doesn't fit, values have no intervals, and the robot's file states the misfit.

        Raises:
            ConfigError: A finding contradicts another field, which the message names.
        """
        # Values go to their fields, and their intervals to `measured`.
        changes: dict[str, Any] = {"motor": {}, "firmware": {}, "encoder": {}}
        measured: dict[str, Measured | None] = {}
        for finding in self.findings:
            if not finding.told:
                continue
            name = finding.name
            section, field = name.split(".")
            value, low, high = map(_round_digits, (finding.value, finding.low, finding.high))
            if finding.wheel:
                name += f".{finding.wheel}"
                four = [getattr(self.config.motor.of_wheel(wheel), field) for wheel in range(4)]
                changes[section].setdefault(field, four)[MOTORS.index(finding.wheel)] = value
            else:
                changes[section][field] = value

            measured[name] = None
            if low is not None and high is not None and not self.misfit:
                interval = Measured(low=low, high=high, method="identify", logs=self.logs)
                measured[name] = interval

        # Encoder counts that are coarser than the printed numbers would blur the twin's.
        encoder = self.config.encoder.model_copy(update=changes["encoder"])
        quantum = self.findings[-1].value
        if self.held_out and quantum and _count_speed(encoder) >= 2.0 * quantum:
            counts = math.ceil(2.0 * math.pi / (COUNT_SHARE * quantum * encoder.window))
            changes["encoder"]["counts_per_revolution"] = min(counts, 10_000_000)
            measured["encoder.counts_per_revolution"] = None
        if self.delays:
            changes["firmware"]["delay_samples"] = self.delays
        if self.held_out:
            changes |= {"motor_fit": self.verdict, "motor_fit_logs": self.logs}
        return self.config.with_(
            **changes, measured=update_measured(self.config.measured, measured)
        )

    def as_dict(self) -> dict[str, Any]:
        """Format for JSON."""
        model = None
        if self.held_out:
            model = {
                "verdict": self.verdict,
                "pattern": self.misfit,
                "error": self.held_out.after,
                "noise": self.held_out.noise,
            }

        return {
            "findings": [asdict(finding) for finding in self.findings],
            "held_out": self.held_out._asdict() if self.held_out else None,
            "model": model,
            "delays": list(self.delays),
            "duration": self.duration,
            "logs": list(self.logs),
        }


def identify_files(paths: Sequence[Path], config: RobotConfig | None) -> Identification:
    """Identify a robot from recordings.

    Args:
        paths: Recordings of a robot.
        config: Robot configuration. None takes that of the first recording.

    Raises:
        ConfigError: A file can't be read, or they are of different robots.
    """
    # Logs of two robots would be averaged.
    recordings = [(str(path), read(path)) for path in paths]
    check_same_robot(recordings, "identify")
    robot = config or recordings[0][1].config
    logs = [
        board_log.resend_twists(episode.wire, recording.config, robot)
        for _, recording in recordings
        for episode in recording.episodes
    ]

    # `gap` recognizes the logs that a robot was fitted to by these.
    hashes = [digest for _, recording in recordings for digest in sorted(recording.sources)]
    return identify_logs(logs, robot, hashes)


def identify_device(
    link: Link, config: RobotConfig, duration: float, recorder: Recorder | None = None
) -> Identification:
    """Drive the manoeuvre, and identify the robot from it. Errors as for `drive_excitation`."""
    log = drive_excitation(link, config, duration, recorder)
    if recorder is not None and recorder.path is not None and not recorder.problem:
        return identify_logs([log], config, [read(recorder.path).sha256])

    # A drive without a recording has a hash as well, as the source of the robot's intervals.
    content = b"".join((log.sent_stamps.tobytes(), log.got_stamps.tobytes(), *log.sent, *log.got))
    return identify_logs([log], config, [hashlib.sha256(content).hexdigest()[:16]])


def identify_logs(
    logs: Sequence[WireLog], config: RobotConfig, hashes: Sequence[str] = ()
) -> Identification:
    """Identify the board and motors of a robot from what its wire carried.

    Args:
        logs: Logs of the wire, one for each episode.
        config: Robot configuration. Fields that the logs don't show stay as they are.
        hashes: Hashes of the logs' files, for the robot's file.

    Raises:
        ConfigError: The logs contain no commands, or no feedback.
        AcsarError: A wheel doesn't answer its own command.
    """
    tracks = board_log.decode_tracks(logs, config)
    if not tracks:
        raise ConfigError("the log holds no commands, or no feedback to them: nothing to identify")
    duration = sum(track.duration for track in tracks)
    speeds = np.concatenate([track.speeds for track in tracks])

    # Coarse numbers, and wheels that never turned, must be known before the fit.
    quantum = board_log.find_quantum(speeds)
    turning = np.flatnonzero(np.abs(speeds).max(axis=0) > board_log.TURNING_SPEED / 2.0).tolist()

    fit = None
    missing = f"{duration:.1f} s of log: needs {SHORTEST_LOG:g} s or more"
    if duration >= SHORTEST_LOG:
        missing = ""
        if turning:
            fit = fit_tracks(tracks, turning, config, quantum.value if quantum else 0.0)
    times = _find_times(fit, config, missing)
    return Identification(
        config=config,
        findings=(
            *_find_wheels(fit, config, turning, missing),
            *times,
            _find_rate(tracks, config),
            _find_quantum(quantum, config),
        ),
        held_out=_validate(fit) if fit else None,
        delays=sample_delays(fit) if fit and times[0].told else (),
        duration=duration,
        logs=tuple(hashes),
        dead=tuple(name for wheel, name in enumerate(WHEELS) if wheel not in turning),
    )


def _validate(fit: MotorFit) -> HeldOutErrors | None:
    """Compare the error on the held-out lines with the noise. None without such lines."""
    held_out = fit.problem.held_out
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

    # The same lines with the robot as it was configured.
    configured = fit.problem.residuals(fit.problem.configured)[:, held_out]
    return HeldOutErrors(
        before=float(_rms(configured).max()),
        after=float(errors[worst]),
        noise=float(noises[worst]),
        share=float(np.mean(held_out)),
    )


def _rms(rows: Floats) -> Floats:
    return np.asarray(np.sqrt(np.mean(rows**2, axis=1)))


def estimate_noise(fit: MotorFit) -> Floats:
    """Estimate the noise of lines: their scatter, and the effect of a loop's phase.

    Returns:
        Standard deviations [rad/s], (wheels, lines).
    """
    # A command counts from the next loop of the board on, at an unknown phase.
    blur = fit.jacobian[:, :, DELAY] * fit.problem.responder.dt
    jumps = np.median(np.abs(np.diff(fit.residuals, axis=1)), axis=1, keepdims=True)

    # Neighbouring lines have the same systematic error, so their difference is the scatter.
    scatter = NORMAL_MEDIAN / math.sqrt(2.0) * jumps
    rounding = max(fit.problem.responder.rounding.step, PRINTED_STEP) / math.sqrt(12.0)
    return np.asarray(np.hypot(blur, np.maximum(scatter, rounding)))


def _estimate(fit: MotorFit, place: int) -> Estimate | None:
    """Return a fitted number, or its logarithm. None if the log doesn't narrow its interval."""
    row = fit.problem.rows[place]
    value = float(fit.x[place])
    sigma = math.sqrt(float(fit.spread[place, place]))
    half = max(row.resolution, NORMAL_QUANTILE * INTERVAL_FACTOR * sigma) + float(fit.slack[place])
    low = value - half
    high = value + half

    # Slow wheels of coarse boards report zero, whether a deadband stops them or not.
    coarse = max(fit.problem.responder.rounding.step, LEAST_DEADBAND)
    if row.name == "motor.deadband" and value < coarse:
        low = 0.0  # slower wheels report zero, with or without a deadband
        high = max(high, coarse)
    is_narrow = high - low <= 2.0 * CLEARLY_NARROWER * NORMAL_QUANTILE * row.deviation
    return Estimate(value, low, high) if is_narrow and row.from_fit(value) < row.bounds[1] else None


def _find_wheels(
    fit: MotorFit | None, config: RobotConfig, turning: Sequence[int], missing: str
) -> Iterator[ParameterFinding]:
    """Yield findings of the four motors, or a common finding if the wheels' intervals agree."""
    for column, row in enumerate(WHEEL_PARAMETERS):
        places = range(column, len(turning) * len(WHEEL_PARAMETERS), len(WHEEL_PARAMETERS))
        estimates = {
            wheel: estimate
            for wheel, place in zip(turning, places, strict=True)
            if fit and (estimate := _estimate(fit, place))
        }
        # Wheels that can't be told apart get the same number.
        if len(estimates) == len(WHEELS):
            estimates = merge_wheels(estimates)

        four = []
        for wheel, letter in enumerate(MOTORS):
            motor = config.motor.of_wheel(wheel)
            configured = float(getattr(motor, row.name.removeprefix("motor.")))
            note = (missing or row.missing_note) if wheel in turning else NEVER_TURNED
            finding = ParameterFinding(row.name, letter, before=configured, note=note)
            if wheel in estimates:
                finding = _tell_wheel(finding, row, estimates[wheel])
            four.append(finding)
        are_alike = len({replace(finding, wheel="") for finding in four}) == 1
        yield from [replace(four[0], wheel="")] if are_alike else four


def merge_wheels(estimates: dict[int, Estimate]) -> dict[int, Estimate]:
    """Return the wheels' mean, weighted by precision, for all of them if all intervals hold it."""
    values, lows, highs = np.array(list(estimates.values())).T
    mean = float(np.average(values, weights=(highs - lows) ** -2.0))
    if not ((lows <= mean) & (mean <= highs)).all():
        return estimates
    return dict.fromkeys(estimates, Estimate(mean, float(lows.min()), float(highs.max())))


def _tell_wheel(finding: ParameterFinding, row: Parameter, estimate: Estimate) -> ParameterFinding:
    """Turn an estimate into the robot file's value: of a ramp, the acceleration."""
    value, low, high = map(row.from_fit, estimate)
    if row.name != "motor.acceleration":
        return finding.tell(Estimate(value, max(0.0, low), high))

    # The fitted number is the time for 1 rad/s. If it may be zero, there may be no ramp.
    fastest = 1.0 / high
    if low < row.resolution:
        note = f"no ramp, or one faster than {fastest:.0f} rad/s^2"
        return finding.tell(Estimate(NO_RAMP, fastest, NO_RAMP), note)
    return finding.tell(Estimate(1.0 / value, fastest, 1.0 / low))


def _find_times(fit: MotorFit | None, config: RobotConfig, missing: str) -> list[ParameterFinding]:
    """Find the board's delay, averaging time and time-out."""
    board = config.firmware
    averages = config.encoder.window
    configured = (board.command_delay, averages, board.command_timeout)
    delay, window, timeout = (
        ParameterFinding(row.name, before=value, note=missing or row.missing_note)
        for row, value in zip(BOARD_PARAMETERS, configured, strict=True)
    )
    if fit is None:
        return [delay, window, timeout]
    delayed, averaging, ended = (_estimate(fit, place) for place in (DELAY, WINDOW, TIMEOUT))
    fitted = fit.problem.split(fit.x)[1]
    dt = fit.problem.responder.dt

    # The twin averages over whole loops, and as configured if that is hardly another time. If the
    # configured time can't be true, any is better.
    if averaging is None and fitted.delay + (fitted.window - averages) / 2.0 < -dt:
        widest = 2.0 * fitted.window + BOARD_PARAMETERS[WINDOW].resolution
        averaging = Estimate(fitted.window, 0.0, widest)
    if averaging:
        if abs(averages - fitted.window) > SAME_WINDOW:
            averages = max(1, round(fitted.window / dt)) * dt
        window = window.tell(Estimate(averages, max(LEAST_TIME, averaging.low), averaging.high))

    # What is best known is the delay to the middle of the window.
    if delayed:
        value = max(0.0, delayed.value + (fitted.window - averages) / 2.0)
        interval = (max(0.0, min(value, delayed.low)), max(value, delayed.high))
        in_ros = all(track.in_ros for track in fit.problem.tracks)
        note = "from publishing to the stamp that shows it" if in_ros else "on top of the wire"
        delay = delay.tell(Estimate(value, *interval), note)

    # A board looks once a loop whether its time-out has passed.
    longest = max(track.longest_pause for track in fit.problem.tracks)
    if fitted.timeout < longest - board_log.PAUSE_GAP / 2.0:
        if ended:
            timeout = timeout.tell(Estimate(*(max(LEAST_TIME, end - dt / 2.0) for end in ended)))
    elif longest >= LONG_PAUSE:
        note = f"none: the wheels kept turning for {longest:.1f} s without commands"
        timeout = replace(timeout, note=note, told=True)
    return [delay, window, timeout]


def _find_rate(tracks: Sequence[BoardTrack], config: RobotConfig) -> ParameterFinding:
    """Find the rate of the lines, as `doctor` measures it."""
    finding = ParameterFinding(RATE_NAME, before=config.feedback_rate)
    duration = sum(track.duration for track in tracks)
    if sum(len(track.stamps) for track in tracks) < FEWEST_LINES or duration < SHORTEST_RATE_LOG:
        return replace(finding, note="too few lines of feedback")

    # Long tracks count more.
    rates = [measure_rate(track.stamps.tolist(), track.numbers.tolist()) for track in tracks]
    rate = float(np.average(rates, weights=[len(track.stamps) for track in tracks]))
    if not 0.0 < rate <= config.firmware.loop_rate:
        return replace(finding, note=f"{rate:.0f} Hz, unlike any that a twin has")
    return finding.tell(Estimate.around(rate, LEAST_RATE_SHARE * rate))


def _find_quantum(quantum: Estimate | None, config: RobotConfig) -> ParameterFinding:
    """Find the step of the printed speeds."""
    finding = ParameterFinding(QUANTUM_NAME, before=config.encoder.quantum)
    if quantum is None:
        return replace(finding, note="too few different speeds: drive slowly and fast")
    note = "finer than the two decimals of a line show"
    if quantum.low > 0.0:
        if abs(quantum.value / _count_speed(config.encoder) - 1.0) > SAME_STEP:
            return finding.tell(quantum)
        note = "whole encoder counts, as configured"
    return replace(finding, **quantum._asdict(), note=note)


def _count_speed(encoder: EncoderConfig) -> float:
    """Return the speed of an encoder count in an averaging window [rad/s]."""
    return 2.0 * math.pi / (encoder.counts_per_revolution * encoder.window)


def sample_delays(fit: MotorFit) -> tuple[float, ...]:
    """Return quantiles of the delays of single steps, on top of the fitted delay [s], at least 0.

    The delay of a block of the log is the shift that explains its residuals best.
    """
    # An answer that is later changes a residual by its derivative by the delay.
    blocks = fit.problem.blocks()
    slopes = fit.jacobian[:, :, DELAY]
    information = np.bincount(blocks, (slopes**2).sum(axis=0))
    shifts = -np.bincount(blocks, (slopes * fit.residuals).sum(axis=0))

    # Blocks at constant speed show no delay.
    informed = information > INFORMATIVE_SHARE * np.median(information[information > 0.0])
    extra = np.quantile(shifts[informed] / information[informed], DELAY_QUANTILES)
    return tuple(round(float(delay), 5) for delay in np.maximum(0.0, extra))


def _round_digits(value: float | None) -> float | None:
    """Round to four significant digits, for a file."""
    return None if value is None else float(f"{value:.4g}")


def identification_table(identification: Identification) -> Table:
    """Draw the findings. A parameter that wasn't found is kept, and a note gives the reason."""
    caption = f"{identification.duration:.1f} s of log"
    if errors := identification.held_out:
        caption += (
            f"; wheel speeds on the {errors.share:.0%} that the fit didn't see: "
            f"{errors.after:.3f} rad/s RMS, where the noise is {errors.noise:.3f}; "
            f"{errors.before:.3f} as configured before\nthe model {identification.verdict}"
        )
    names = ("parameter", "wheel", "value", "95 % interval", "before", "note")
    table = Table(
        *(Column(name, overflow="fold") for name in names),
        title="acsar-gym identify",
        title_justify="left",
        caption=caption,
        caption_justify="left",
    )

    for finding in identification.findings:
        # Numbers have the unit of the table, not that of the file.
        unit = SHOWN_UNITS[finding.name]
        numbers = (finding.value, finding.low, finding.high, finding.before)
        value, low, high, configured = (_format_number(number, unit) for number in numbers)
        interval = f"{low} to {high}"
        value = f"{value} {unit}".strip()
        if finding.value is None or finding.value == NO_RAMP:
            value = "none" if finding.told else "kept"
            interval = ""
        wheel = finding.wheel or ("all" if finding.name.startswith("motor.") else "")
        table.add_row(finding.name, wheel, value, interval, *(configured, finding.note))
    return table


def _format_number(value: float | None, unit: str) -> str:
    if value is None:
        return "none"
    scaled = 1e3 * value if unit == "ms" else value
    return f"{scaled:.1f}" if abs(scaled) >= 100.0 else f"{scaled:.3g}"
