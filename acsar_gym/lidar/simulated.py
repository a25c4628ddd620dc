"""A simulated LiDAR that turns: measurements along the way of a simulated robot, with errors.

A single robot and the robots of a batch share it. The LiDAR of an episode, its rate and its errors,
is drawn with the other numbers of `physics.Physics`.
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
    HEADING,
    PLACE_X,
    PLACE_Y,
    TIME,
    Floats,
    Rays,
    Revolution,
    Ring,
    Trail,
    look_back,
    make_rays,
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
    Surroundings,
    cast_lines,
    make_surroundings,
    widest_angle,
)
from acsar_gym.worlds.movers import RADIUS, REACTS, SPEED, goes_straight, locate_mover, may_jump

OLDEST_SIMULATED = 20.0  # age of a measurement: two turns at the slowest randomized rate [s]
EDGE_STEP = 0.3  # neighbours whose distances differ by more are at an edge [m]
SAMPLE_STRIDE = 2**14  # more measurements than a revolution can have: numbers random numbers
RADIUS_SAMPLE, ANGLE_SAMPLE, DROPOUT_SAMPLE, OUTLIER_SAMPLE, MIX_SAMPLE = range(5)
SAMPLE_KINDS = 8


class Beams(NamedTuple):
    """Numbers of each ray of a LiDAR. The first three are those of a Revolution."""

    bearings: Floats
    """(rays,) [rad]."""
    distances: Floats
    """(rays,) [m]."""
    times: Floats
    """(rays,) [s]."""
    origins: Floats
    """(rays, 2): place of the LiDAR then, from its present place, in the robot's present frame
    [m]."""


@jit
def make_beams(rays: int) -> Beams:
    """Return arrays for this number of rays, to be filled."""
    return Beams(np.empty(rays), np.empty(rays), np.empty(rays), np.empty((rays, 2)))


class LidarTraits(NamedTuple):
    """The LiDAR of an episode. See `physics.Physics` for its rate and errors."""

    scan_rate: float
    noise: float
    bias: float
    dropouts: float
    outliers: float
    start: float
    """Time of the reset [s]."""
    phase: float
    """Share of a revolution that was complete at the reset."""
    key: float
    """Selects the random numbers of the errors, 0 to 1."""


class Passers(NamedTuple):
    """The movers around a LiDAR."""

    movers: Floats
    """(movers, numbers): see `worlds.movers.Motions`."""
    pieces: Floats
    """(pieces, 9): of their motions."""
    states: Floats
    """(movers, numbers): see `worlds.crowd.STATE_NUMBERS`."""
    places: Floats
    """(slots, movers, 2): places of people who react, at the times of the robot's trail, in the
    frame of the world [m]."""


@jit
def see_nobody() -> Passers:
    """Return no movers."""
    nothing = np.zeros((0, 0))
    return Passers(nothing, nothing, nothing, np.zeros((0, 0, 2)))


@subroutine
def begin_passing(passers: Passers, trail: Floats) -> None:
    """Fill the places at the first row of a trail. Before it, people walked as they do now."""
    states = passers.states
    places = passers.places
    for row in range(len(places)):
        elapsed = trail[row, TIME] - trail[0, TIME]
        for m in range(len(states)):
            places[row, m, 0] = states[m, X] + elapsed * states[m, VX]
            places[row, m, 1] = states[m, Y] + elapsed * states[m, VY]


@subroutine
def find_passer(
    passers: Passers, m: int, ring: Ring, time: float, period: float
) -> tuple[float, float]:
    """Return the place of a mover at a time [s], interpolated if it reacts, in the world's frame.

    The period [s] is that of the ring.
    """
    if passers.movers[m, REACTS] == 0.0:
        clock = time + passers.states[m, CLOCK]
        x, y, _, _ = locate_mover(passers.movers[m], passers.pieces, clock)
        return x, y

    # People who react have no formula: their places were stored at each tick.
    slots = len(ring.rows)
    places = passers.places
    rows_ago = min(max((ring.rows[ring.newest, TIME] - time) / period, 0.0), slots - 1.0 - 1e-9)
    back = int(rows_ago)
    share = rows_ago - back
    row = (ring.newest - back + slots) % slots
    previous = (ring.newest - back - 1 + slots) % slots
    return (
        places[row, m, 0] + share * (places[previous, m, 0] - places[row, m, 0]),
        places[row, m, 1] + share * (places[previous, m, 1] - places[row, m, 1]),
    )


@loop
def measure_revolution(
    ring: Ring,
    which: int,
    around: Surroundings,
    rays: Rays,
    traits: LidarTraits,
    beams: Beams,
    passers: Passers,
    kind: int = 0,
) -> float:
    """Measure the newest complete revolution of a robot's LiDAR.

    Args:
        ring: True poses, of which the newest is the present pose.
        which: World of the robot among `around`.
        around: Obstacles.
        rays: Rays of the LiDAR.
        traits: The LiDAR of the episode.
        beams: Receives the measurements.
        passers: Movers.
        kind: Kind of the robot among `around`.

    Returns:
        When the revolution ended [s].
    """
    pose = ring.rows[ring.newest]
    x = pose[PLACE_X]
    y = pose[PLACE_Y]
    cos, sin = cos_sin(pose[HEADING])
    # Revolutions are counted from the reset. The one before it has the number -1.
    number: float = np.floor((pose[TIME] - traits.start) * traits.scan_rate - traits.phase)
    ended = traits.start + (number + traits.phase) / traits.scan_rate

    aim_beams(ring, ended, duration=1.0 / traits.scan_rate, rays=rays, beams=beams)
    # Walls and obstacles first, then movers in front of them.
    cast_lines(
        x,
        y,
        cos,
        sin=sin,
        which=which,
        around=around,
        origins=beams.origins,
        ranges=beams.distances,
        kind=kind,
    )
    if len(passers.movers) > 0:
        x += cos * rays.mount_x - sin * rays.mount_y
        y += sin * rays.mount_x + cos * rays.mount_y
        see_passers(
            passers,
            ring,
            place=(x, y, cos, sin),
            rays=rays,
            directions=around.directions[kind],
            beams=beams,
        )
    add_errors(beams.distances, number, traits, rays=rays)
    return ended


@loop
def aim_beams(ring: Ring, ended: float, duration: float, rays: Rays, beams: Beams) -> None:
    """Find the measurements of a revolution that point along the robot's present rays.

    The head turns clockwise, as that of most LiDARs, and passes straight ahead when a revolution
    starts and ends. If a robot turns against it, no measurement points into the gap between the two
    ends. The later end is taken there.
    """
    # The average rate of the robot since the start of the revolution.
    started = ended - duration
    elapsed = ring.rows[ring.newest, TIME] - started
    poses = look_back(ring, started, ended, rays=rays)
    _, _, turned = place_at(poses, started, rays.period)
    robot_rate = -turned / elapsed / FULL_TURN  # [turns/s]

    # The head's bearing, -FULL_TURN * since / duration, and the turn of the robot from then until
    # now add up to the angle of the ray. The sum is linear in the time since the start.
    first = -(rays.start / FULL_TURN + robot_rate * elapsed)
    turn_time = 1.0 / (1.0 / duration - robot_rate)
    for k in range(len(beams.times)):
        turns = first - k * rays.step / FULL_TURN
        since = min((turns - np.floor(turns)) * turn_time, duration)
        beams.times[k] = started + since
        x, y, turned = place_at(poses, beams.times[k], rays.period)
        beams.bearings[k] = rays.start + k * rays.step - turned
        beams.origins[k, 0] = x
        beams.origins[k, 1] = y


@subroutine
def find_reach(beams: Beams, now: float) -> tuple[float, float]:
    """Return when a revolution started [s], and how far the LiDAR moved until now, at most [m]."""
    started = now
    farthest = 0.0
    for k in range(len(beams.times)):
        started = min(started, beams.times[k])
        farthest = max(farthest, beams.origins[k, 0] ** 2 + beams.origins[k, 1] ** 2)
    return started, math.sqrt(farthest) + 1e-3


@jit
def meet_disc(outside: float, along: float) -> float:
    """Return where a beam meets a disc [m]. Infinity if it doesn't.

    Args:
        outside: Square of the distance to the centre, less the square of the radius [m^2].
        along: Distance to the centre along the beam [m].
    """
    # The discriminant of the quadratic equation of beam and circle.
    inside = along * along - outside
    if outside <= 0.0:
        return 0.0
    if inside < 0.0 or along <= 0.0:
        return math.inf
    return max(along - math.sqrt(inside), 0.0)


@subroutine
def see_passers(
    passers: Passers,
    ring: Ring,
    place: tuple[float, float, float, float],
    rays: Rays,
    directions: Floats,
    beams: Beams,
) -> None:
    """Shorten the distances of beams that meet movers, each at the time of the measurement.

    Args:
        passers: Movers.
        ring: True poses of the robot, of which the newest is the present pose.
        place: Present place of the LiDAR [m], and cosine and sine of the robot's heading, in the
            frame of the world.
        rays: Rays of the LiDAR.
        directions: Cosine and sine of each ray's angle.
        beams: Measurements.
    """
    movers = passers.movers
    states = passers.states
    x, y, cos, sin = place
    count = len(beams.times)
    full_turn = FULL_TURN / rays.step
    now = ring.rows[ring.newest, TIME]
    started, margin = find_reach(beams, now)
    elapsed = now - started

    for m in range(len(movers)):
        radius = movers[m, RADIUS]
        if radius < 0.0:
            break

        # A disc that contains the mover at all times of the revolution.
        width = radius + margin + SPEED_SHARE * movers[m, SPEED] * elapsed
        dx = states[m, X] - x
        dy = states[m, Y] - y
        jumps = may_jump(movers[m], started + states[m, CLOCK], elapsed)
        reach = rays.farthest + width
        if dx * dx + dy * dy > reach * reach and not jumps:
            continue
        is_straight = goes_straight(
            movers[m], passers.pieces, clock=now + states[m, CLOCK], ago=elapsed
        )
        if is_straight:
            width = radius + margin + 0.5 * movers[m, SPEED] * elapsed
            dx -= 0.5 * elapsed * states[m, VX]
            dy -= 0.5 * elapsed * states[m, VY]

        # The rays that may meet the disc.
        distance = math.sqrt(dx * dx + dy * dy)
        nearest = distance - width
        half = widest_angle(width, distance) / rays.step
        if jumps:
            nearest = 0.0
            half = full_turn
        middle = (angle_of(dx * cos + dy * sin, dy * cos - dx * sin) - rays.start) / rays.step
        # The disc may lie across the ends of the rays.
        for shift in (-full_turn, 0.0, full_turn):
            low = max(math.ceil(middle + shift - half), 0)
            high = min(math.floor(middle + shift + half), count - 1)
            for k in range(low, high + 1):
                if beams.distances[k] <= nearest:
                    continue

                # The mover at the time of the measurement, from the LiDAR then.
                time = beams.times[k]
                if is_straight:
                    to_x = states[m, X] + (time - now) * states[m, VX]
                    to_y = states[m, Y] + (time - now) * states[m, VY]
                else:
                    to_x, to_y = find_passer(passers, m, ring, time=time, period=rays.period)
                dx = to_x - x
                dy = to_y - y
                ox = dx * cos + dy * sin - beams.origins[k, 0]
                oy = dy * cos - dx * sin - beams.origins[k, 1]
                along = ox * directions[k, 0] + oy * directions[k, 1]
                hit = meet_disc(ox * ox + oy * oy - radius * radius, along)
                beams.distances[k] = min(beams.distances[k], hit)


@loop
def add_errors(distances: Floats, number: float, traits: LidarTraits, rays: Rays) -> None:
    """Add a LiDAR's errors to the exact distances of its revolution of this number.

    A distance of 0 is a failed measurement.
    """
    count = len(distances)
    is_full_turn = abs(FULL_TURN / rays.step - count) < 1e-6
    after_last = distances[0] if is_full_turn else distances[count - 1]
    # Random numbers are functions of revolution and ray, so that a batch draws the same.
    base = (int(number) + 1) * SAMPLE_STRIDE * SAMPLE_KINDS
    kept_noise = 0.0
    for k in range(count):
        true = distances[k]
        sample = base + k * SAMPLE_KINDS

        # Noise. A pair of uniform numbers gives two normal ones (Box and Muller, 1958).
        error = traits.bias
        if traits.noise > 0.0:
            if k % 2 == 0:
                uniform = hash_sample(traits.key, sample + RADIUS_SAMPLE)
                radius = traits.noise * math.sqrt(-2.0 * math.log(1.0 - uniform))
                c, s = cos_sin(FULL_TURN * hash_sample(traits.key, sample + ANGLE_SAMPLE))
                error += radius * c
                kept_noise = radius * s
            else:
                error += kept_noise

        # At an edge, the beam can meet both sides.
        if traits.outliers > 0.0:
            neighbour = distances[k + 1] if k + 1 < count else after_last
            if (
                abs(neighbour - true) > EDGE_STEP
                and hash_sample(traits.key, sample + OUTLIER_SAMPLE) < traits.outliers
            ):
                true += (neighbour - true) * hash_sample(traits.key, sample + MIX_SAMPLE)

        measured = true + error
        if true >= rays.farthest or (
            traits.dropouts > 0.0
            and hash_sample(traits.key, sample + DROPOUT_SAMPLE) < traits.dropouts
        ):
            measured = 0.0
        elif measured <= 0.0:
            measured = 1e-6  # something very near, not a failure
        distances[k] = measured


def draw_episode(rng: np.random.Generator) -> tuple[float, float]:
    """Draw the phase of the revolution at a reset, and the key of its errors."""
    phase, key = rng.random(2).tolist()
    return phase, key


class SimulatedLidar:
    """The LiDAR of a simulated robot. It turns all the time, also before the episode.

    Its random numbers are the phase of the revolution at the reset, and a key that determines all
    errors.

    Attributes:
        oldest: Largest age that a measurement reaches in the episode [s].
    """

    oldest = 0.0

    def __init__(self, link: Link, config: RobotConfig) -> None:
        self._link = link
        self._config = config
        self._rays = make_rays(config)

    def reset(self, scene: Scene, rng: np.random.Generator) -> None:
        """Take over the scene's obstacles and physics. Draw the phase and the key of the errors."""
        config = self._config
        self._around = make_surroundings(scene.world, ray_spec(config), config)

        # Without randomization, the errors are those of the robot's file.
        physics = scene.physics or compute_physics(config)
        phase, key = draw_episode(rng)
        self._traits = LidarTraits(
            scan_rate=physics.scan_rate,
            noise=physics.range_noise,
            bias=physics.range_bias,
            dropouts=physics.range_dropouts,
            outliers=physics.range_outliers,
            start=self._link.now(),
            phase=phase,
            key=key,
        )

        # A measurement is used until the next revolution is complete.
        self.oldest = 2.0 / physics.scan_rate
        self._trail = Trail(self.oldest, config.period)
        self._passers = see_nobody()
        self.poll(self._link.truth, self._link.now())

    def poll(self, truth: GroundTruth | None, now: float) -> None:
        """Mark the places of the robot and of the movers after a tick."""
        is_first = self._trail.newest < 0
        self._trail.mark(now, truth.pose if truth else (0.0, 0.0, 0.0))
        if truth is None or truth.crowd is None:
            return

        crowd = truth.crowd
        rows = self._trail.rows
        if is_first:
            # The states are a view: they change with the crowd. Places are copies.
            places = np.zeros((len(rows), len(crowd.states), 2))
            motions = crowd.motions
            self._passers = Passers(motions.movers[0], motions.pieces[0], crowd.states, places)
            begin_passing(self._passers, rows)
        self._passers.places[self._trail.newest] = crowd.states[:, [X, Y]]

    def scan(self) -> Revolution:
        """Measure the newest complete revolution along the robot's present rays."""
        beams = make_beams(self._config.lidar.rays)
        ended = measure_revolution(
            self._trail.ring,
            0,
            self._around,
            rays=self._rays,
            traits=self._traits,
            beams=beams,
            passers=self._passers,
        )
        return Revolution(beams.bearings, beams.distances, beams.times, ended)

    def close(self) -> None:
        """Do nothing, because there is no device."""
