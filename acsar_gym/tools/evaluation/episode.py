"""The record of an episode, and the figures that are computed from it."""

from __future__ import annotations

import itertools
import json
import math
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acsar_gym import reading
from acsar_gym.config.footprint import Outline
from acsar_gym.envs.robot_env import RobotEnv
from acsar_gym.errors import ConfigError
from acsar_gym.links.lateness import EpisodeTiming
from acsar_gym.tasks.episode import Assignment
from acsar_gym.tasks.task import info_names
from acsar_gym.worlds import Pose, Region, World
from acsar_gym.worlds.crowd import NO_HIT, PERSON_HIT
from acsar_gym.worlds.geometry import point_clearance, segment_clearance
from acsar_gym.worlds.pool import Key
from acsar_gym.worlds.search import footprint_radius, path_length, remaining_distance
from acsar_gym.worlds.world import point_in_world, to_odometry, to_world

Floats = NDArray[np.float64]
Resets = Sequence[tuple[int, Mapping[str, Any]]]
"""Seed and options of the reset of each episode."""
MAX_LOG_BYTES = 1_000_000_000
"""Largest accepted log of an emulator [bytes]. It grows by 1 MB a minute."""
TRACK_KEYS = (
    *("odom_x", "odom_y", "odom_theta"),
    *("true_x", "true_y", "true_theta"),
    *("closest_person", "time_to_collision"),
)
"""Keys of info that make a row of a track, NaN if info doesn't have them, before the reward."""
ODOM = slice(0, 3)
TRUE = slice(3, 6)
CLOSEST_PERSON = 6
TIME_TO_COLLISION = 7
REWARD = 8
"""Columns of a track."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Episode:
    """Result of one episode, from odometry, the link's clock and, in simulation, ground truth.

    Figures that aren't known are NaN.
    """

    seed: int | None = None  # of the reset
    world: Key | None = None
    """Number of the world, or its name among several sets. -1 for a world or path given by the
    user, None on an open floor."""
    success: bool
    collision: bool
    """Whether a simulated robot touched an obstacle, or ran into a person. False on hardware."""
    person_contact: float = math.nan
    """0 for none, 1 if the robot ran into a person, which is a collision, 2 if a person ran into
    the robot, which isn't a collision. NaN without people."""
    fault: str = ""  # fault of the link or board that ended the episode, if there was one
    valid: bool = True  # whether there was no fault, and no more late ticks than allowed
    started: float = 0.0  # time at which the first tick began, on the link's clock [s]
    ended: float = math.nan  # time at which the last tick ended, on the link's clock [s]
    length: int = 0  # number of policy steps
    ticks: int = 0
    late_ticks: int = 0  # ticks that ended over a millisecond late, 0 in simulation
    episode_return: float = math.nan  # sum of the rewards
    path: float = math.nan  # length of the path driven, by odometry [m]
    driven: float = math.nan  # the same by ground truth if there is one, else by odometry [m]
    shortest: float = math.nan
    """Length of the shortest path to success for the robot's footprint [m], see
    `Task.shortest_path`."""
    left: float = math.nan  # the same from the final position [m]
    turning: float = math.nan  # sum of absolute heading changes, by odometry [rad]
    jerk: float = math.nan
    """Mean absolute jerk of the speed driven, by odometry [m/s^3], see `mean_jerk`."""
    clearance: float = math.nan
    """Least distance of the footprint to an obstacle that stands [m], by ground truth at every env
    step. 0 if it touched such an obstacle."""
    closest_person: float = math.nan
    """Least distance of the footprint to a person [m], by ground truth at every env
    step. 0 if they touched."""
    time_to_collision: float = math.nan
    """Least time until the robot would touch a person if all kept their velocities [s], at every
    env step."""
    intrusions: float = math.nan  # how often the robot entered a person's personal space
    energy: float = math.nan
    """Mechanical work of a simulated robot's motors [J], W = sum over ticks of P dt with the power
    P of `physics.model.motor_power`."""
    odometry_error: float = math.nan  # distance between odometry and ground truth at the end [m]
    cross_track: float = math.nan  # mean cross-track error of path following [m]
    score: float = math.nan  # of a scene of the benchmark, see `benchmark.plan.score_episode`
    pose: Pose = (math.nan, math.nan, math.nan)  # odometry at the end (x [m], y [m], theta [rad])
    told: dict[str, float] = field(default_factory=dict)
    """The task's own numbers in info at the end, by name: its `told`."""
    timing: EpisodeTiming | None = None
    """Timing statistics of the link. None in simulation, which has no timing errors."""

    @property
    def time(self) -> float:
        """Duration of the episode [s]."""
        return self.ended - self.started

    @property
    def spl(self) -> float:
        """Success weighted by path length, 0 to 1: success * shortest / max(driven, shortest)."""
        return float(self.success) * self._path_share

    @property
    def soft_spl(self) -> float:
        """SPL with the progress max(0, 1 - left / shortest) in place of success, 0 to 1."""
        return max(0.0, 1.0 - _divide(self.left, self.shortest)) * self._path_share

    @property
    def _path_share(self) -> float:
        """The shortest path as a share of the one driven, at most 1. NaN if it isn't known."""
        if math.isnan(self.shortest):
            return math.nan
        return _divide(self.shortest, max(self.driven, self.shortest))


def describe_end(info: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields of an `Episode` that describe its end, by the info of its last step."""
    success = info["is_success"] == 1.0
    person_contact = float(info.get("person_contact", math.nan))
    touched = info["true_contact"] == 1.0 and person_contact != PERSON_HIT
    return {
        "success": bool(success),
        "collision": bool(touched and not success),
        "person_contact": person_contact,
    }


def _divide(part: float, whole: float) -> float:
    """Divide. 1 if `whole` isn't positive."""
    return part / whole if whole > 0.0 else 1.0


def known_pose(row: Sequence[float] | Floats) -> Pose:
    """Return the pose by ground truth if it is known, else by odometry, of a row of a track."""
    is_known = not math.isnan(row[TRUE][0])
    x, y, theta = map(float, row[TRUE if is_known else ODOM])
    return x, y, theta


@dataclass(frozen=True, slots=True, kw_only=True)
class Drive:
    """An episode that has ended, as an env or a robot of a batch leaves it."""

    seed: int
    assignment: Assignment
    track: Floats
    """(steps + 1, len(TRACK_KEYS) + 1): numbers and reward of the reset and of every env step."""
    info: Mapping[str, Any]
    """Info of the last step."""
    first_way: Floats | float | None
    """The task's shortest way from the start."""
    last_way: Floats | float | None
    """The same from the end."""
    started: float
    """Time at which the first tick began, on the link's clock [s]."""
    ended: float
    energy: float
    timing: EpisodeTiming | None = None


def measure_episode(env: RobotEnv, drive: Drive, late_share: float) -> Episode:
    """Compute the result of an episode.

    Args:
        env: Env of the episode, with its task and robot.
        drive: The episode.
        late_share: Largest share of late ticks in a valid episode.
    """
    config = env.robot.config
    info = drive.info

    # The first row of a track is that of the reset.
    steps = len(drive.track) - 1
    assignment = drive.assignment
    ending = describe_end(info)

    # Poses by ground truth are better, but real robots have odometry only.
    odom = drive.track[:, ODOM]
    true = drive.track[:, TRUE]
    is_known = not math.isnan(true[-1, 0])
    poses = true if is_known else odom

    # The shortest paths from the start and from the end.
    radius = footprint_radius(config)
    shortest = measure_way(assignment, radius, drive.track[0], drive.first_way)
    remaining = measure_way(assignment, radius, drive.track[-1], drive.last_way)

    # Contacts, and how near the robot came to what stands and to who moves.
    nearest = np.fmin.reduce(drive.track)
    touched_person = ending["person_contact"] > NO_HIT
    clearance = math.nan
    if assignment.world is not None and assignment.world.obstacles and is_known:
        touched = info["true_contact"] == 1.0 and not touched_person
        places = np.array([to_world(assignment.start, pose) for pose in true.tolist()])
        distance = footprint_clearance(places, config.outline, assignment.world)
        clearance = 0.0 if touched else max(0.0, distance)

    fault = info.get("fault_reason", "")
    lateness = drive.timing.lateness if drive.timing else None
    return Episode(
        seed=drive.seed,
        world=None if assignment.world is None else assignment.world_key,
        **ending,
        fault=fault,
        valid=not fault and (lateness is None or lateness.late_share <= late_share),
        started=drive.started,
        ended=drive.ended,
        length=steps,
        ticks=steps * env.ticks_per_step,
        late_ticks=lateness.late_ticks if lateness else 0,
        episode_return=float(np.cumsum(drive.track[:, REWARD])[-1]),
        path=path_length(odom[:, :2]),
        driven=path_length(poses[:, :2]),
        shortest=shortest,
        left=remaining,
        turning=float(np.abs(np.diff(np.unwrap(odom[:, 2]))).sum()),
        jerk=mean_jerk(odom, env.ticks_per_step * config.period),
        clearance=clearance,
        closest_person=0.0 if touched_person else float(nearest[CLOSEST_PERSON]),
        time_to_collision=float(nearest[TIME_TO_COLLISION]),
        intrusions=float(info.get("intrusions", math.nan)),
        energy=drive.energy,
        odometry_error=float(info["odometry_error"]),
        cross_track=float(info.get("mean_cross_track_error", math.nan)),
        pose=tuple(odom[-1].tolist()),
        told={name: float(info[name]) for name in info_names(env.task)},
        timing=drive.timing,
    )


def mean_jerk(poses: Floats, period: float) -> float:
    """Compute the mean absolute jerk of the speed driven.

    The average of |d^2 v / dt^2|, as in the metrics of Francis et al. 2023 (Principles and
    Guidelines for Evaluating Social Robot Navigation), by second differences of the speed. The
    speed of a step is its displacement along the mean heading, over the period.

    Args:
        poses: (N, 3), a pose for each env step.
        period: Duration of an env step [s].

    Returns:
        The jerk [m/s^3]. NaN for episodes of fewer than three steps.
    """
    if len(poses) < 4:
        return math.nan
    # Along the mean heading, so that turning isn't speed.
    x, y, theta = poses.T
    theta = np.unwrap(theta)
    middle = (theta[1:] + theta[:-1]) / 2.0
    speeds = (np.diff(x) * np.cos(middle) + np.diff(y) * np.sin(middle)) / period
    return float(np.abs(np.diff(speeds, 2)).mean()) / period**2


def measure_way(
    assignment: Assignment, radius: float, row: Floats, way: Floats | float | None
) -> float:
    """Return the length of a task's way from the pose in a row of the track [m].

    NaN if there is none, or if the surroundings aren't known, as those of a real robot.
    """
    if isinstance(way, float):
        return way
    if way is None or (assignment.world is not None and math.isnan(row[TRUE][0])):
        return math.nan
    points = [known_pose(row)[:2], *way.tolist()]
    places = [Region(*point_in_world(assignment.start, (x, y))) for x, y in points]
    world = assignment.world or World()
    return math.fsum(
        _distance(world, radius, place, goal) for place, goal in itertools.pairwise(places)
    )


_distance = lru_cache(maxsize=1024)(remaining_distance)
"""Episodes in a world often have the same start and goal."""


def footprint_clearance(places: Floats, outline: Outline, world: World) -> float:
    """Compute the least distance of a footprint, at any of several poses, to any obstacle.

    Args:
        places: Poses of the base in the frame of the world, (N, 3) [m, m, rad].
        outline: Corners of the footprint in the base frame [m].
        world: World with the obstacles.

    Returns:
        The distance of the footprint's sides [m]: negative inside a circle, inf without obstacles.
    """
    corners = np.array(outline)
    outer_radius = float(np.hypot(*corners.T).max())
    clearances = point_clearance(places[:, :2], world)
    is_near = clearances <= clearances.min() + outer_radius  # elsewhere the robot is farther away

    # The corners of the footprint at each pose, and the sides between them.
    x, y, theta = places[is_near].T[..., None]
    cos = np.cos(theta)
    sin = np.sin(theta)
    along, across = corners.T
    placed = np.stack([x + cos * along - sin * across, y + sin * along + cos * across], axis=-1)
    ends = np.roll(placed, -1, axis=1)
    return float(segment_clearance(placed.reshape(-1, 2), ends.reshape(-1, 2), world).min())


def odometry_errors(episodes: Sequence[Episode], log: Path) -> list[float]:
    """Compute the odometry error at the end of each episode from an emulator's log [m].

    The emulated robot isn't moved back between episodes, so true poses are taken relative to the
    true pose at the reset. Link and emulator both use the machine's monotonic clock.

    Raises:
        ConfigError: The log holds no true poses.
    """
    stamps, poses = read_true_poses(log)

    errors = []
    for episode in episodes:
        # The newest pose until then.
        times = (episode.started, episode.ended)
        start, end = (poses[max(0, bisect_right(stamps, time) - 1)] for time in times)
        errors.append(math.dist(to_odometry(start, end)[:2], episode.pose[:2]))
    return errors


def read_true_poses(log: Path) -> tuple[list[float], list[Pose]]:
    """Read the times [s] and true poses from an emulator's log, whose last line may be cut.

    Raises:
        ConfigError: It can't be read, or holds no true poses.
    """
    # The emulator may be writing the last line.
    lines = reading.read_file(log, MAX_LOG_BYTES).splitlines(keepends=True)
    stamps: list[float] = []
    poses: list[Pose] = []
    try:
        for event in (json.loads(line) for line in lines if line.endswith(b"\n")):
            if "pose" in event:
                x, y, theta = map(float, event["pose"])
                poses.append((x, y, theta))
                stamps.append(float(event["t"]))
    except (ValueError, TypeError, LookupError):
        poses.clear()
    if not poses:
        raise ConfigError(f"{log}: isn't a log of 'acsar-gym emulate --log FILE' with true poses")
    return stamps, poses
