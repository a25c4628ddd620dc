"""Runs a policy for single episodes, and computes the result of each from its steps.

`steps` are the infos of the reset and of every env step.
"""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec
from numpy.typing import NDArray

from acsar_gym import reading
from acsar_gym.config import RobotConfig
from acsar_gym.config.footprint import Outline
from acsar_gym.envs.robot_env import RobotEnv
from acsar_gym.errors import ConfigError, EmergencyStopError
from acsar_gym.links.base import meter_of
from acsar_gym.links.lateness import EpisodeTiming
from acsar_gym.safety.rules import Reason
from acsar_gym.sensors.lidar import newest_scan
from acsar_gym.tasks.navigation import BARN_SCORES
from acsar_gym.tasks.task import info_names
from acsar_gym.tools.policies import FilePolicy, Policy
from acsar_gym.tools.policies.policy import PolicyContext
from acsar_gym.worlds import Pose, Region, World
from acsar_gym.worlds.geometry import point_clearance, segment_clearance
from acsar_gym.worlds.search import footprint_radius, path_length, remaining_distance
from acsar_gym.worlds.world import point_in_world, to_odometry, to_world

Steps = Sequence[dict[str, Any]]
Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]
MAX_LOG_BYTES = 1_000_000_000
"""Largest accepted log of an emulator [bytes]; it grows by 1 MB a minute."""
MAX_LATE_SHARE = 0.01
"""Largest share of late ticks in a valid episode."""


@dataclass(frozen=True, eq=False, slots=True)
class DrawnTrack:
    """Poses and scans of an episode at the reset and after every env step, to draw it afterwards.

    In the frame of the world; on an open floor that of the odometry.
    """

    odometry: Floats32
    """(N, 3): x, y [m], theta [rad]."""
    truth: Floats32 | None
    """(N, 3); None on hardware."""
    scans: Floats32 | None
    """(N, rays): ranges of the LiDAR [m]; None without one."""
    goal: tuple[float, float]
    goal_radius: float
    """What pictures show as the goal [m]."""
    period: float
    """Duration of an env step [s]."""
    robot: RobotConfig
    world: World | None = None


class TrackedEnv(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Asks for a track of every episode that `run_episodes` runs in it.

    Args:
        env: an env of this package, wrapped or not.
    """

    @property
    def spec(self) -> EnvSpec | None:  # type: ignore[override]  # read only, as Gymnasium's wrappers
        """The spec of the env, without this wrapper."""
        return self.env.spec


@dataclass(frozen=True, slots=True)
class EpisodeResult:
    """Result of one episode, from odometry, the link's clock and, in simulation, ground truth."""

    success: bool
    collision: bool
    """Whether a simulated robot touched an obstacle; always False on hardware."""
    started: float
    """Time at which the first tick began, on the link's clock [s]."""
    ended: float
    """Time at which the last tick ended, on the link's clock [s]."""
    path: float
    """Length of the path driven, by odometry [m]."""
    pose: Pose
    """Odometry at the end (x [m], y [m], theta [rad])."""
    odometry_error: float
    """Distance between odometry and ground truth at the end [m]; NaN without ground truth."""
    ticks: int
    late_ticks: int
    """Ticks that ended over a millisecond late; 0 in simulation."""
    shortest: float = math.nan
    """Length of the shortest path to success for the robot's footprint [m], see
    `Task.shortest_path`."""
    left: float = math.nan
    """The same from the final position [m]."""
    driven: float = math.nan
    """Length of the path driven [m], by ground truth if there is one, else by odometry."""
    turning: float = math.nan
    """Sum of absolute heading changes, by odometry [rad]."""
    scores: tuple[float, ...] = ()
    """BARN scores in the order of `tasks.navigation.BARN_SCORES`; empty for other tasks."""
    cross_track: float = math.nan
    """Mean cross-track error of path following [m]; NaN for other tasks."""
    timing: EpisodeTiming | None = None
    """Timing statistics of the link; None in simulation, which has no timing errors."""
    fault: str = ""
    """Fault of the link or board that ended the episode; empty if there was none."""
    valid: bool = True
    """Whether there was no fault, and no more late ticks than allowed."""
    seed: int | None = None
    """Seed of the reset."""
    world: int | None = None
    """Number of the world; -1 for a world or path given by the user, None on an open floor."""
    episode_return: float = math.nan
    """Sum of the rewards."""
    length: int = 0
    """Number of policy steps."""
    clearance: float = math.nan
    """Least distance of the footprint to an obstacle [m], by ground truth at every env step; 0 in a
    collision, NaN without ground truth or obstacles."""
    energy: float = math.nan
    """Mechanical work of a simulated robot's motors [J], W = sum over ticks of P dt with the power
    P of `physics.model.motor_power`; NaN on hardware."""
    jerk: float = math.nan
    """Mean absolute jerk of the speed driven, by odometry [m/s^3]; see `mean_jerk`."""
    told: dict[str, float] = field(default_factory=dict)
    """What the task told in info at the end, by name: its `told`."""
    track: DrawnTrack | None = None
    """Poses and scans of every step, where the env is a `TrackedEnv`."""

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
        """The shortest path as a share of the one driven, at most 1."""
        if math.isnan(self.shortest):
            return math.nan
        driven = self.path if math.isnan(self.driven) else self.driven
        return _divide(self.shortest, max(driven, self.shortest))


def _divide(part: float, whole: float) -> float:
    """Divide; 1 if `whole` isn't positive."""
    return part / whole if whole > 0.0 else 1.0


def run_episodes(
    env: gymnasium.Env[Any, Any],
    policy: Policy,
    count: int,
    seed: int,
    *,
    in_order: bool = False,
    skip: int = 0,
    late_share: float = MAX_LATE_SHARE,
    **options: Any,
) -> Iterator[EpisodeResult]:
    """Run episodes with the seeds `seed`, `seed + 1`, ..., and yield the result of each.

    A fault, or too many late ticks, make an episode not valid; the next reset connects again.

    Args:
        env: an env of this package, wrapped or not.
        policy: maps observations to actions; `reset()`, where it has that method, begins an episode
            of it, and `bind` gets the `PolicyContext` of the env, unless `make_env` gave it that.
        count: number of episodes.
        seed: seed of the first reset.
        in_order: use the env's worlds one after the other, instead of random ones.
        skip: with `in_order`, how many of the worlds other calls use before this one.
        late_share: largest share of late ticks in a valid episode, 0 to 1.
        **options: options of every reset.

    Yields:
        The result of each episode.

    Raises:
        ConfigError: there are fewer worlds than episodes with `in_order`, or `late_share` or
            `env` can't be used.
        LinkError: the robot can't be reached.
        EmergencyStopError: its emergency stop was used.
    """
    if not 0.0 <= late_share <= 1.0:
        raise ConfigError(f"late_share = {late_share!r}: must be a share, 0 to 1")
    inner = env.unwrapped
    if not isinstance(inner, RobotEnv):
        raise ConfigError(f"{env}: only environments of acsar_gym can be evaluated")
    worlds = range(0) if inner.pool is None else inner.pool.numbers
    if in_order and len(worlds) < skip + count:
        raise ConfigError(
            f"{skip + count} episodes in order need as many worlds, but there are {len(worlds)}"
        )
    if not isinstance(policy, FilePolicy) and (bind := getattr(policy, "bind", None)) is not None:
        bind(PolicyContext.of(inner))
    for number in range(count):
        place = {"world": worlds[skip + number]} if in_order else {}
        yield _run_episode(env, inner, policy, seed + number, options | place, late_share)


def _run_episode(
    env: gymnasium.Env[Any, Any],
    inner: RobotEnv,
    policy: Policy,
    seed: int,
    options: dict[str, Any],
    late_share: float,
) -> EpisodeResult:
    """Run one episode, stop the robot, and compute the result."""
    robot = inner.robot
    if (meter := meter_of(robot.link)) is not None:
        meter.metered = True
    observation, info = env.reset(seed=seed, options=options)
    if (begin := getattr(policy, "reset", None)) is not None:
        begin()
    way = _ask_way(inner, info)  # measured afterwards: a robot doesn't wait
    steps, scans, rewards, done = [info], [newest_scan(inner.sensors)], 0.0, False
    while not done:
        observation, reward, terminated, truncated, info = env.step(policy(observation))
        steps.append(info)
        if isinstance(env, TrackedEnv):
            scans.append(newest_scan(inner.sensors))
        rewards += float(reward)
        if robot.safety.reason is Reason.EMERGENCY_STOP:
            raise EmergencyStopError
        done = terminated or truncated
    odom, true = stack_poses(steps, "odom"), stack_poses(steps, "true")
    timing, meter = robot.timing, meter_of(robot.link)
    fault = info.get("fault_reason", "")
    late = timing.lateness.late_share if timing else 0.0
    track = None
    if isinstance(env, TrackedEnv):
        ranges = [scan.ranges for scan in scans if scan is not None]
        seen = np.array(ranges, np.float32) if len(ranges) == len(steps) else None
        track = _make_track(inner, odom, true, seen)
    return EpisodeResult(
        success=info["is_success"] == 1.0,
        collision=info["is_success"] != 1.0 and info["true_contact"] == 1.0,
        started=robot.wire.began,
        ended=robot.wire.stamp,
        path=path_length(odom[:, :2]),
        pose=(info["odom_x"], info["odom_y"], info["odom_theta"]),
        odometry_error=info["odometry_error"],
        ticks=(len(steps) - 1) * inner.ticks_per_step,
        late_ticks=timing.lateness.late_ticks if timing else 0,
        shortest=_measure_way(inner, *way, known=not math.isnan(true[-1, 0])),
        left=_measure_way(inner, *_ask_way(inner, info), known=not math.isnan(true[-1, 0])),
        driven=path_length((odom if math.isnan(true[-1, 0]) else true)[:, :2]),
        turning=total_turning(odom),
        jerk=mean_jerk(odom, inner.ticks_per_step * robot.config.period),
        clearance=_least_clearance(inner, true, touched=info["true_contact"] == 1.0),
        energy=math.nan if meter is None else meter.work,
        scores=tuple(info[name] for name in BARN_SCORES if name in info),
        cross_track=info.get("mean_cross_track_error", math.nan),
        timing=timing,
        fault=fault,
        valid=not fault and late <= late_share,
        seed=seed,
        world=int(info["world"]) if "world" in info else None,
        episode_return=rewards,
        length=len(steps) - 1,
        told={name: float(info[name]) for name in info_names(inner.task)},
        track=track,
    )


def stack_poses(steps: Steps, frame: str) -> Floats:
    """Return the poses (N, 3) by odometry ("odom") or ground truth ("true") [m, m, rad].

    Both are in the odometry frame.
    """
    names = (f"{frame}_x", f"{frame}_y", f"{frame}_theta")
    return np.array([[step[name] for name in names] for step in steps], np.float64)


def total_turning(poses: Floats) -> float:
    """Return the sum of absolute heading changes of poses (N, 3) [rad]."""
    return float(np.abs(np.diff(np.unwrap(poses[:, 2]))).sum())


def mean_jerk(poses: Floats, period: float) -> float:
    """Compute the mean absolute jerk of the speed driven.

    The average of |d^2 v / dt^2|, as in the metrics of Francis et al. 2023 (Principles and
    Guidelines for Evaluating Social Robot Navigation), by second differences of the speed. The
    speed of a step is its displacement along the mean heading, over the period.

    Args:
        poses: (N, 3), one for each env step.
        period: duration of an env step [s].

    Returns:
        The jerk [m/s^3]; NaN for episodes of fewer than three steps.
    """
    if len(poses) < 4:
        return math.nan
    x, y, theta = poses.T
    theta = np.unwrap(theta)
    middle = (theta[1:] + theta[:-1]) / 2.0
    speeds = (np.diff(x) * np.cos(middle) + np.diff(y) * np.sin(middle)) / period
    return float(np.abs(np.diff(speeds, 2)).mean()) / period**2


def _ask_way(env: RobotEnv, info: dict[str, Any]) -> tuple[Pose, Floats | float | None]:
    """Return the robot's pose, by ground truth if known, and its task's shortest way from there."""
    frame = "odom" if math.isnan(info["true_x"]) else "true"
    pose: Pose = (info[f"{frame}_x"], info[f"{frame}_y"], info[f"{frame}_theta"])
    return pose, env.episode.shortest_path(pose)


def _measure_way(env: RobotEnv, pose: Pose, way: Floats | float | None, *, known: bool) -> float:
    """Return the length of a way [m]; NaN where there is none, or obstacles aren't known."""
    assignment = env.episode.assignment
    if isinstance(way, float):
        return way
    if way is None or (assignment.world is not None and not known):
        return math.nan  # a real robot's surroundings aren't known
    radius, world = footprint_radius(env.robot.config), assignment.world or World()
    points = [pose[:2], *((x, y) for x, y in way.tolist())]
    places = [Region(*point_in_world(assignment.start, point)) for point in points]
    return math.fsum(
        remaining_distance(world, radius, place, goal) for place, goal in itertools.pairwise(places)
    )


def _least_clearance(env: RobotEnv, true: Floats, *, touched: bool) -> float:
    """Return the least distance of the footprint to an obstacle at any step [m].

    By ground truth; 0 where the robot touched one, NaN without ground truth or obstacles.
    """
    assignment = env.episode.assignment
    world = assignment.world
    if world is None or not world.obstacles or math.isnan(true[-1, 0]):
        return math.nan
    if touched:
        return 0.0
    places = np.array([to_world(assignment.start, pose) for pose in true.tolist()])
    return max(0.0, footprint_clearance(places, env.robot.config.outline, world))


def footprint_clearance(places: Floats, outline: Outline, world: World) -> float:
    """Compute the least distance of a footprint, at any of several poses, to any obstacle.

    Args:
        places: poses of the base in the frame of the world, (N, 3) [m, m, rad].
        outline: corners of the footprint in the base frame [m].
        world: with the obstacles.

    Returns:
        The distance of the footprint's sides [m]: negative inside a circle, inf without obstacles.
    """
    corners = np.array(outline)
    outer, centres = float(np.hypot(*corners.T).max()), point_clearance(places[:, :2], world)
    near = places[centres <= centres.min() + outer]  # elsewhere the footprint is farther away
    x, y, theta = near.T[..., None]
    cos, sin = np.cos(theta), np.sin(theta)
    ahead, left = corners.T
    placed = np.stack([x + cos * ahead - sin * left, y + sin * ahead + cos * left], axis=-1)
    ends = np.roll(placed, -1, axis=1)
    return float(segment_clearance(placed.reshape(-1, 2), ends.reshape(-1, 2), world).min())


def _make_track(env: RobotEnv, odom: Floats, true: Floats, scans: Floats32 | None) -> DrawnTrack:
    """Put the poses of an episode into the frame of its world."""
    assignment, config = env.episode.assignment, env.robot.config
    odometry, truth = (
        np.array([to_world(assignment.start, pose) for pose in poses.tolist()], np.float32)
        for poses in (odom, true)
    )
    return DrawnTrack(
        odometry=odometry,
        truth=truth if np.isfinite(true).all() else None,
        scans=scans,
        goal=point_in_world(assignment.start, assignment.goal),
        goal_radius=env.task.goal_tolerance,
        period=env.ticks_per_step * config.period,
        robot=config,
        world=assignment.world,
    )


def odometry_errors(results: Sequence[EpisodeResult], log: Path) -> list[float]:
    """Compute the odometry error at the end of each episode from an emulator's log.

    The emulated robot isn't moved back between episodes, so true poses are taken relative to the
    true pose at the reset. Link and emulator both use the machine's monotonic clock.

    Args:
        results: results of the episodes.
        log: log file of the emulator.

    Returns:
        Distance between odometry and ground truth at the end of each episode [m].

    Raises:
        ConfigError: the log holds no true poses.
    """
    stamps, poses = read_true_poses(log)
    errors = []
    for result in results:
        newest = np.searchsorted(stamps, (result.started, result.ended), side="right") - 1
        start, end = (poses[max(0, int(number))] for number in newest)
        x, y, _ = to_odometry(start, end)
        errors.append(math.hypot(x - result.pose[0], y - result.pose[1]))
    return errors


def read_true_poses(log: Path) -> tuple[list[float], list[Pose]]:
    """Read the times [s] and true poses from an emulator's log, whose last line may be cut.

    Raises:
        ConfigError: it can't be read, or holds no true poses.
    """
    lines = reading.read_file(log, MAX_LOG_BYTES).splitlines(keepends=True)
    try:
        events = [json.loads(line) for line in lines if line.endswith(b"\n")]
        truths = [(float(event["t"]), event["pose"]) for event in events if "pose" in event]
        poses: list[Pose] = [(float(x), float(y), float(theta)) for _, (x, y, theta) in truths]
    except (ValueError, TypeError, LookupError) as error:
        raise ConfigError(f"{log}: isn't a log of 'acsar-gym emulate --log FILE'") from error
    if not poses:
        raise ConfigError(f"{log}: holds no true poses; run 'acsar-gym emulate --log FILE'")
    return [stamp for stamp, _ in truths], poses
