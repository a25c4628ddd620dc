"""A simulated LiDAR that turns: measurements along the way of a simulated robot, with errors.

A single robot and the robots of a batch share all of it. What an episode's LiDAR is like, the rate
at which it turns and its errors, is among the numbers of `physics.Physics`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from acsar_gym.config import RobotConfig
from acsar_gym.hashing import hash_sample
from acsar_gym.jit import jit, loop
from acsar_gym.lidar.scan import (
    FULL_TURN,
    Floats,
    Rays,
    Revolution,
    Trail,
    look_back,
    make_rays,
    newest_revolution,
    place_at,
    ray_spec,
)
from acsar_gym.links.base import Link
from acsar_gym.physics.model import compute_physics
from acsar_gym.trigonometry import cos_sin
from acsar_gym.truth import GroundTruth
from acsar_gym.worlds import Scene
from acsar_gym.worlds.geometry import Obstacles, Surroundings, cast_lines, make_surroundings

OLDEST_SIMULATED = 20.0  # age of a measurement: two turns at the slowest randomized rate [s]
EDGE_STEP = 0.3  # neighbours whose distances differ by more are at an edge [m]
SAMPLE_STRIDE = 2**14  # more measurements than a revolution can have; numbers random numbers
RADIUS_SAMPLE, ANGLE_SAMPLE, DROPOUT_SAMPLE, OUTLIER_SAMPLE, MIX_SAMPLE = range(5)
SAMPLE_KINDS = 8


class Beams(NamedTuple):
    """What is computed for each ray of a LiDAR; the first three are those of a Revolution."""

    bearings: Floats
    """(rays,) [rad]."""
    distances: Floats
    """(rays,) [m]."""
    times: Floats
    """(rays,) [s]."""
    origins: Floats
    """(rays, 2): where the LiDAR was then, from its place now in the robot's present frame [m]."""


@jit
def make_beams(rays: int) -> Beams:
    """Arrays for so many rays, to be filled."""
    return Beams(np.empty(rays), np.empty(rays), np.empty(rays), np.empty((rays, 2)))


class LidarTraits(NamedTuple):
    """What an episode's LiDAR is like; see `physics.Physics`."""

    scan_rate: float
    noise: float
    bias: float
    dropouts: float
    outliers: float


@loop
def aim_beams(
    trail: Floats, newest: int, ended: float, duration: float, rays: Rays, beams: Beams
) -> None:
    """Find the measurements of a revolution that point along the robot's present rays.

    The head turns clockwise, as that of most LiDARs, and passes straight ahead when a revolution
    begins and ends. Where a robot turns against it, no measurement points into the gap between the
    two ends; the later one is taken to.
    """
    begun = ended - duration
    seen = look_back(trail, newest, begun, ended, rays)
    since_begun = trail[newest, 0] - begun
    _, _, turned = place_at(seen, begun, rays.period)
    rate = -turned / since_begun / FULL_TURN  # of the robot [turns/s]
    first, full = -(rays.start / FULL_TURN + rate * since_begun), 1.0 / (1.0 / duration - rate)
    for k in range(len(beams.times)):
        # The head's bearing -FULL_TURN * since / duration, and where the robot still turns until
        # now, make the ray's: that is linear in the time since the revolution began.
        part = first - k * rays.step / FULL_TURN
        since = min((part - np.floor(part)) * full, duration)
        beams.times[k] = begun + since
        x, y, turned = place_at(seen, beams.times[k], rays.period)
        beams.bearings[k] = rays.start + k * rays.step - turned
        beams.origins[k, 0], beams.origins[k, 1] = x, y


@loop
def add_errors(
    distances: Floats, key: float, number: float, traits: LidarTraits, rays: Rays
) -> None:
    """Add a LiDAR's errors to the exact distances of a revolution; 0 is no measurement."""
    count = len(distances)
    whole = abs(FULL_TURN / rays.step - count) < 1e-6  # the last ray is beside the first one
    after_last = distances[0] if whole else distances[count - 1]
    base = (int(number) + 1) * SAMPLE_STRIDE * SAMPLE_KINDS
    other = 0.0
    for k in range(count):
        true, sample = distances[k], base + k * SAMPLE_KINDS
        error = traits.bias
        if traits.noise > 0.0:
            if k % 2 == 0:
                radius = traits.noise * math.sqrt(
                    -2.0 * math.log(1.0 - hash_sample(key, sample + RADIUS_SAMPLE))
                )
                c, s = cos_sin(FULL_TURN * hash_sample(key, sample + ANGLE_SAMPLE))
                error, other = error + radius * c, radius * s
            else:
                error += other
        if traits.outliers > 0.0:
            beside = distances[k + 1] if k + 1 < count else after_last
            if (
                abs(beside - true) > EDGE_STEP
                and hash_sample(key, sample + OUTLIER_SAMPLE) < traits.outliers
            ):
                true += (beside - true) * hash_sample(key, sample + MIX_SAMPLE)
        measured = true + error
        if true >= rays.farthest or (
            traits.dropouts > 0.0 and hash_sample(key, sample + DROPOUT_SAMPLE) < traits.dropouts
        ):
            measured = 0.0
        elif measured <= 0.0:
            measured = 1e-6  # something very near, not nothing
        distances[k] = measured


@loop
def measure_revolution(  # noqa: PLR0913, PLR0917 - compiled, so no keywords
    trail: Floats,
    newest: int,
    which: int,
    around: Surroundings,
    rays: Rays,
    episode: tuple[float, float, float],
    traits: LidarTraits,
    beams: Beams,
    kind: int = 0,
) -> float:
    """Measure the newest complete revolution of a robot's LiDAR.

    Returns:
        When the revolution ended [s].
    """
    first, phase, key = episode
    number, ended = newest_revolution(trail[newest, 0], first, traits.scan_rate, phase)
    aim_beams(trail, newest, ended, 1.0 / traits.scan_rate, rays, beams)
    x, y, (cos, sin) = trail[newest, 1], trail[newest, 2], cos_sin(trail[newest, 3])
    cast_lines(x, y, cos, sin, which, around, beams.origins, beams.distances, kind)
    add_errors(beams.distances, key, number, traits, rays)
    return ended


def draw_episode(rng: np.random.Generator) -> tuple[float, float]:
    """Draw the phase of the revolution at a reset, and the key of its errors."""
    phase, key = rng.random(2).tolist()
    return phase, key


class SimulatedLidar:
    """The LiDAR of a simulated robot. It turns all the time, from before the episode on.

    Its random numbers are the phase of the revolution at the reset, and a key from which all errors
    follow.

    Attributes: `oldest`, the age that a measurement reaches in the episode, at most [s].
    """

    oldest = 0.0

    def __init__(self, link: Link, config: RobotConfig) -> None:
        self._link = link
        self._config = config
        self._around = make_surroundings(Obstacles(), ray_spec(config), 1, config)
        self._rays = make_rays(config)
        self._episode = (0.0, 0.0, 0.0)

    def reset(self, scene: Scene, rng: np.random.Generator) -> None:
        """Take over the scene's obstacles and physics; draw the phase and the key of the errors."""
        world, config = scene.world, self._config
        obstacles = Obstacles() if world is None else Obstacles(world.circles, world.segments)
        self._around = make_surroundings(obstacles, ray_spec(config), 1, config)
        physics = scene.physics or compute_physics(config)
        self._traits = LidarTraits(
            physics.scan_rate,
            physics.range_noise,
            physics.range_bias,
            physics.range_dropouts,
            physics.range_outliers,
        )
        self._episode = (self._link.now(), *draw_episode(rng))
        self.oldest = 2.0 / physics.scan_rate
        self._trail = Trail(self.oldest, config.period)
        self.poll(self._link.truth, self._link.now())

    def poll(self, truth: GroundTruth | None, now: float) -> None:
        """Mark where the robot is after a tick."""
        self._trail.mark(now, truth.pose if truth else (0.0, 0.0, 0.0))

    def scan(self) -> Revolution:
        """Measure the newest complete revolution, where the robot's present rays point."""
        beams, trail = make_beams(self._config.lidar.rays), self._trail
        ended = measure_revolution(
            trail.rows,
            trail.newest,
            0,
            self._around,
            self._rays,
            self._episode,
            self._traits,
            beams,
        )
        return Revolution(beams.bearings, beams.distances, beams.times, ended)

    def close(self) -> None:
        """Do nothing: there is no device."""
