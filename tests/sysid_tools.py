"""Robots with hidden parameters: how well they are identified."""

from __future__ import annotations

import hashlib
import math
import tempfile
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from boards import board

from acsar_gym import Robot, RobotConfig
from acsar_gym.links import open_link
from acsar_gym.links.base import Link, LinkWrapper
from acsar_gym.protocol import Speeds
from acsar_gym.recording import Recorder, read
from acsar_gym.recording.types import Episode, Floats, Recording, WireLog
from acsar_gym.tools.sysid.calibration import (
    CalibrationRun,
    Geometry,
    RunReading,
    read_protractor,
    read_tape,
)
from acsar_gym.tools.sysid.calibration_drive import RunPlan, drive_run, plan_straights, plan_turns
from acsar_gym.tools.sysid.excitation import TapedLink
from acsar_gym.tools.sysid.identify import Identification, ParameterFinding, identify_device
from acsar_gym.worlds import Scene

ACSAR = RobotConfig.preset("acsar")
TOLERANCES = {
    "motor.time_constant": 0.05,
    "motor.gain": 0.01,
    "motor.acceleration": 0.05,
    "motor.deadband": 0.05,
    "encoder.quantum": 0.05,
    "firmware.command_delay": 0.005,
    "firmware.command_timeout": 0.06,
}
"""Shares for lags, gains and ramps, otherwise absolute."""
RELATIVE = ("motor.time_constant", "motor.gain", "motor.acceleration")


def draw_motors(seed: int) -> RobotConfig:
    """Draw a robot whose motors and board are hidden."""
    rng = np.random.default_rng(seed)
    lag = rng.uniform(0.03, 0.3)
    lags = lag * rng.uniform(0.9, 1.1, 4) if rng.random() < 0.3 else np.full(4, lag)

    return ACSAR.with_(
        motor={
            "time_constant": tuple(lags.tolist()),
            "gain": tuple(rng.uniform(0.9, 1.1, 4).tolist()),
            "deadband": float(rng.uniform(0.0, 1.0)),
            "acceleration": float(rng.uniform(20.0, 120.0)),
        },
        firmware={
            "command_delay": float(rng.uniform(0.0, 0.04)),
            "feedback_rate": float(rng.uniform(20.0, 100.0)),
            "command_timeout": None if rng.random() < 0.2 else float(rng.uniform(0.2, 1.0)),
        },
        encoder={"quantum": float(rng.uniform(0.01, 0.12))},
    )


MISFITS: dict[str, tuple[float, float]] = {
    "backward-gain": (0.75, 0.92),
    "overshoot": (0.1, 0.4),
    "reversal-hold": (0.1, 0.3),
    "feedback-factor": (1.5, 2.0),
    "rpm": (30.0 / math.pi, 30.0 / math.pi),
    "top-speed": (5.0, 7.0),
}
"""Habits of boards that the model doesn't have, and from where to where they are drawn."""


def draw_misfit(seed: int) -> tuple[RobotConfig, tuple[str, ...]]:
    """Draw a board that the model doesn't describe: the robot, and its quirks."""
    rng = np.random.default_rng([seed, 1])
    name = tuple(MISFITS)[seed % len(MISFITS)]
    size = float(rng.uniform(*MISFITS[name]))
    hidden = draw_motors(seed)
    if name == "top-speed":
        return hidden.with_(motor={"max_speed": size}), ()
    return hidden, (f"{'feedback-factor' if name == 'rpm' else name}={size}",)


class Score(NamedTuple):
    """How well a finding of a wheel or of the board agrees with the truth."""

    name: str
    is_told: bool
    error: float
    """Share of the tolerance."""
    holds: bool
    """Whether the interval holds the truth."""
    text: str


def score_findings(result: Identification, truth: RobotConfig) -> list[Score]:
    """Compare findings with a hidden robot: each wheel and the board."""
    scores = []
    for finding in result.findings:
        section, field = finding.name.split(".")
        parts = [getattr(truth, section)]
        if section == "motor":
            wheels = ["abcd".index(finding.wheel)] if finding.wheel else range(4)
            parts = [truth.motor.of_wheel(wheel) for wheel in wheels]
        scores += [_score_finding(finding, getattr(fields, field)) for fields in parts]
    return scores


def _score_finding(finding: ParameterFinding, value: float | None) -> Score:
    holds = value is finding.value and finding.told
    error = 0.0 if holds else math.inf
    if value is not None and finding.value is not None:
        scale = TOLERANCES.get(finding.name, 1.0) * (value if finding.name in RELATIVE else 1.0)
        error = abs(finding.value - value) / scale
        low = math.inf if finding.low is None else finding.low
        holds = low <= value <= (finding.high or 0.0)
    text = f"{finding.name}.{finding.wheel} {finding.low} to {finding.high}, truth {value}"
    return Score(finding.name, finding.told, error, holds, text)


def find_missed_truths(result: Identification, truth: RobotConfig) -> list[str]:
    """List the findings whose intervals don't hold the truth."""
    return [s.text for s in score_findings(result, truth) if s.is_told and not s.holds]


def identify_simulated(hidden: RobotConfig, *quirks: str) -> Identification:
    """Identify a robot with these quirks in simulated time."""
    return identify_device(board(*quirks, robot=hidden), ACSAR, 20.0)


def drive_wire(speeds: Callable[[float], Any], true: RobotConfig, seconds: float) -> WireLog:
    """The wire while a robot is driven that isn't the configured robot.

    `speeds`: of a time, those of all wheels or of each [rad/s].
    """
    tape = TapedLink(open_link("planar", true))
    with Robot(tape, ACSAR.with_(wheel_check=False)) as robot:
        for tick in range(round(seconds / ACSAR.period)):
            robot.tick(np.broadcast_to(speeds(tick * ACSAR.period), 4).tolist())
    return tape.log


TAPE_DIVISION = 0.005
SEPARATION = 0.3
"""Of the wheels, as the preset has it [m]."""


def draw_wheels(seed: int) -> RobotConfig:
    """A robot whose multiplier is 1.2 to 2.2, and whose radii are off by up to 3 % a side."""
    rng = np.random.default_rng(seed)
    multipliers = rng.uniform(0.97, 1.03, 2).tolist()
    return ACSAR.with_(
        left_wheel_radius_multiplier=multipliers[0],
        right_wheel_radius_multiplier=multipliers[1],
        body={"turn_factor": float(rng.uniform(1.2, 2.2))},
    )


def read_as_person(run: CalibrationRun) -> CalibrationRun:
    """Read a run with a tape with marks every 5 mm and a protractor with marks every degree."""

    def read(truth: RunReading) -> RunReading:
        if truth.kind == "heading":
            return read_protractor(float(round(math.degrees(truth.value))))
        return read_tape(truth.kind, round(truth.value / TAPE_DIVISION) * TAPE_DIVISION)

    kinds = ("heading",) if run.manoeuvre == "turn" else ("distance", "aside")
    return replace(
        run, readings=tuple(read(truth) for truth in run.readings if truth.kind in kinds)
    )


def usual_plans() -> list[RunPlan]:
    """What `straight` and `turn` drive by default."""
    return [*plan_straights(2.0, 0.3, 3), *plan_turns(5.0, (0.6, 1.2), (0.0,), 1)]


def drive_with_truth(
    plans: Sequence[RunPlan], twin: RobotConfig, config: RobotConfig = ACSAR, link: str = "planar"
) -> list[CalibrationRun]:
    """Drive a simulated robot that isn't as configured. The truth measures."""
    robot = Robot(open_link(link, twin), config)
    return [drive_run(robot, replace(plan, back=False), reads_truth=True) for plan in plans]


def leg_wheels(left: float, right: float) -> Floats:
    """Wheel angles of a leg that ends with these of the left and the right wheels [rad]."""
    return np.linspace((0.0, 0.0), (left, right), 101)


def line_wheels(geometry: Geometry, distance: float) -> Floats:
    """Wheel angles of a straight command of the robot that odometry takes it for."""
    return leg_wheels(distance / geometry.radius, distance / geometry.radius)


def spin_wheels(geometry: Geometry, angle: float) -> Floats:
    """Wheel angles of a turn in place."""
    turned = angle * SEPARATION * geometry.multiplier / 2.0 / geometry.radius
    return leg_wheels(-turned, turned)


def circle_wheels(geometry: Geometry, radius: float, angle: float) -> Floats:
    """Wheel angles of a circle that the centre drives, to the left where the angle is positive."""
    way = radius * abs(angle)
    turned = angle * SEPARATION * geometry.multiplier / 2.0
    return leg_wheels((way - turned) / geometry.radius, (way + turned) / geometry.radius)


TAPES = tempfile.TemporaryDirectory()
"""Recordings of `driven`, whose tables are read when they are needed."""
HIDDEN: dict[str, Any] = {"motor": {"time_constant": 0.14}, "body": {"friction": 0.7}}
"""Changes that make a robot whose default twin is wrong."""


class Phased(LinkWrapper):
    """A simulated robot whose board started some time before its first stamp.

    Args:
        link: Simulated link.
        phase: That time [s].
    """

    def __init__(self, link: Link, phase: float) -> None:
        super().__init__(link)
        self._phase = phase

    def reset(self, scene: Scene) -> None:
        self.inner.reset(scene)
        if self._phase:
            self.inner.advance(self._phase)


def random_steps(seed: int, duration: float, config: RobotConfig) -> list[Speeds]:
    """Wheel speeds for each tick: a new straight line or turn every 0.3 to 0.9 s, or a stop."""
    rng = np.random.default_rng(seed)
    ticks: list[Speeds] = []
    while len(ticks) < duration * config.control_rate:
        right_speed, left_speed = rng.uniform(-9.0, 9.0, 2) if rng.random() < 0.75 else (0.0, 0.0)
        ticks += [(right_speed, left_speed, left_speed, right_speed)] * int(
            rng.uniform(0.3, 0.9) * config.control_rate
        )
    return ticks[: int(duration * config.control_rate)]


def driven(config: RobotConfig, ticks: Iterable[Speeds], *, phase: float = 0.0) -> Episode:
    """Drive a twin of `config` open-loop, and return the episode."""
    link = Phased(open_link("planar", config), phase)
    tape = Path(tempfile.mkdtemp(dir=TAPES.name), "driven.mcap")
    with Robot(link, config, recorder=Recorder(tape)) as robot:
        for command in ticks:
            robot.tick(command)
    (episode,) = read(tape).episodes
    return episode


def recording(config: RobotConfig, *episodes: Episode, name: str = "") -> Recording:
    """Make a recording, whose hash is that of `name`."""
    sha256 = hashlib.sha256(name.encode()).hexdigest()[:16]
    return Recording(header={}, sha256=sha256, config=config, episodes=episodes)
