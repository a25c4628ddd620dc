"""The runs of a calibration: planned within the free floor, driven closed-loop on odometry."""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from acsar_gym.config import Geofence, RobotConfig
from acsar_gym.errors import ConfigError, LinkError
from acsar_gym.recording import Recorder
from acsar_gym.robot import Robot
from acsar_gym.safety.rules import Reason
from acsar_gym.tools.sysid.calibration import CalibrationJob, CalibrationRun, RunReading
from acsar_gym.worlds import Pose, Scene
from acsar_gym.worlds.search import footprint_radius
from acsar_gym.worlds.world import to_odometry

SPACE_SLACK = 0.25
"""How far a run may end from where odometry puts it, as a share of its extent, before it is
calibrated."""
SPACE_MARGIN = 0.1
"""Distance to be kept from the edge of the space [m]."""
BACKWARDS_NAME = ", backwards"
SLOWER_SHARE = 0.07
"""How much slower the second and third of three runs are, as a share of the speed."""
MAX_RUNS = 200
"""Most runs of one call."""
DISTANCE_GAIN = 3.0
"""Speed for each metre that is left [1/s]."""
ANGLE_GAIN = 3.0
"""Turn rate for each radian that is left [1/s]."""
SLOWEST_SHARE = 0.2
"""Least share of the full speed, before the end."""
HEADING_GAIN = 2.0
"""Turn rate for each radian off the wanted heading [1/s]."""
RUN_TOLERANCE = 0.002
"""A run is braked this close before its end, as a share of a metre or of a radian; the rest is
rolled out and measured."""
RUN_TIMEOUT = 5.0
"""A run that takes this much longer than three times its nominal time has failed [s]."""
REST_TIME = 1.5
"""How long the robot stands at the end of a run, to be measured [s]."""
TRUTH_METRES = 2e-4
TRUTH_RADIANS = 1e-3
"""Standard deviations of truth."""


@dataclass(frozen=True, slots=True)
class RunPlan:
    """One run from standstill to standstill: a line, a circle, or a turn in place."""

    name: str
    manoeuvre: str
    """straight or turn."""
    distance: float
    """Along the path of the robot's centre [m], not negative."""
    angle: float
    """Turned on the way [rad], counter-clockwise positive."""
    linear: float
    """Speed where it goes ahead [m/s]."""
    angular: float
    """Speed of turns in place [rad/s]."""
    back: bool = False
    """Whether it goes backwards, so that the robot returns to where the run before began."""

    def ahead(self) -> RunPlan:
        """The same, not backwards."""
        return replace(self, name=self.name.removesuffix(BACKWARDS_NAME), back=False)


def plan_straights(distance: float, speed: float, repeats: int) -> list[RunPlan]:
    """Straight runs.

    Args:
        distance: [m].
        speed: of the first run [m/s]; the next ones are slower, so that roundings differ.
        repeats: how many runs; every second one goes backwards, to the start of the one before.
    """
    _check_size("--distance", distance, 100.0, repeats)
    found = []
    for number in range(1, repeats + 1):
        back = number % 2 == 0
        name = f"straight {number}" + (BACKWARDS_NAME if back else "")
        own = speed * (1.0 - SLOWER_SHARE * ((number - 1) % 3))
        found.append(RunPlan(name, "straight", distance, 0.0, own, 0.0, back))
    return found


def plan_turns(
    turned: float, speeds: Sequence[float], radii: Sequence[float], repeats: int
) -> list[RunPlan]:
    """Turns on the spot and in circles: every radius with every speed, left, right, left...

    Args:
        turned: full turns of each run.
        speeds: [rad/s].
        radii: of the circle of the robot's centre [m]; 0 turns in place.
        repeats: how often each.
    """
    _check_size("--turns", turned, 1000.0, repeats)
    for radius in radii:
        if not 0.0 <= radius <= 100.0:
            raise ConfigError(f"--radii {radius:g}: must be 0 to 100 m")
    found = []
    pairs = list(itertools.product(radii, speeds)) * repeats
    for number, (radius, speed) in enumerate(pairs, start=1):
        side = 1.0 if number % 2 else -1.0
        angle = side * turned * math.tau
        where = f", radius {radius:g} m" if radius else ""
        name = f"turn {number}, {'left' if side > 0.0 else 'right'}, {speed:g} rad/s{where}"
        found.append(RunPlan(name, "turn", radius * abs(angle), angle, speed * radius, speed))
    return found


def _check_size(option: str, size: float, most: float, runs: int) -> None:
    """Raise ConfigError unless 0 < size <= most, and for too few or too many runs."""
    if not 0.0 < size <= most:
        raise ConfigError(f"{option} {size:g}: must be more than 0, at most {most:g}")
    if not 1 <= runs <= MAX_RUNS:
        raise ConfigError(f"{runs} runs: must be 1 to {MAX_RUNS}")


def find_needed_space(plans: Sequence[RunPlan], config: RobotConfig) -> tuple[float, float]:
    """The floor that runs need ahead of the robot's centre, and to each of its sides [m].

    Includes the robot itself, a margin, and slack for what isn't calibrated yet.
    """
    ahead = aside = 0.0
    for plan in plans:
        if plan.distance and plan.angle:
            radius = plan.distance / abs(plan.angle)
            half_turns = min(1.0, abs(plan.angle) / math.pi)
            ahead = max(ahead, radius * math.sin(math.pi * min(half_turns, 0.5)))
            aside = max(aside, radius * (1.0 - math.cos(math.pi * half_turns)))
        else:
            ahead = max(ahead, plan.distance)
    reach, slack = footprint_radius(config) + SPACE_MARGIN, SPACE_SLACK * max(ahead, aside)
    return ahead + slack + reach, aside + slack + reach


def check_space(
    config: RobotConfig, plans: Sequence[RunPlan], space: tuple[float, float] | None
) -> tuple[float, float]:
    """Return the space that the runs may use: the stated one, or what they need if it is None.

    Raises:
        ConfigError: the stated space is too small; it says how much is needed.
    """
    ahead, aside = find_needed_space(plans, config)
    if space is None:
        return ahead, aside
    if not (space[0] >= ahead - 1e-9 and space[1] >= aside - 1e-9):
        up = [f"{math.ceil(one * 100.0 - 1e-6) / 100.0:.2f}" for one in (ahead, aside)]
        raise ConfigError(
            f"--space {space[0]:g} {space[1]:g}: too small: this needs {up[0]} m ahead of the "
            f"robot's centre and {up[1]} m to each side, itself included: clear more floor, "
            "or drive less (--distance, --radii)"
        )
    return space


def make_fence(config: RobotConfig, plan: RunPlan, space: tuple[float, float]) -> Geofence:
    """Return a geofence around the space, in the frame of one run's start.

    Args:
        config: of the robot.
        plan: what is to be driven.
        space: free floor ahead of the robot's centre, and to each of its sides [m]; behind it,
            the shorter of the two is taken. A run that goes backwards begins at its far end.
    """
    reach = footprint_radius(config)
    x, y = space[0] - reach, space[1] - reach
    behind = min(x, y)
    ends = (-x, behind) if plan.back else (-behind, x)
    return Geofence(min_x=ends[0], max_x=ends[1], min_y=-y, max_y=y)


class TruthReader:
    """Follows the true pose of a simulated robot during a run.

    Args:
        robot: on a simulated link, at the start of the run.
    """

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self._start = self._pose = self._read()
        self._turned = 0.0

    def tick(self) -> None:
        """Follow the robot for one tick."""
        pose = self._read()
        self._turned += math.remainder(pose[2] - self._pose[2], math.tau)
        self._pose = pose

    def readings(self, plan: RunPlan) -> list[RunReading]:
        """The end of the run in the frame of its start."""
        heading = RunReading("heading", self._turned, TRUTH_RADIANS, "truth")
        if plan.manoeuvre == "turn":
            return [heading]
        x, y, _ = to_odometry(self._start, self._pose)
        distance = RunReading("distance", math.hypot(x, y), TRUTH_METRES, "truth")
        return [distance, RunReading("aside", y, TRUTH_METRES, "truth"), heading]

    def _read(self) -> Pose:
        truth = self._robot.link.truth
        if truth is None:
            raise LinkError("this link has no ground truth", "measure with a tape")
        return truth.pose


def drive_run(
    robot: Robot, plan: RunPlan, make_reader: Callable[[Robot], TruthReader] | None = None
) -> CalibrationRun:
    """Drive one run; the robot is stopped and closed on any way out of it.

    Args:
        robot: inactive.
        plan: what to drive.
        make_reader: makes what measures the run in simulation; None for a tape measure.

    Raises:
        LinkError: the link failed, the robot was stopped, or doesn't get on.
    """
    driver = _RunDriver(robot, plan)
    try:
        robot.reset(Scene())
        if make_reader is not None:
            driver.reader = make_reader(robot)
        driver.drive()
        for _ in range(math.ceil(REST_TIME / robot.config.period)):
            driver.tick(0.0, 0.0)
    except BaseException as error:
        robot.deactivate(error)
        raise
    robot.deactivate()
    readings = driver.reader.readings(plan) if driver.reader else ()
    return CalibrationRun(plan.name, plan.manoeuvre, np.array(driver.wheels), tuple(readings))


def drive_plans(
    job: CalibrationJob,
    robot: Robot,
    plans: Sequence[RunPlan],
    space: tuple[float, float] | None,
    before: Callable[[RunPlan], None],
    recorder: Recorder | None = None,
) -> None:
    """Drive runs within the stated space; each is added to the job as soon as it has ended.

    The link is closed after each run, while people measure.

    Args:
        job: collects the runs, and asks for readings.
        robot: inactive; closed afterwards. Simulated ones begin each run at the origin.
        plans: what to drive.
        space: free floor ahead and to each side [m]; see `make_fence`.
        before: called before each run, such as a countdown.
        recorder: the robot's, if it has one.

    Raises:
        ConfigError: the space is too small or not stated, or nobody would measure.
        LinkError: the robot can't be driven, or was stopped; the job has the runs before that.
    """
    config, simulated = job.config, robot.link.truth is not None
    given = job.check_given(Counter(plan.manoeuvre for plan in plans))
    if not (simulated or given or job.asks or recorder):
        raise ConfigError(
            "nobody would measure: give --measured or --measured-deg, or --record FILE to measure "
            "now and give the readings later"
        )
    if not simulated and space is None:
        ahead, aside = find_needed_space(plans, config)
        raise ConfigError(
            f"--space is missing: say how much floor is free ahead and to each side; this "
            f"needs --space {ahead + 0.005:.2f} {aside + 0.005:.2f}"
        )
    space = check_space(config, plans, space)
    try:
        for plan in plans:
            own = plan.ahead() if simulated else plan  # begins at its start anyway
            before(own)
            if recorder is not None:
                recorder.describe({"run": own.name, "manoeuvre": own.manoeuvre})
            robot.safety.fence(make_fence(config, own, space))
            job.runs.append(drive_run(robot, own, None if given or not simulated else TruthReader))
            if not (simulated or given):
                job.ask_readings(len(job.runs) - 1)
    finally:
        robot.close()


class _RunDriver:
    """Drives one run and keeps the angles of its wheels."""

    def __init__(self, robot: Robot, plan: RunPlan) -> None:
        self.robot = robot
        self.plan = plan
        self.reader: TruthReader | None = None
        self.wheels: list[tuple[float, float]] = [(0.0, 0.0)]
        self.heading = self.way = 0.0
        """Turned and driven, by odometry [rad] [m]."""

    def drive(self) -> None:
        """Drive along a line or a circle, or turn in place. LinkError where it doesn't end."""
        plan = self.plan
        time = plan.distance / plan.linear if plan.distance else abs(plan.angle) / plan.angular
        for _ in range(math.ceil((3.0 * time + RUN_TIMEOUT) / self.robot.config.period)):
            left = plan.distance - self.way if plan.distance else plan.angle - self.heading
            if (left if plan.distance else abs(left)) < RUN_TOLERANCE:
                return
            if plan.distance:
                share = min(1.0, max(SLOWEST_SHARE, DISTANCE_GAIN * left / plan.linear))
                linear = plan.linear * share
                wanted = plan.angle * min(1.0, self.way / plan.distance)
                rate = linear * plan.angle / plan.distance
                rate += HEADING_GAIN * (wanted - self.heading)
                self.tick(-linear if plan.back else linear, rate)
            else:
                share = min(1.0, max(SLOWEST_SHARE, ANGLE_GAIN * abs(left) / plan.angular))
                self.tick(0.0, math.copysign(share * plan.angular, left))
        done = f"{self.way:.2f} of {plan.distance:.2f} m"
        if not plan.distance:
            full = math.degrees(abs(plan.angle))
            done = f"{full - math.degrees(abs(left)):.0f} of {full:.0f} degrees"
        raise LinkError(
            f"{plan.name}: only {done} by odometry",
            "check that nothing blocks the robot, its battery, and 'acsar-gym doctor'",
        )

    def tick(self, linear: float, angular: float) -> None:
        """Drive for one tick. LinkError where the safety layer holds the robot."""
        robot, before = self.robot, self.robot.odometry.pose
        robot.drive(linear, angular)
        x, y, theta = robot.odometry.pose
        self.heading += math.remainder(theta - before[2], math.tau)
        self.way += math.hypot(x - before[0], y - before[1])
        a, b, c, d = robot.odometry.wheel_positions
        self.wheels.append(((b + c) / 2.0, (a + d) / 2.0))
        if self.reader is not None:
            self.reader.tick()
        name = self.plan.name
        if robot.safety.stopped:
            if robot.safety.reason != Reason.GEOFENCE:
                what = f"{name}: ended by an emergency stop"
                raise LinkError(what, "start again when it is safe")
            raise LinkError(
                f"{name}: stopped at ({x:.2f}, {y:.2f}) m by odometry, the edge of the stated "
                "space",
                "give more --space, or calibrate turns first",
            )
