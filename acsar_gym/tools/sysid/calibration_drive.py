"""The runs of a calibration: planned within the free floor, driven closed-loop on odometry."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from acsar_gym.config import Geofence, RobotConfig
from acsar_gym.errors import ConfigError, LinkError
from acsar_gym.kinematics import compute_twist
from acsar_gym.recording import Recorder
from acsar_gym.robot import Robot
from acsar_gym.safety.rules import Reason
from acsar_gym.tools.sysid.calibration import CalibrationRun, RunReading, side_angles
from acsar_gym.worlds import Pose, Scene
from acsar_gym.worlds.search import footprint_radius
from acsar_gym.worlds.world import to_odometry

SPACE_SLACK = 0.25
"""How far a run may end from where odometry puts it, as a share of its extent, before the robot is
calibrated."""
SPACE_MARGIN = 0.1
"""Distance to be kept from the edge of the space [m]."""
SLOWER_SHARE = 0.07
"""How much slower the second and third of three runs are, as a share of the speed."""
BACKWARDS = ", backwards"
"""End of the name of a run that goes backward: people stand behind the robot."""
MOST_RUNS = 200
"""Most runs of one call."""
APPROACH_GAIN = 3.0
"""Speed for each metre, or turn rate for each radian, that is left [1/s]."""
SLOWEST_SHARE = 0.2
"""Smallest share of the full speed before the end."""
HEADING_GAIN = 2.0
"""Turn rate for each radian off the wanted heading [1/s]."""
RUN_TOLERANCE = 0.002
"""A run is braked this close to its end [m] or [rad]. The rest is rolled out and measured."""
AT_REST_SPEED = 0.1
"""Wheels below this are at rest [rad/s]."""
AT_REST_TIME = 1.0
"""A run ends where its wheels have been at rest for this long while it was braked [s]."""
RUN_TIMEOUT = 5.0
"""A run that takes this much longer than three times its nominal time has failed [s]."""
REST_TIME = 1.5
"""Time that the robot is at rest at the end of a run, to be measured [s]."""
TRUTH_METRES = 2e-4
"""Standard deviation of true positions [m]."""
TRUTH_RADIANS = 1e-3
"""Standard deviation of true headings [rad]."""


@dataclass(frozen=True, slots=True)
class RunPlan:
    """A run from standstill to standstill: a line, a circle, or a turn in place."""

    name: str
    manoeuvre: str
    """straight or turn."""
    distance: float
    """Length of the path of the robot's centre [m], not negative."""
    angle: float
    """Angle turned on the way [rad], counter-clockwise positive."""
    speed: float
    """Speed along the path [m/s], or of a turn in place [rad/s]."""
    back: bool = False
    """Whether it goes backward, so that the robot returns to the start of the run before."""

    def ahead(self) -> RunPlan:
        """Return the same run, but not backward."""
        return replace(self, name=self.name.removesuffix(BACKWARDS), back=False)


def plan_straights(distance: float, speed: float, repeats: int) -> list[RunPlan]:
    """Plan straight runs.

    Args:
        distance: Length of each run [m].
        speed: Speed of the first run [m/s]. The next ones are slower, so that roundings differ.
        repeats: Number of runs. Every second run goes backward, to the start of the one before.
    """
    _check_size("--distance", distance, largest=100.0, runs=repeats)
    plans = []
    for number in range(repeats):
        back = number % 2 == 1
        plan = RunPlan(
            name=f"straight {number + 1}{BACKWARDS if back else ''}",
            manoeuvre="straight",
            distance=distance,
            angle=0.0,
            speed=speed * (1.0 - SLOWER_SHARE * (number % 3)),
            back=back,
        )
        plans.append(plan)
    return plans


def plan_turns(
    turned: float, speeds: Sequence[float], radii: Sequence[float], repeats: int
) -> list[RunPlan]:
    """Plan turns in place and in circles: every radius with every speed, left, right, left...

    Args:
        turned: Full turns of each run.
        speeds: Turn rates [rad/s].
        radii: Radii of the circles that the robot's centre drives [m]. 0 turns in place.
        repeats: Number of runs of each kind.
    """
    _check_size("--turns", turned, largest=1000.0, runs=repeats)
    if not all(0.0 <= radius <= 100.0 for radius in radii):
        raise ConfigError(f"--radii {min(radii):g} to {max(radii):g}: must be 0 to 100 m")

    plans = []
    # Left and right alternate, so that errors of one direction cancel.
    pairs = list(itertools.product(radii, speeds)) * repeats
    for number, (radius, rate) in enumerate(pairs, start=1):
        angle = math.tau * (turned if number % 2 else -turned)
        circle = f", radius {radius:g} m" if radius else ""
        plan = RunPlan(
            name=f"turn {number}, {'left' if number % 2 else 'right'}, {rate:g} rad/s{circle}",
            manoeuvre="turn",
            distance=radius * abs(angle),
            angle=angle,
            speed=rate * radius if radius else rate,
        )
        plans.append(plan)
    return plans


def _check_size(option: str, size: float, *, largest: float, runs: int) -> None:
    if not 0.0 < size <= largest:
        raise ConfigError(f"{option} {size:g}: must be more than 0, at most {largest:g}")
    if not 1 <= runs <= MOST_RUNS:
        raise ConfigError(f"{runs} runs: must be 1 to {MOST_RUNS}")


def find_needed_space(plans: Sequence[RunPlan], config: RobotConfig) -> tuple[float, float]:
    """Return the floor that runs need ahead of the robot's centre, and to each of its sides [m].

    It includes the robot itself, a margin, and slack for what isn't calibrated yet.
    """
    ahead = aside = 0.0
    for plan in plans:
        # A circle needs its radius ahead and its diameter to the side.
        radius = plan.distance / abs(plan.angle) if plan.angle else 0.0
        ahead = max(ahead, radius or plan.distance)
        aside = max(aside, 2.0 * radius)

    # The robot itself, and what an uncalibrated robot may be off.
    around = footprint_radius(config) + SPACE_MARGIN + SPACE_SLACK * max(ahead, aside)
    return ahead + around, aside + around


def check_space(
    plans: Sequence[RunPlan], config: RobotConfig, space: tuple[float, float] | None
) -> tuple[float, float]:
    """Return the stated space. Raises ConfigError if it is missing, or too small for the runs."""
    ahead, aside = find_needed_space(plans, config)
    needed = f"{ahead + 0.005:.2f} {aside + 0.005:.2f}"
    # A real robot needs a floor that the user has checked.
    if space is None:
        raise ConfigError(
            "--space is missing: say how much floor is free ahead and to each side; this needs "
            f"--space {needed}"
        )

    if not (space[0] >= ahead - 1e-9 and space[1] >= aside - 1e-9):
        raise ConfigError(
            f"--space {space[0]:g} {space[1]:g}: too small: this needs --space {needed} ahead of "
            "the robot's centre and to each side, itself included: clear more floor, or drive less "
            "(--distance, --radii)"
        )
    return space


def make_fence(config: RobotConfig, plan: RunPlan, space: tuple[float, float]) -> Geofence:
    """Return a geofence around the space, in the frame of a run's start.

    Args:
        config: Robot configuration.
        plan: What is to be driven.
        space: Free floor ahead of the robot's centre, and to each of its sides [m]. Behind it, the
            shorter of the two is taken. A run that goes backward starts at its far end.
    """
    # The fence is for the robot's centre.
    ahead, aside = (free - footprint_radius(config) for free in space)
    ends = (-min(ahead, aside), ahead)

    # The way back starts at the far end, so that the free floor is behind.
    if plan.back:
        ends = (-ahead, min(ahead, aside))
    return Geofence(min_x=ends[0], max_x=ends[1], min_y=-aside, max_y=aside)


def drive_plans(
    robot: Robot,
    plans: Sequence[RunPlan],
    space: tuple[float, float] | None,
    *,
    runs: list[CalibrationRun],
    announce: Callable[[RunPlan], None],
    recorder: Recorder | None = None,
    reads_truth: bool = False,
) -> None:
    """Drive runs within the stated space.

    The link is closed after each run, while people measure.

    Args:
        robot: Robot, not active. It is closed afterwards. A simulated robot starts each run at the
            origin.
        plans: What to drive.
        space: Free floor ahead and to each side [m]. See `make_fence`. A simulated robot needs
            none.
        runs: Each run is added here as soon as it has ended.
        announce: Called before each run, such as a countdown.
        recorder: The robot's recorder, if it has one.
        reads_truth: Whether the truth of a simulation measures the runs.

    Raises:
        ConfigError: The space is too small or not stated.
        LinkError: The robot can't be driven, or was stopped.
    """
    # A simulated floor has no edge, and a robot that starts each run at the origin needn't drive
    # back. But a plan that doesn't fit is still an error.
    if robot.link.truth is not None:
        plans = [plan.ahead() for plan in plans]
        space = space or find_needed_space(plans, robot.config)
    space = check_space(plans, robot.config, space)

    try:
        for plan in plans:
            announce(plan)
            if recorder is not None:
                recorder.describe({"run": plan.name, "manoeuvre": plan.manoeuvre})
            robot.safety.fence(make_fence(robot.config, plan, space))
            runs.append(drive_run(robot, plan, reads_truth=reads_truth))
    finally:
        robot.close()


def drive_run(robot: Robot, plan: RunPlan, *, reads_truth: bool = False) -> CalibrationRun:
    """Drive a run. The robot is stopped and closed on any way out of it.

    Args:
        robot: Robot, not active.
        plan: What to drive.
        reads_truth: Whether the truth of a simulation measures the run.

    Raises:
        LinkError: The link failed, or the robot was stopped or doesn't move on.
    """
    wheels = []
    truth: list[Pose] = []

    def follow() -> None:
        wheels.append(robot.odometry.wheel_positions)
        if robot.link.truth is not None:
            truth.append(robot.link.truth.pose)

    try:
        robot.reset(Scene())
        follow()

        # Wheels roll out before the end is measured.
        rollout = itertools.repeat((0.0, 0.0), math.ceil(REST_TIME / robot.config.period))
        for twist in itertools.chain(_steer(robot, plan), rollout):
            robot.drive(*twist)
            follow()
            _check_stopped(robot, plan)
    except BaseException as error:
        robot.deactivate(error)
        raise
    robot.deactivate()
    readings = read_truth(truth, plan.manoeuvre) if reads_truth else ()
    return CalibrationRun(plan.name, plan.manoeuvre, side_angles(np.array(wheels)), readings)


def _steer(robot: Robot, plan: RunPlan) -> Iterator[tuple[float, float]]:
    """Yield the twist of each tick, along a line or a circle, or of a turn in place.

    Raises:
        LinkError: The robot doesn't arrive in time.
    """
    geometry = (*robot.config.wheel_radii, robot.config.effective_separation)
    goal = plan.distance or abs(plan.angle)
    seconds = 3.0 * goal / plan.speed + RUN_TIMEOUT
    at_rest = 0
    for _ in range(math.ceil(seconds / robot.config.period)):
        # The twist of angles is a distance and a heading.
        way, heading = compute_twist(*robot.odometry.wheel_positions, *geometry)
        progress = abs(way) if plan.distance else math.copysign(1.0, plan.angle) * heading
        if goal - progress < RUN_TOLERANCE:
            return

        # Slow down before the end, so that the robot neither slips nor overshoots.
        approach = APPROACH_GAIN * (goal - progress) / plan.speed
        # Such slow wheels may stop in their deadband. The end is measured wherever it is.
        is_at_rest = approach < 1.0 and max(map(abs, robot.speeds)) < AT_REST_SPEED
        at_rest = at_rest + 1 if is_at_rest else 0
        if at_rest * robot.config.period > AT_REST_TIME:
            return
        speed = plan.speed * min(1.0, max(SLOWEST_SHARE, approach))
        if plan.distance:
            wanted = plan.angle * min(1.0, progress / goal)
            rate = speed * plan.angle / goal + HEADING_GAIN * (wanted - heading)
            yield -speed if plan.back else speed, rate
        else:
            yield 0.0, math.copysign(speed, plan.angle)

    driven = f"{progress:.2f} of {goal:.2f} m"
    if not plan.distance:
        driven = f"{math.degrees(progress):.0f} of {math.degrees(goal):.0f} degrees"
    raise LinkError(
        f"{plan.name}: only {driven} by odometry",
        "check that nothing blocks the robot, its battery, and 'acsar-gym doctor'",
    )


def _check_stopped(robot: Robot, plan: RunPlan) -> None:
    """Raise LinkError if the safety layer holds the robot."""
    if not robot.safety.stopped:
        return
    if robot.safety.reason != Reason.GEOFENCE:
        raise LinkError(f"{plan.name}: ended by an emergency stop", "start again when it is safe")

    # The fence stops a robot whose odometry is wrong before it hits what is beyond.
    x, y, _ = robot.odometry.pose
    raise LinkError(
        f"{plan.name}: stopped at ({x:.2f}, {y:.2f}) m by odometry, the edge of the stated space",
        "give more --space, or calibrate turns first",
    )


def read_truth(poses: Sequence[Pose], manoeuvre: str) -> tuple[RunReading, ...]:
    """Return the end of a run in the frame of its start, from the true pose at each tick."""
    # Full turns count, and true headings are within half a turn.
    turned = float(np.unwrap([theta for _, _, theta in poses])[-1]) - poses[0][2]
    heading = RunReading("heading", turned, TRUTH_RADIANS, "truth")
    if manoeuvre == "turn":
        return (heading,)
    x, y, _ = to_odometry(poses[0], poses[-1])
    distance = RunReading("distance", math.hypot(x, y), TRUTH_METRES, "truth")
    return (distance, RunReading("aside", y, TRUTH_METRES, "truth"), heading)
