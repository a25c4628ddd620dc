"""Drives the runs of a calibration, gets their readings, and keeps both."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from acsar_gym.calibration import lidar, manoeuvres
from acsar_gym.calibration.driving import Observer, drive
from acsar_gym.calibration.manoeuvres import Plan
from acsar_gym.calibration.readings import Scales, check, of_corner, of_line, of_turn
from acsar_gym.calibration.runs import Run
from acsar_gym.calibration.truth import TruthObserver
from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError
from acsar_gym.lidars.factory import factories
from acsar_gym.links import open_link
from acsar_gym.recording import Recorder
from acsar_gym.robot import Robot
from acsar_gym.worlds import Pose, Scene
from acsar_gym.worlds.pool import Pool
from acsar_gym.worlds.search import footprint_radius

SIMULATED = ("planar", "bullet")
"""Links that have ground truth."""
ASKED = {
    "straight": "straight distance from start to end [m]",
    "turn": "turned angle [degrees], full turns counted",
    "square": "end x y [m], and heading [degrees] if you have it, as the start saw them",
}
"""What a person is asked for after each run."""
MOST = 1e6
"""Largest reading."""


@dataclass(frozen=True, slots=True)
class Wire:
    """The robot to be driven."""

    url: str
    """planar, bullet, or a serial device."""
    config: RobotConfig
    """What is known of the robot."""
    twin: RobotConfig
    """The simulated robot; equal to the config where nothing is hidden."""
    lidar: str | None = None
    """URL of a LiDAR; "simulated" in simulation; None for a tape or truth."""
    world: str | None = None
    """World of a simulation."""
    recorder: Recorder | None = None
    """Records all runs; None: nothing is recorded."""

    @property
    def simulated(self) -> bool:
        """Whether the robot is simulated."""
        return self.url in SIMULATED


def drive_all(
    wire: Wire,
    plans: Sequence[Plan],
    space: tuple[float, float] | None,
    before: Callable[[Plan], None],
    after: Callable[[Run], Run],
    *,
    truth: bool,
) -> list[Run]:
    """Drive runs within the stated space; the link is closed after each run, while people measure.

    Args:
        wire: the robot.
        plans: what to drive.
        space: free floor ahead and to each side [m]; see `manoeuvres.fenced`.
        before: called before each run, such as a countdown.
        after: called after each run; may add readings.
        truth: whether ground truth measures a simulated robot.

    Raises:
        ConfigError: the space is too small.
        LinkError: the robot can't be driven, or was stopped.
    """
    space = manoeuvres.check_space(wire.config, plans, space)
    if wire.simulated:  # begins every run at its start anyway
        plans = [plan.ahead() for plan in plans]
    scene = _scene(wire)
    observer = _observer(wire, truth=truth)
    found = []
    robot = _robot(wire)
    try:
        for plan in plans:
            before(plan)
            robot.safety.fence(manoeuvres.fence(wire.config, plan, space))
            found.append(after(drive(robot, plan, scene, observer)))
    finally:
        robot.close()
    return found


def _robot(wire: Wire) -> Robot:
    """The robot, not active."""
    config, twin = wire.config, wire.twin
    if wire.lidar is not None:
        config, twin = lidar.fine(config), lidar.fine(twin)
    sensors = factories(["lidar"], wire.lidar) if wire.lidar is not None else ()
    link = open_link(wire.url, twin if wire.simulated else config)
    return Robot(link, config, sensors, recorder=wire.recorder)


def _observer(wire: Wire, *, truth: bool) -> Observer | None:
    """What measures a run; None where a person does."""
    if wire.lidar is not None:
        return lidar.LidarObserver(lidar.fine(wire.config))
    return TruthObserver() if truth else None


def _scene(wire: Wire) -> Scene:
    """The scene of a simulation: at the world's start, facing its goal or as the world says."""
    if wire.world is None:
        return Scene()
    if not wire.simulated:
        raise ConfigError("--world is for simulated robots: planar or bullet")
    pool = Pool.of(wire.world, None, footprint_radius(wire.config), 1)
    world = next(iter(pool)) if pool else None
    if world is None:
        return Scene()
    start: Pose = (world.start.x, world.start.y, world.start.theta or 0.0)
    return Scene(start, world=world)


@dataclass(frozen=True, slots=True)
class Given:
    """Readings that options give, in the order of the runs."""

    measured: tuple[float, ...] = ()
    """Distances of straight runs [m]."""
    aside: tuple[float, ...] = ()
    """Offsets to the left of straight runs' ends [m]; as many as distances, or none."""
    degrees: tuple[float, ...] = ()
    """Angles of turns [degrees]."""
    clockwise: tuple[tuple[float, ...], ...] = ()
    """Ends of clockwise squares: x, y [m] and perhaps heading [degrees]."""
    counter: tuple[tuple[float, ...], ...] = ()
    """Ends of counter-clockwise squares."""

    def __post_init__(self) -> None:
        for option in ("measured", "aside", "degrees"):
            for number in getattr(self, option):
                if not -MOST <= number <= MOST:
                    name = "measured-deg" if option == "degrees" else option
                    raise ConfigError(f"--{name} {number:g}: must be {-MOST:g} to {MOST:g}")
        if self.aside and len(self.aside) != len(self.measured):
            raise ConfigError(
                f"--aside has {len(self.aside)} readings, --measured {len(self.measured)}: must be "
                "as many"
            )

    @property
    def any(self) -> bool:
        """Whether there are readings."""
        return bool(self.measured or self.degrees or self.clockwise or self.counter)

    def rows(self, manoeuvre: str) -> list[tuple[float, ...]]:
        """The readings of one manoeuvre's runs; clockwise squares come first."""
        if manoeuvre == "straight":
            if not self.aside:
                return [(one,) for one in self.measured]
            return list(zip(self.measured, self.aside, strict=True))
        if manoeuvre == "turn":
            return [(one,) for one in self.degrees]
        return [*self.clockwise, *self.counter]


def check_counts(plans: Sequence[Plan], given: Given) -> None:
    """Check before driving that there is a reading for each run, or none; ConfigError."""
    for manoeuvre in ASKED:
        count = sum(plan.manoeuvre == manoeuvre for plan in plans)
        rows = len(given.rows(manoeuvre))
        if rows not in (0, count):
            raise ConfigError(
                f"{rows} readings for {count} {manoeuvre} runs: must be one for each run"
            )


def measured(run: Run, row: Sequence[float], scales: Scales) -> Run:
    """Give a run the readings of a row of numbers."""
    if run.manoeuvre == "straight":
        return run.read(of_line(row, scales))
    if run.manoeuvre == "turn":
        return run.read(of_turn(row[0], run, scales))
    return run.read(of_corner(row, run, scales))


def parsed(run: Run, text: str, scales: Scales) -> Run:
    """Give a run the readings that a person typed; nothing typed leaves it without.

    Raises:
        ConfigError: these aren't as many numbers as asked for.
    """
    try:
        row = [float(part) for part in text.replace(",", " ").split()]
    except ValueError:
        row = [float("nan")]
    if not row:
        return run
    most = {"straight": (1, 2), "turn": (1,), "square": (2, 3)}[run.manoeuvre]
    if len(row) not in most or not all(-MOST <= number <= MOST for number in row):
        raise ConfigError(f"{text.strip()[:60]!r}: must be the {ASKED[run.manoeuvre]}")
    return measured(run, row, scales)


def assigned(found: Sequence[Run], given: Given, scales: Scales) -> list[Run]:
    """Give runs the readings of the options, manoeuvre by manoeuvre, in order.

    Where there are as many readings as runs without any, they are for those; otherwise they are
    for all runs of the manoeuvre.

    Raises:
        ConfigError: there are neither as many.
    """
    result = list(found)
    for manoeuvre in ASKED:
        rows = given.rows(manoeuvre)
        own = [i for i, run in enumerate(result) if run.manoeuvre == manoeuvre]
        unread = [i for i in own if not result[i].readings]
        for places in (unread, own):
            if len(places) == len(rows):
                for i, row in zip(places, rows, strict=True):
                    result[i] = measured(result[i], row, scales)
                break
        else:
            if rows:
                raise ConfigError(
                    f"{len(rows)} readings for {len(own)} {manoeuvre} runs, {len(unread)} of them "
                    "without a reading: must be as many"
                )
    return result


def checked(found: Iterable[Run], config: RobotConfig) -> list[str]:
    """Check all readings against odometry; returns lines to be told. ConfigError."""
    return [line for run in found if (line := check(run, config))]
