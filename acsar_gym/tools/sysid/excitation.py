"""The manoeuvre of an identification: random steps, a staircase through zero, and a pause."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from acsar_gym import kinematics
from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError
from acsar_gym.links.base import Link, LinkWrapper
from acsar_gym.recording import Recorder
from acsar_gym.recording.recorded import RecordedLink
from acsar_gym.recording.types import WireLog
from acsar_gym.robot import Robot
from acsar_gym.tools.sysid.board_log import Floats
from acsar_gym.tools.sysid.wire_tape import WireTape

FASTEST_STEP = 10.0
"""Largest speed of the steps [rad/s]."""
SLOWEST_STEP = 2.0
"""Smallest speed of the steps [rad/s]."""
STEP_HOLD = (0.2, 0.7)
"""How long a step is held [s]."""
STAIRCASE_TOP = 1.5
"""Top of the staircase [rad/s]; a larger deadband isn't found."""
STAIRCASE_EXPONENT = 1.5
"""Exponent of the staircase, which lingers where small deadbands are."""
STAIRCASE_STARTS = np.array([0.0, 0.5, 0.25, 0.75])
"""Where in its staircase each wheel starts, as a part of it."""
PAUSE_SPEED = 6.0
"""Wheel speed before the pause [rad/s]."""
BEFORE_PAUSE_TIME = 1.2
"""How long that speed is held [s]."""
LONGEST_PAUSE = 2.3
"""How long commands stop at most [s]."""
EXCITATION_SHARES = (0.35, 0.40)
"""Parts of the manoeuvre, less pause, that the first steps and the staircase take."""
TICK_STRETCH = 1.013
"""Factor on a tick: its phase to the board's loops and lines then takes every value."""
STANDING_SPEED = 0.1
"""A wheel below this stands [rad/s]."""
STANDING_TIME = 0.2
"""The pause ends when all wheels have stood this long [s]."""
SHORTEST_EXCITATION = 12.0
LONGEST_EXCITATION = 600.0
"""Limits of the manoeuvre's duration [s]."""


class ExcitationPlan(NamedTuple):
    """Wheel speeds for each tick before and after the pause, (n, 4) [rad/s]."""

    before: Floats
    after: Floats
    pause: int
    """Ticks without commands, at most."""


def plan_excitation(
    config: RobotConfig, duration: float, period: float, *, sides: bool = False
) -> ExcitationPlan:
    """Make the commands of a manoeuvre, different ones for each wheel, or for each side alone."""
    rng = np.random.default_rng(0)
    top = min(FASTEST_STEP, config.max_wheel_speed, config.max_linear / config.wheel_radius)
    moving = duration - LONGEST_PAUSE - BEFORE_PAUSE_TIME
    first, slow = (round(share * moving / period) for share in EXCITATION_SHARES)
    steps = _make_steps(first, top, period, rng)

    # A staircase that lingers near zero, then a constant speed until the pause.
    turn = (np.arange(slow)[:, None] / slow + STAIRCASE_STARTS) % 1.0
    triangle = 1.0 - np.abs((4.0 * turn + 1.0) % 4.0 - 2.0)
    rise = np.sign(triangle) * np.abs(triangle) ** STAIRCASE_EXPONENT
    constant = np.array([1.0, -1.0, 1.0, -1.0]) * min(PAUSE_SPEED, top)
    held = np.tile(constant, (round(BEFORE_PAUSE_TIME / period), 1))

    wheels = [0, 1, 1, 0] if sides else [0, 1, 2, 3]
    return ExcitationPlan(
        np.concatenate((steps, -min(STAIRCASE_TOP, top) * rise, held))[:, wheels],
        _make_steps(round(moving / period) - first - slow, top, period, rng)[:, wheels],
        round(LONGEST_PAUSE / period),
    )


def _make_steps(ticks: int, top: float, period: float, rng: np.random.Generator) -> Floats:
    """Speeds that jump at random times, independently for each wheel."""
    speeds = np.empty((ticks, 4))
    for wheel in range(4):
        tick = 0
        sign = 1.0
        while tick < ticks:
            held = round(rng.uniform(*STEP_HOLD) / period)
            sign = -sign if rng.random() < 0.7 else sign
            speed = sign * rng.uniform(min(SLOWEST_STEP, top / 2.0), top)
            speeds[tick : tick + held, wheel] = speed
            tick += held
    return speeds


class StretchedLink(LinkWrapper):
    """Stretches the periods of a link, so that commands come at every phase of a board's loops."""

    def advance(self, period: float) -> bytes:
        """Let a stretched period pass; returns what arrived."""
        return super().advance(period * TICK_STRETCH)


def drive_excitation(
    link: Link,
    config: RobotConfig,
    duration: float,
    recorder: Recorder | None = None,
) -> WireLog:
    """Drive the manoeuvre; the robot is stopped on any way out.

    Args:
        link: Link to the robot, whose wheels are lifted.
        config: Robot configuration.
        duration: Length of the manoeuvre [s].
        recorder: Recorder of the drive.

    Raises:
        ConfigError: the duration is out of range.
        LinkError: the robot can't be reached, fails, or was stopped.
    """
    if not SHORTEST_EXCITATION <= duration <= LONGEST_EXCITATION:
        limits = f"{SHORTEST_EXCITATION:g} to {LONGEST_EXCITATION:g} s"
        raise ConfigError(f"duration = {duration}: must be {limits}")

    # The wheels don't answer as configured: that is what is to be found.
    tape = WireTape()
    taped = RecordedLink(StretchedLink(link), tape, config)
    with Robot(taped, config.with_(wheel_check=False), recorder=recorder) as robot:
        sides = link.commands_sides
        plan = plan_excitation(config, duration, config.period * TICK_STRETCH, sides=sides)
        start = taped.now()

        def drive(speeds: list[float]) -> None:
            if sides:  # within the limits of acceleration, which are those of its controller
                a, b, c, d = speeds
                geometry = (*config.wheel_radii, config.effective_separation)
                robot.drive(*kinematics.compute_twist(a, b, c, d, *geometry))
            else:
                robot.tick(speeds)
            robot.safety.check(taped.now() - start)

        for speeds in plan.before.tolist():
            drive(speeds)
        still = 0
        for _ in range(plan.pause):
            robot.listen()
            robot.safety.check(taped.now() - start)
            still = still + 1 if max(map(abs, robot.speeds)) < STANDING_SPEED else 0
            if still * config.period > STANDING_TIME:
                break
        for speeds in plan.after.tolist():
            drive(speeds)
        robot.stop()
    return tape.log
