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
from acsar_gym.jit import jit, loop, subroutine
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
from acsar_gym.trigonometry import angle_of, cos_sin
from acsar_gym.truth import GroundTruth
from acsar_gym.worlds import Scene
from acsar_gym.worlds.crowd import CLOCK, SPEED_SHARE, VX, VY, X, Y
from acsar_gym.worlds.geometry import (
    Obstacles,
    Surroundings,
    cast_lines,
    make_surroundings,
    widest_angle,
)
from acsar_gym.worlds.movers import RADIUS, REACTS, SPEED, goes_straight, locate_mover, may_jump

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


class Passers(NamedTuple):
    """The movers around a LiDAR."""

    movers: Floats
    """(movers, numbers): see `worlds.movers.Motions`."""
    pieces: Floats
    """(pieces, 9): of their motions."""
    states: Floats
    """(movers, numbers): see `worlds.crowd.STATE_NUMBERS`."""
    places: Floats
    """(slots, movers, 2): where people who react were at the times of the robot's trail, x, y in
    the frame of the world [m]."""


@jit
def see_nobody() -> Passers:
    """No movers."""
    nothing = np.zeros((0, 0))
    return Passers(nothing, nothing, nothing, np.zeros((0, 0, 2)))


@subroutine
def begin_passing(passers: Passers, trail: Floats) -> None:
    """Fill the places of a trail that has begun; before it, people walked as they do now."""
    now, states, places = trail[0, 0], passers.states, passers.places
    for row in range(len(places)):
        for m in range(len(states)):
            places[row, m, 0] = states[m, X] + (trail[row, 0] - now) * states[m, VX]
            places[row, m, 1] = states[m, Y] + (trail[row, 0] - now) * states[m, VY]


@subroutine
def find_passer(
    passers: Passers, m: int, trail: Floats, newest: int, time: float, period: float
) -> tuple[float, float]:
    """Where a mover was at a time [s], in the world's frame; people's ways are interpolated."""
    if passers.movers[m, REACTS] == 0.0:
        clock = time + passers.states[m, CLOCK]
        x, y, _, _ = locate_mover(passers.movers, m, passers.pieces, clock)
        return x, y
    slots, places = len(trail), passers.places
    ago = min(max((trail[newest, 0] - time) / period, 0.0), slots - 1.0 - 1e-9)
    back = int(ago)
    row, before = (newest - back + slots) % slots, (newest - back - 1 + slots) % slots
    share = ago - back
    return (
        places[row, m, 0] + share * (places[before, m, 0] - places[row, m, 0]),
        places[row, m, 1] + share * (places[before, m, 1] - places[row, m, 1]),
    )


@subroutine
def see_passers(  # noqa: C901, PLR0912 - one loop over rays, as `see_circle`
    passers: Passers,
    trail: Floats,
    newest: int,
    place: tuple[float, float, float, float],
    rays: Rays,
    directions: Floats,
    beams: Beams,
) -> None:
    """Shorten the distances of beams that meet movers where they were when each was measured.

    `place` is the LiDAR's now, x, y, and cosine and sine of the robot's heading, in the frame of
    the world. The rays that may meet a mover are those around where it is, or was on the way.
    """
    x, y, cos, sin = place
    count, turn = len(beams.times), FULL_TURN / rays.step
    now, begun, margin = trail[newest, 0], beams.times[0], 0.0
    for k in range(count):
        begun = min(begun, beams.times[k])
        margin = max(margin, beams.origins[k, 0] ** 2 + beams.origins[k, 1] ** 2)
    margin, ago = math.sqrt(margin) + 1e-3, now - begun
    movers, states = passers.movers, passers.states
    for m in range(len(movers)):
        radius = movers[m, RADIUS]
        if radius < 0.0:
            break
        wide = radius + margin + SPEED_SHARE * movers[m, SPEED] * ago
        dx, dy = states[m, X] - x, states[m, Y] - y
        jumps, far = may_jump(movers, m, begun + states[m, CLOCK], ago), rays.farthest + wide
        if dx * dx + dy * dy > far * far and not jumps:
            continue
        is_straight = goes_straight(movers, m, passers.pieces, now + states[m, CLOCK], ago)
        if is_straight:
            wide = radius + margin + 0.5 * movers[m, SPEED] * ago
            dx, dy = dx - 0.5 * ago * states[m, VX], dy - 0.5 * ago * states[m, VY]
        apart = math.sqrt(dx * dx + dy * dy)
        nearest, half = apart - wide, widest_angle(wide, apart) / rays.step
        if jumps:
            nearest, half = 0.0, turn
        middle = (angle_of(dx * cos + dy * sin, dy * cos - dx * sin) - rays.start) / rays.step
        for shift in (-turn, 0.0, turn):
            low = max(math.ceil(middle + shift - half), 0)
            high = min(math.floor(middle + shift + half), count - 1)
            for k in range(low, high + 1):
                if beams.distances[k] <= nearest:
                    continue
                time = beams.times[k]
                if is_straight:
                    to_x = states[m, X] + (time - now) * states[m, VX]
                    to_y = states[m, Y] + (time - now) * states[m, VY]
                else:
                    to_x, to_y = find_passer(passers, m, trail, newest, time, rays.period)
                dx, dy = to_x - x, to_y - y
                ox = dx * cos + dy * sin - beams.origins[k, 0]
                oy = dy * cos - dx * sin - beams.origins[k, 1]
                outside = ox * ox + oy * oy - radius * radius
                along = ox * directions[k, 0] + oy * directions[k, 1]
                inside = along * along - outside
                if outside <= 0.0:
                    beams.distances[k] = 0.0
                elif inside >= 0.0 and along > 0.0:
                    hit = max(along - math.sqrt(inside), 0.0)
                    beams.distances[k] = min(beams.distances[k], hit)


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
    passers: Passers,
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
    if len(passers.movers) > 0:
        x += cos * rays.mount_x - sin * rays.mount_y
        y += sin * rays.mount_x + cos * rays.mount_y
        directions = around.directions[kind]
        see_passers(passers, trail, newest, (x, y, cos, sin), rays, directions, beams)
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
        self._passers = see_nobody()
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
        self._passers = see_nobody()
        self.poll(self._link.truth, self._link.now())

    def poll(self, truth: GroundTruth | None, now: float) -> None:
        """Mark where the robot and the movers are after a tick."""
        begins = self._trail.newest < 0
        self._trail.mark(now, truth.pose if truth else (0.0, 0.0, 0.0))
        if truth is not None and truth.crowd is not None:
            crowd, rows = truth.crowd, self._trail.rows
            if begins:
                places = np.zeros((len(rows), len(crowd.states), 2))
                movers, pieces = crowd.motions.movers[0], crowd.motions.pieces[0]
                self._passers = Passers(movers, pieces, crowd.states, places)
                begin_passing(self._passers, rows)
            self._passers.places[self._trail.newest] = crowd.states[:, :2]

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
            self._passers,
        )
        return Revolution(beams.bearings, beams.distances, beams.times, ended)

    def close(self) -> None:
        """Do nothing: there is no device."""
