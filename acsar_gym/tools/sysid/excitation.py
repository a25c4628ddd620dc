"""The manoeuvre of an identification: random steps, a staircase through zero, and a pause."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from acsar_gym import kinematics
from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError
from acsar_gym.links.base import Link, LinkWrapper
from acsar_gym.recording import Recorder
from acsar_gym.recording.types import Floats, WireLog
from acsar_gym.robot import Robot
from acsar_gym.worlds import Scene

FASTEST_STEP = 10.0
"""Largest speed of the steps [rad/s]."""
SLOWEST_STEP = 2.0
"""Smallest speed of the steps [rad/s]."""
STEP_HOLD = (0.2, 0.7)
"""Shortest and longest duration of a step [s]."""
STAIRCASE_TOP = 1.5
"""Top of the staircase [rad/s]. A larger deadband isn't found."""
STAIRCASE_EXPONENT = 1.5
"""Exponent of the staircase, which lingers at the speeds of small deadbands."""
STAIRCASE_STARTS = np.array([0.0, 0.5, 0.25, 0.75])
"""Place in the staircase at which each wheel starts, as a share of it."""
PAUSE_SPEED = 6.0
"""Wheel speed before the pause [rad/s]."""
BEFORE_PAUSE_TIME = 1.2
"""Duration of that speed [s]."""
LONGEST_PAUSE = 2.3
"""Longest time without commands [s]."""
EXCITATION_SHARES = (0.35, 0.40)
"""Parts of the manoeuvre, less pause, that the first steps and the staircase take."""
TICK_STRETCH = 1.013
"""Factor on a tick, so that its phase to the board's loops and lines takes every value."""
STANDING_SPEED = 0.1
"""A wheel below this is at rest [rad/s]."""
STANDING_TIME = 0.2
"""The pause ends when all wheels have been at rest for this long [s]."""
SHORTEST_EXCITATION = 12.0
LONGEST_EXCITATION = 600.0
"""Limits of the duration [s]. Steps, staircase and pause together need 12 s."""


class ExcitationPlan(NamedTuple):
    """Wheel speeds for each tick before and after the pause, (n, 4) [rad/s]."""

    first: Floats
    last: Floats
    pause: int
    """Ticks without commands, at most."""


def plan_excitation(
    config: RobotConfig, duration: float, period: float, *, sides: bool = False
) -> ExcitationPlan:
    """Make the commands of a manoeuvre, which differ for each wheel, or only for each side."""
    # The same manoeuvre each time, so that drives can be compared.
    rng = np.random.default_rng(0)
    top = min(FASTEST_STEP, config.max_wheel_speed, config.max_linear / config.wheel_radius)

    # Jumps show lag, ramp and delay, the staircase the deadband, and the pause the time-out.
    moving = duration - LONGEST_PAUSE - BEFORE_PAUSE_TIME
    first, slow = (round(share * moving / period) for share in EXCITATION_SHARES)
    steps = _make_steps(first, top, period, rng)

    # A staircase that lingers near zero, then a constant speed until the pause.
    turn = (np.arange(slow)[:, None] / slow + STAIRCASE_STARTS) % 1.0
    triangle = 1.0 - np.abs((4.0 * turn + 1.0) % 4.0 - 2.0)
    rise = np.sign(triangle) * np.abs(triangle) ** STAIRCASE_EXPONENT
    constant = np.array([1.0, -1.0, 1.0, -1.0]) * min(PAUSE_SPEED, top)
    held = np.tile(constant, (round(BEFORE_PAUSE_TIME / period), 1))

    # Of a robot that takes twists, both wheels of a side get the same speed.
    wheels = [0, 1, 1, 0] if sides else [0, 1, 2, 3]
    return ExcitationPlan(
        np.concatenate((steps, -min(STAIRCASE_TOP, top) * rise, held))[:, wheels],
        _make_steps(round(moving / period) - first - slow, top, period, rng)[:, wheels],
        round(LONGEST_PAUSE / period),
    )


def _make_steps(ticks: int, top: float, period: float, rng: np.random.Generator) -> Floats:
    """Make speeds that jump at random times, independently for each wheel."""
    speeds = np.empty((ticks, 4))
    for wheel in range(4):
        tick = 0
        sign = 1.0
        while tick < ticks:
            # Steps of other lengths for each wheel tell the wheels apart.
            held = round(rng.uniform(*STEP_HOLD) / period)

            # Most steps change the direction, which shows a ramp best.
            sign = -sign if rng.random() < 0.7 else sign
            speed = sign * rng.uniform(min(SLOWEST_STEP, top / 2.0), top)
            speeds[tick : tick + held, wheel] = speed
            tick += held
    return speeds


class TapedLink(LinkWrapper):
    """Stretches the periods of a link, and keeps what its wire carried since the newest reset."""

    def __init__(self, link: Link) -> None:
        super().__init__(link)
        self._sent: list[tuple[float, bytes]] = []
        self._received: list[tuple[float, bytes]] = []

    def open(self) -> None:
        """Open the link, which notes from now on when bytes arrive."""
        super().open()
        _ = self.inner.arrivals

    def reset(self, scene: Scene) -> None:
        """Start an episode and its log."""
        super().reset(scene)
        self._sent.clear()
        self._received.clear()

    def write(self, data: bytes) -> None:
        """Send bytes."""
        super().write(data)
        self._sent.append((self.now(), data))

    def advance(self, period: float) -> bytes:
        """Let a stretched period pass, and return what arrived."""
        data = super().advance(period * TICK_STRETCH)

        # A link that doesn't note when bytes arrive has them at the end of the period.
        pieces = list(self.inner.arrivals)
        is_noted = b"".join(piece for _, piece in pieces) == data
        self._received += pieces if is_noted else [(self.now(), data)]
        return data

    @property
    def log(self) -> WireLog:
        """What the wire carried since the newest reset."""
        return WireLog.of(self._sent, self._received, stamped=self.inner.stamped)


def drive_excitation(
    link: Link, config: RobotConfig, duration: float, recorder: Recorder | None = None
) -> WireLog:
    """Drive the manoeuvre. The robot is stopped on any way out.

    Args:
        link: Link to the robot, whose wheels are lifted.
        config: Robot configuration.
        duration: Length of the manoeuvre [s].
        recorder: Recorder of the drive.

    Raises:
        ConfigError: The duration is out of range.
        LinkError: The robot can't be reached, fails, or was stopped.
    """
    if not SHORTEST_EXCITATION <= duration <= LONGEST_EXCITATION:
        limits = f"{SHORTEST_EXCITATION:g} to {LONGEST_EXCITATION:g} s"
        raise ConfigError(f"duration = {duration}: must be {limits}")

    # The wheels needn't turn as configured: how they turn is to be found.
    tape = TapedLink(link)
    with Robot(tape, config.with_(wheel_check=False), recorder=recorder) as robot:
        # A controller of ROS takes twists, of which both wheels of a side get the same speed.
        sides = link.commands_sides
        plan = plan_excitation(config, duration, config.period * TICK_STRETCH, sides=sides)
        geometry = (*config.wheel_radii, config.effective_separation)
        start = robot.link.now()

        def drive(speeds: Floats) -> None:
            for a, b, c, d in speeds.tolist():
                if sides:  # within the limits of acceleration, which are those of its controller
                    robot.drive(*kinematics.compute_twist(a, b, c, d, *geometry))
                else:
                    robot.tick((a, b, c, d))
                robot.safety.check(robot.link.now() - start)

        drive(plan.first)

        # Commands stop until the time-out has stopped all wheels.
        still = 0
        for _ in range(plan.pause):
            robot.listen()
            robot.safety.check(robot.link.now() - start)
            still = still + 1 if max(map(abs, robot.speeds)) < STANDING_SPEED else 0
            if still * config.period > STANDING_TIME:
                break
        drive(plan.last)
        robot.stop()
    return tape.log
