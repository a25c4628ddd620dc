"""LiDARs: the contract, the sensor that observes their ranges, and the simulated and replayed one.

A scan is as from a single pose, though a real LiDAR turns while the robot drives: `scan_turn` moves
its measurements by what the robot drove since, or will have driven, at its present twist.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import LidarConfig, RobotConfig
from acsar_gym.config.footprint import Outline, outline_reach
from acsar_gym.errors import LidarError
from acsar_gym.jit import loop
from acsar_gym.links.base import Link, ScannedLink
from acsar_gym.odometry import Odometry
from acsar_gym.physics.body import GroundTruth
from acsar_gym.sensors.base import LIDAR, Sensor
from acsar_gym.worlds import Scene
from acsar_gym.worlds.geometry import Obstacles, RaySpec, cast_rays, make_surroundings

Floats = NDArray[np.float64]
STALE_PERIODS = 2.0
"""A scan that is older than this many periods of the LiDAR counts as stale."""


@dataclass(frozen=True, eq=False, slots=True)
class Scan:
    """One revolution of a LiDAR."""

    ranges: NDArray[np.float64]
    """(rays,): range in each direction [m], within min_range to max_range, counter-clockwise from
    -field_of_view / 2 of the robot's x axis; max_range where nothing was measured."""
    stamp: float
    """When the revolution ended, on the link's clock [s]."""


class Lidar(Protocol):
    """A LiDAR, simulated or real. Its scans are stamped on the clock of the robot's link."""

    def reset(self, scene: Scene, rng: np.random.Generator) -> None:
        """Begin an episode; opens a device that is closed.

        Args:
            scene: the world, and the robot's start in it.
            rng: for the noise.

        Raises:
            LidarError: the device can't be opened, or doesn't measure.
        """

    def scan(self) -> Scan:
        """Return the newest scan; doesn't wait for one.

        Raises:
            LidarError: it is older than the configured time-out, or the device is gone.
        """

    def close(self) -> None:
        """Stop the motor and close the device; idempotent."""


class LidarSensor(Sensor):
    """Adds a LiDAR's ranges to the observation: range / `max_range`, 0 to 1, one for each ray.

    Attributes: `lidar`, which measures, at its own rate; `scan`, its newest scan.
    """

    name, low, high = LIDAR, 0.0, 1.0
    uses_truth = False

    def __init__(self, lidar: Lidar, config: RobotConfig) -> None:
        self.lidar = lidar
        self.config = config
        self.size = config.lidar.rays
        self._scan: Scan | None = None

    @property
    def scan(self) -> Scan:
        """The newest scan at the end of the last tick. LidarError before a reset."""
        if self._scan is None:
            raise LidarError("the LiDAR has no scan yet", "call reset() first")
        return self._scan

    def follow(self, odometry: Odometry) -> None:
        """Tell a LiDAR that has a method `follow` how the robot moves."""
        if callable(follow := getattr(self.lidar, "follow", None)):
            follow(odometry)

    def reset(self, scene: Scene, rng: np.random.Generator) -> None:
        """Begin an episode; opens a device that is closed. LidarError where that fails."""
        self.lidar.reset(scene, rng)

    def poll(self, truth: GroundTruth | None, now: float) -> None:
        """Take the newest scan. LidarError where it is too old, or the device is gone."""
        self._scan = self.lidar.scan()

    def read(self, truth: GroundTruth | None, now: float) -> NDArray[np.float64]:
        """Return range / `max_range` of each ray, (rays,)."""
        return self.scan.ranges / self.config.lidar.max_range

    def info(self, now: float) -> dict[str, float]:
        """`scan_age` [s], and `scan_stale`: 1 where the age is over two periods of the LiDAR."""
        age = now - self.scan.stamp
        return {"scan_age": age, "scan_stale": float(age > stale_after(self.config))}

    def close(self) -> None:
        """Stop the motor and close the device; idempotent."""
        self.lidar.close()

    @property
    def layout(self) -> str:
        """Number of rays, field of view and longest range, in words."""
        lidar = self.config.lidar
        return f"{lidar.rays} ranges over {lidar.field_of_view:.4g} rad to {lidar.max_range:g} m"


def newest_scan(sensors: Sequence[Sensor]) -> Scan | None:
    """The newest scan of the LiDAR among a robot's sensors; None without a LiDAR."""
    first = sensors[0] if sensors else None
    return first.scan if isinstance(first, LidarSensor) else None


def ray_spec(config: RobotConfig) -> RaySpec:
    """The rays of a robot's LiDAR."""
    lidar = config.lidar
    return RaySpec(lidar.rays, lidar.max_range, lidar.field_of_view)


def footprint_edges(config: RobotConfig) -> NDArray[np.float64]:
    """Distance from the LiDAR to the edge of the footprint along each ray, (rays,) [m]."""
    return _edges(config.outline, ray_spec(config), config.lidar_x_offset, config.lidar_y_offset)


@lru_cache(maxsize=16)
def _edges(outline: Outline, rays: RaySpec, x: float, y: float) -> NDArray[np.float64]:
    """As `edges`; the same array for the same robot."""
    found: NDArray[np.float64] = np.array(
        [outline_reach(outline, (x, y), angle) for angle in rays.angles().tolist()]
    )
    return found


def stale_after(config: RobotConfig) -> float:
    """Age from which a scan counts as stale [s]."""
    return STALE_PERIODS / config.lidar.rate


class SimulatedLidar:
    """Exact rays from the true pose of a simulated robot, with noise and drop-outs.

    A scan is taken at the reset and then at the first tick of every period of the LiDAR. All rays
    of a scan start from the same pose.
    """

    def __init__(self, link: Link, config: RobotConfig) -> None:
        self._link = link
        self._config = config
        self._settings = config.lidar
        self._around = make_surroundings(Obstacles(), ray_spec(config), 1, config)
        self._rng = np.random.default_rng(0)
        self._scan = Scan(np.full(config.lidar.rays, config.lidar.max_range), 0.0)
        self._first, self._taken = 0.0, 0

    def reset(self, scene: Scene, rng: np.random.Generator) -> None:
        """Take over the scene's obstacles, and the generator for the noise."""
        world = scene.world
        obstacles = Obstacles() if world is None else Obstacles(world.circles, world.segments)
        self._around = make_surroundings(obstacles, ray_spec(self._config), 1, self._config)
        self._rng = rng
        self._first, self._taken = self._link.now(), 0

    def scan(self) -> Scan:
        """Return the newest scan; takes one where it is due."""
        now, lidar = self._link.now(), self._settings
        if now - self._first > self._taken / lidar.rate - 1e-9:
            self._taken = 1 + math.floor((now - self._first) * lidar.rate + 1e-9)
            truth, ranges = self._link.truth, np.empty(lidar.rays)
            x, y, theta = truth.pose if truth else (0.0, 0.0, 0.0)
            cast_rays(x, y, math.cos(theta), math.sin(theta), 0, self._around, ranges)
            if noise_draws(lidar):
                uniforms = self._rng.random(noise_draws(lidar))
                limits = lidar.min_range, lidar.max_range
                add_noise(ranges, uniforms, lidar.noise, lidar.dropouts, *limits)
            else:
                np.maximum(ranges, lidar.min_range, out=ranges)
            self._scan = Scan(ranges, now)
        return self._scan

    def close(self) -> None:
        """Do nothing: there is no device."""


def noise_draws(lidar: LidarConfig) -> int:
    """How many uniform samples one noisy scan consumes."""
    pairs = (lidar.rays + 1) // 2 if lidar.noise > 0.0 else 0
    return 2 * pairs + (lidar.rays if lidar.dropouts > 0.0 else 0)


@loop
def add_noise(
    ranges: NDArray[np.float64],
    uniforms: NDArray[np.float64],
    noise: float,
    dropouts: float,
    nearest: float,
    farthest: float,
) -> None:
    """Apply noise, drop-outs and limits to true ranges, in place.

    Args:
        ranges: (rays,), true ranges [m]; changed.
        uniforms: samples of [0, 1), as many as `noise_draws` says: two for each pair of rays (Box
            and Muller 1958), then one for each ray that may drop out.
        noise: standard deviation of ranges that meet something [m].
        dropouts: share of rays that measure nothing, which read `farthest`.
        nearest: least range [m].
        farthest: longest range [m].
    """
    rays, used = len(ranges), 0
    if noise > 0.0:
        for pair in range((rays + 1) // 2):
            radius = noise * math.sqrt(-2.0 * math.log(1.0 - uniforms[2 * pair]))
            angle = 2.0 * math.pi * uniforms[2 * pair + 1]
            for k in range(2 * pair, min(2 * pair + 2, rays)):
                if ranges[k] < farthest:
                    turned = math.cos(angle) if k == 2 * pair else math.sin(angle)
                    ranges[k] += radius * turned
        used = 2 * ((rays + 1) // 2)
    for k in range(rays):
        ranges[k] = min(max(ranges[k], nearest), farthest)
        if dropouts > 0.0 and uniforms[used + k] < dropouts:
            ranges[k] = farthest


Turn = tuple[Floats, Floats]
"""A revolution: bearings [rad], counter-clockwise from the LiDAR's zero, and distances [m], 0 where
nothing was measured."""
RAY_REACH = 0.75
"""A ray takes a measurement that is this near, in parts of the angle between two measurements."""
READ_DELAY = 0.5
"""When a scan is read, in revolutions after its end: at any time from 0 to 1."""
GAP_STEPS = 2.0
"""Steps between two measurements that driving may leave between them."""


def scan_turn(
    turn: Turn, duration: float, twist: tuple[float, float], config: RobotConfig, late: int = 0
) -> Floats:
    """Compute the ranges of a scan from one revolution of a robot that moves.

    They are as seen from where the robot will be half a revolution after the end of this one: the
    scan is the newest one for a whole revolution.

    Args:
        turn: the revolution.
        duration: of it [s].
        twist: of the robot at its end, linear [m/s] and angular [rad/s].
        config: of the robot.
        late: how many measurements of the next revolution had come when this one was complete.

    Returns:
        (rays,) [m], within min_range to max_range.
    """
    bearings, distances = turn
    (linear, angular), count = twist, len(bearings)
    if twist == (0.0, 0.0) or not count:
        return bin_ranges(bearings, distances, config.lidar)
    (places,), spacing = np.nonzero(distances), 2.0 * math.pi / count
    measured = distances > 0.0
    if len(places):  # even bearings where nothing was measured: an RPLIDAR gives none there
        even = bearings[places[0]] - (np.arange(count) - places[0]) * spacing
        bearings = np.where(measured, bearings, even)
    # Each measurement moves with the robot on an arc, for the time since it was taken.
    ages = ((np.arange(count, 0, -1) + late) / count + READ_DELAY) * duration
    turned, (mount_x, mount_y) = angular * ages, (config.lidar_x_offset, config.lidar_y_offset)
    chord = linear * ages * np.sinc(turned / 2.0 / math.pi)
    x = mount_x + distances * np.cos(bearings) - chord * np.cos(turned / 2.0)
    y = mount_y + distances * np.sin(bearings) - chord * np.sin(turned / 2.0)
    cos, sin = np.cos(turned), np.sin(turned)
    x, y = cos * x + sin * y - mount_x, cos * y - sin * x - mount_y
    seen = np.where(measured, np.arctan2(y, x), bearings - turned)
    gap = GAP_STEPS * spacing + abs(angular) * duration
    return bin_ranges(seen, np.where(measured, np.hypot(x, y), 0.0), config.lidar, gap)


def bin_ranges(bearings: Floats, distances: Floats, lidar: LidarConfig, gap: float = 0.0) -> Floats:
    """Compute the ranges of a scan from one revolution.

    Each ray takes the measurement whose bearing is next to it, while a simulated ray has
    exactly its own bearing.

    Args:
        bearings: counter-clockwise [rad].
        distances: of the same shape [m]; 0 where nothing was measured.
        lidar: configuration of the rays.
        gap: width of the gaps that a moving robot leaves between bearings [rad]. A ray in a gap
            takes what is next to it; that may be a bearing where nothing was measured.

    Returns:
        (rays,) [m], within min_range to max_range.
    """
    spec = RaySpec(lidar.rays, lidar.max_range, lidar.field_of_view)
    spacing = 2.0 * math.pi / max(len(bearings), 1)
    measured = distances > 0.0
    ranges = np.full(spec.rays, np.inf)
    if measured.any():
        seen, rays = _wrapped(bearings), spec.angles()
        ranges = _next_to(rays, seen[measured], distances[measured], RAY_REACH * spacing)
        if gap:
            around = _next_to(rays, seen, np.where(measured, distances, np.inf), gap)
            ranges = np.where(np.isfinite(ranges), ranges, around)
    clamped: Floats = np.clip(ranges, lidar.min_range, lidar.max_range)
    return clamped


def _next_to(directions: Floats, bearings: Floats, distances: Floats, reach: float) -> Floats:
    """The distance whose bearing is next to each direction.

    Inf where none is within `reach` [rad].
    """
    order = np.argsort(bearings)
    bearings, distances = bearings[order], distances[order]
    right = np.searchsorted(bearings, _wrapped(directions)) % len(bearings)
    both = np.stack((right - 1, right))
    off = np.abs(_wrapped(bearings[both] - directions))
    nearest = off.argmin(axis=0), np.arange(len(directions))
    return np.where(off[nearest] <= reach, distances[both[nearest]], np.inf)


def _wrapped(angles: Floats) -> Floats:
    """Wrap angles to [-pi, pi) [rad]."""
    return (angles + math.pi) % (2.0 * math.pi) - math.pi


class ReplayedLidar:
    """Plays the scans of a recording, beside the bytes of its wire.

    Args:
        tape: the link that replays it.
        link: the robot's link, with the recorded ground truth where the recording was a simulation.
        config: of the robot.
    """

    def __init__(self, tape: ScannedLink, link: Link, config: RobotConfig) -> None:
        self._tape = tape
        self._link = link
        self._config = config
        self._rng = np.random.default_rng(0)
        self._scan: Scan | None = None

    def reset(self, scene: Scene, rng: np.random.Generator) -> None:
        """Begin an episode."""
        self._rng = rng
        self._scan = None

    def scan(self) -> Scan:
        """Return the scan that was the newest one; LidarError where none was recorded."""
        found = self._tape.scan()
        if found is None:
            raise LidarError("the recording has no scan", "was it made with a LiDAR?")
        stamp, ranges = found
        rays = self._config.lidar.rays
        if len(ranges) != rays:
            raise LidarError(
                f"the recording's scans have {len(ranges)} rays, the robot's LiDAR {rays}",
                "replay it with the robot that was recorded",
            )
        if self._scan is None or stamp != self._scan.stamp:
            self._scan = Scan(ranges, stamp)
            if self._link.truth is not None:  # a simulated LiDAR drew noise here
                self._rng.random(noise_draws(self._config.lidar))
        return self._scan

    def close(self) -> None:
        """Do nothing: there is no device."""
