"""What moves around a robot, found in the scans of its LiDAR: tracks with a place and a velocity.

An object that a scan shows whole, nearer than what is beside it, is a cluster of rays. A track
follows it: a Kalman filter of a constant velocity in the odometry frame (Bar-Shalom, Li &
Kirubarajan, "Estimation with Applications to Tracking and Navigation", 2001), corrected at the time
at which the LiDAR measured. Each track stands at first. It moves when it is fast, has come far,
isn't where the map remembers something, and has left a place that the LiDAR looks through now, or
comes straight at it. The map doesn't remember what moves: rays that meet it aren't counted, and the
cells that it was the first to hit while it stood are cleared.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from acsar_gym.jit import jit, subroutine
from acsar_gym.lidar.scan import FULL_TURN, Rays
from acsar_gym.sensors.map.seen import (
    CELLS,
    COUNT_FREE,
    LAST_CELL,
    OCCUPIED,
    Bytes,
    Floats,
    Grid,
    cell_at,
    lower_costs,
)
from acsar_gym.trigonometry import angle_of, cos_sin

MOST_TRACKS = 24
"""Tracks of a robot: those that are seen when all are taken are left out."""
MOST_TRACES = 32
"""Cells that are kept of a track that stands, to be cleared when it moves."""
X, Y, VX, VY, RADIUS, VAR, COV, SPEED_VAR, AGE, MISSES, FROM_X, FROM_Y, MOVES, TRACES = range(14)
RANGE_VAR, RANGE_COV, RANGE_SPEED_VAR, HAS_MOVED = range(14, 18)
TRACK_NUMBERS = 18
"""Columns of a track: place [m], velocity [m/s], radius [m], variances of the coordinate across the
ray to it, of it and its speed, and of the speed, matched scans (0: not in use), scans without a
match since, the place where it stood [m], whether it moves, how many traces it has, variances of
the coordinate along the ray, and whether it has moved since it is followed."""
AXES = ((VAR, COV, SPEED_VAR), (RANGE_VAR, RANGE_COV, RANGE_SPEED_VAR))
"""Columns of the variances across and along the ray."""
EDGE_GAP = 0.25
"""Rays beside each other that differ by more belong to two objects [m]."""
LARGEST = 0.65
"""An object that looks larger than this radius isn't followed [m]; DynaBARN's have 0.5."""
RANGE_ERROR, ERROR, ERROR_SHARE = 0.04, 0.03, 0.3
"""Standard deviations of a cluster's place: along the ray [m]; and across it a part of its own [m],
and one of the distance between two rays where it is."""
NEW_SPEED = 1.0
"""Standard deviation of a coordinate of the velocity of what is new [m/s]."""
JOLT = 0.7
"""Standard deviation of the acceleration that the filter expects [m/s^2]."""
GATE_SIGMAS, LEAST_GATE, LARGEST_GATE = 3.0, 0.25, 0.5
"""A cluster belongs to a track within so many standard deviations, within limits [m]."""
RADIUS_GAIN = 0.15
"""Share of a new radius in a track's, at least."""
MOST_MISSES, MOST_MOVING_MISSES = 2, 4
"""A track ends when it hasn't been matched more often in a row."""
FIRST_AGE = 4
"""Scans that a track must have matched before it moves."""
MOVING_SPEED, STANDING_SPEED = 0.25, 0.15
"""What is faster may move, what moves and gets slower stands [m/s]."""
SURE, UNSURE = 3.0, 2.0
DEPARTURE, FAR_DEPARTURE = 0.2, 0.5
"""What moves is faster than so many standard deviations of its speed, and so far from where it
stood [m]: either the first ones, or the second ones."""
SETTLING = 0.03
"""Share by which the place where a track stands follows it at each scan, as odometry drifts."""
FRESH = 2
"""What moves isn't where the map remembers something: at most one of so many of its rays is."""
REACH = CELLS // 2 - 2
"""Cells that are farther from the robot's are beyond the map."""
CLEAR_MARGIN = 0.2
"""A ray looks through a place if it ends so far behind it [m]."""
STRAIGHT = 0.8
"""What approaches does so straight, if this share of its way is along the ray [cosine]."""
HULL_MARGIN = 0.15
"""Rays that end so far outside of what moves belong to it, too [m]."""


class Eye(NamedTuple):
    """Where the LiDAR is in the odometry frame."""

    x: float
    """[m]"""
    y: float
    """[m]"""
    start: float
    """Direction of its first ray [rad]."""


class Clusters(NamedTuple):
    """What a scan shows, a row for each object."""

    cos: Floats
    """Direction of the object's middle in the odometry frame."""
    sin: Floats
    near: Floats
    """Shortest range [m]."""
    radius: Floats
    """[m]"""
    age: Floats
    """When it was measured, from now on, so not positive [s]."""
    first: NDArray[np.int64]
    """First ray."""
    rays: NDArray[np.int64]
    """How many rays meet it."""


@subroutine
def clear_tracks(record: Any) -> None:
    """Forget all tracks, at the begin of an episode."""
    record.tracks[:] = 0.0
    record.now = 0.0
    record.scanned = -math.inf


@subroutine
def predict_tracks(tracks: Floats, dt: float) -> None:
    """Move all tracks on by a time [s]."""
    noise = JOLT * JOLT * dt * dt
    for k in range(MOST_TRACKS):
        if tracks[k, AGE] > 0.0:
            tracks[k, X] += dt * tracks[k, VX]
            tracks[k, Y] += dt * tracks[k, VY]
            for var, cov, speed in AXES:
                speed_var = tracks[k, speed]
                tracks[k, var] += dt * (2.0 * tracks[k, cov] + dt * (speed_var + 0.25 * noise))
                tracks[k, cov] += dt * (speed_var + 0.5 * noise)
                tracks[k, speed] += noise


@subroutine
def time_rays(bearings: Floats, times: Floats, now: float, rays: Rays, ages: Floats) -> None:
    """Fill in when each ray was measured, from now on [s]; the robot's turning is left out."""
    count = len(ages)
    ages[:] = times.mean() - now
    for k in range(len(bearings)):
        ray = int(math.floor((bearings[k] - rays.start) / rays.step + 0.5))  # noqa: RUF046
        if ray < 0 or ray >= count:  # a remainder takes long
            ray %= count
        ages[ray] = times[k] - now


@subroutine
def find_clusters(
    ranges: Floats, rays: Rays, ages: Floats, start: float, clusters: Clusters
) -> int:
    """Find the objects that a scan shows whole: both beside them is farther away.

    Returns:
        How many there are.
    """
    n, found = len(ranges), 0
    whole = abs(FULL_TURN / rays.step - n) < 1e-6  # the rays go all the way round
    begin = 0
    while whole and begin < n - 1 and abs(ranges[begin] - ranges[begin - 1]) <= EDGE_GAP:
        begin += 1
    done = 0
    while done < n:
        first = (begin + done) % n
        last, near, age, count = first, ranges[first], ages[first], 1
        while done + count < n:
            ray = last + 1 if last + 1 < n else 0
            if abs(ranges[ray] - ranges[last]) > EDGE_GAP:
                break
            near, age, last = min(near, ranges[ray]), age + ages[ray], ray
            count += 1
        done += count
        sine = math.sin(min(0.5 * count * rays.step, 1.0))
        radius = near * sine / (1.0 - sine)
        if (
            near < rays.farthest
            and radius < LARGEST
            and (whole or (first > 0 and last < n - 1))
            and ranges[first - 1] > ranges[first]
            and ranges[(last + 1) % n] > ranges[last]
        ):
            angle = start + (first + 0.5 * (count - 1)) * rays.step
            clusters.cos[found], clusters.sin[found] = cos_sin(angle)
            clusters.near[found], clusters.radius[found] = near, radius
            clusters.age[found] = age / count
            clusters.first[found], clusters.rays[found] = first, count
            found += 1
    return found


@jit
def place_error(near: float, rays: Rays) -> float:
    """Variance of a coordinate of what is seen at such a range [m^2]."""
    deviation = ERROR + ERROR_SHARE * rays.step * near
    return deviation * deviation


@jit
def place_variance(track: Floats, axis: tuple[int, int, int], age: float, error: float) -> float:
    """Variance of what is measured less a track's place then, along one of AXES [m^2]."""
    var, cov, speed = axis
    doubt: float = 2.0 * track[cov] + age * track[speed]
    return track[var] + age * doubt + error  # type: ignore[no-any-return]


@subroutine
def match_clusters(  # noqa: C901 - one pass over tracks and clusters
    tracks: Floats,
    clusters: Clusters,
    found: int,
    eye: Eye,
    rays: Rays,
    matches: NDArray[np.int64],
) -> None:
    """Find the cluster of each track: the nearest one, if the track is the nearest to it, too.

    `matches`, (MOST_TRACKS + rays,), gets the cluster of each track, then the track of each
    cluster; -1 for none.
    """
    nearest = np.full(len(matches), np.inf)
    matches[:] = -1
    for k in range(MOST_TRACKS):
        if tracks[k, AGE] <= 0.0:
            continue
        radius, x, y, vx, vy = (
            tracks[k, RADIUS],
            tracks[k, X],
            tracks[k, Y],
            tracks[k, VX],
            tracks[k, VY],
        )
        for c in range(found):
            far = clusters.near[c] + 0.5 * (clusters.radius[c] + radius)
            age = clusters.age[c]
            dx = eye.x + far * clusters.cos[c] - x - age * vx
            if abs(dx) > LARGEST_GATE:
                continue
            dy = eye.y + far * clusters.sin[c] - y - age * vy
            apart = dx * dx + dy * dy
            if apart > LARGEST_GATE * LARGEST_GATE:
                continue
            gate = GATE_SIGMAS * math.sqrt(
                place_variance(tracks[k], AXES[0], age, place_error(clusters.near[c], rays))
            )
            if apart < max(gate, LEAST_GATE) ** 2:
                if apart < nearest[k]:
                    nearest[k], matches[k] = apart, c
                if apart < nearest[MOST_TRACKS + c]:
                    nearest[MOST_TRACKS + c], matches[MOST_TRACKS + c] = apart, k
    for k in range(MOST_TRACKS):
        if matches[k] >= 0 and matches[MOST_TRACKS + matches[k]] != k:
            matches[k] = -1
    for c in range(found):
        place = MOST_TRACKS + c
        if matches[place] >= 0 and matches[matches[place]] != c:
            matches[place] = -1


@subroutine
def correct_axis(
    track: Floats, axis: tuple[int, int, int], off: float, age: float, error: float
) -> tuple[float, float]:
    """Correct the variances along one of AXES by a place of variance `error`, which is `off` [m].

    Returns:
        By how much the place [m] and the speed [m/s] change.
    """
    var, cov, speed = axis
    variance = place_variance(track, axis, age, error)
    gain = (track[var] + age * track[cov]) / variance
    speed_gain = (track[cov] + age * track[speed]) / variance
    track[var] -= gain * gain * variance
    track[cov] -= gain * speed_gain * variance
    track[speed] -= speed_gain * speed_gain * variance
    return gain * off, speed_gain * off


@subroutine
def correct_track(
    track: Floats, ray: tuple[float, float], x: float, y: float, age: float, error: float
) -> None:
    """Correct a track by where it was measured, and when, from now on [s].

    A cluster's place is sharper along the ray, whose cosine and sine are given, than across it,
    which has the variance `error`.
    """
    cos, sin = ray
    dx, dy = x - track[X] - age * track[VX], y - track[Y] - age * track[VY]
    across, across_speed = correct_axis(track, AXES[0], dy * cos - dx * sin, age, error)
    sharp = RANGE_ERROR * RANGE_ERROR
    along, along_speed = correct_axis(track, AXES[1], dx * cos + dy * sin, age, sharp)
    track[X] += along * cos - across * sin
    track[Y] += along * sin + across * cos
    track[VX] += along_speed * cos - across_speed * sin
    track[VY] += along_speed * sin + across_speed * cos


@subroutine
def has_departed(track: Floats, eye: Eye, ranges: Floats, rays: Rays) -> bool:
    """Whether a track is fast and far from where it stood, and that can be seen."""
    speed = math.sqrt(track[VX] * track[VX] + track[VY] * track[VY])
    if track[AGE] < FIRST_AGE or speed < MOVING_SPEED:
        return False
    dx, dy = track[X] - track[FROM_X], track[Y] - track[FROM_Y]
    apart = math.sqrt(dx * dx + dy * dy)
    deviations = speed / math.sqrt(max(track[SPEED_VAR], track[RANGE_SPEED_VAR]))
    far_enough = apart > (DEPARTURE if deviations > SURE else FAR_DEPARTURE)
    if deviations < UNSURE or not far_enough:
        return False
    to_x, to_y = track[FROM_X] - eye.x, track[FROM_Y] - eye.y
    far = math.sqrt(to_x * to_x + to_y * to_y)
    if dx * to_x + dy * to_y < -STRAIGHT * apart * far:
        return True
    n = len(ranges)
    bearing = (angle_of(to_x, to_y) - eye.start) / rays.step
    ray = int(math.floor(bearing))  # noqa: RUF046 - a float when compiled
    looks_through: bool = min(ranges[ray % n], ranges[(ray + 1) % n]) > far + CLEAR_MARGIN
    return looks_through


@subroutine
def clear_cells(
    grid: Grid, stamp: Bytes, cells: NDArray[np.int32], many: int, middle: tuple[int, int]
) -> None:
    """Free the first ones of some cells, which were hit by something that has moved on."""
    first_i, first_j = middle[0] - CELLS // 2, middle[1] - CELLS // 2
    for n in range(many):
        p, q = cells[n] // CELLS, cells[n] % CELLS
        count = grid.counts[p, q]
        if count > COUNT_FREE:
            grid.counts[p, q] = COUNT_FREE
            if count >= OCCUPIED:
                i, j = first_i + ((p - first_i) & LAST_CELL), first_j + ((q - first_j) & LAST_CELL)
                lower_costs(grid, stamp, i, j, middle)


@subroutine
def update_tracks(  # noqa: C901 - one pass over tracks and clusters
    record: Any,
    now: float,
    pose: tuple[float, float, float],
    middle: tuple[int, int],
    ranges: Floats,
    rays: Rays,
    measured: tuple[Floats, Floats, float],
    moving: Bytes,
) -> None:
    """Follow what a new scan shows, and mark the rays that meet what moves.

    Args:
        record: `RECORD` of the robot, whose map doesn't have this scan yet.
        now: time [s].
        pose: by odometry, x [m], y [m], theta [rad].
        middle: the cell that the robot is in.
        ranges: (rays,): the scan [m].
        rays: of the LiDAR.
        measured: bearings [rad] and times [s] of its measurements, and when they ended [s].
        moving: (rays,): gets 1 where a ray meets something that moves.
    """
    tracks, n, (bearings, times, stamp) = record.tracks, len(ranges), measured
    predict_tracks(tracks, now - record.now)
    record.now = now
    cos, sin = cos_sin(pose[2])
    eye = Eye(
        pose[0] + cos * rays.mount_x - sin * rays.mount_y,
        pose[1] + sin * rays.mount_x + cos * rays.mount_y,
        pose[2] + rays.start,
    )
    numbers = np.empty((7, n))
    ages, xs, ys = numbers[0], numbers[1], numbers[2]
    time_rays(bearings, times, now, rays, ages)
    for ray in range(n):
        c, s = cos_sin(eye.start + ray * rays.step)
        xs[ray], ys[ray] = eye.x + ranges[ray] * c, eye.y + ranges[ray] * s
    if stamp > record.scanned:
        record.scanned = stamp
        parts = np.empty((2, n), np.int64)
        clusters = Clusters(
            numbers[3], numbers[4], numbers[5], numbers[6], np.empty(n), parts[0], parts[1]
        )
        found = find_clusters(ranges, rays, ages, eye.start, clusters)
        matches = np.empty(MOST_TRACKS + n, np.int64)
        match_clusters(tracks, clusters, found, eye, rays, matches)
        for k in range(MOST_TRACKS):
            if tracks[k, AGE] > 0.0 and matches[k] >= 0:
                follow_cluster(record, k, clusters, matches[k], eye, middle, ranges, rays, xs, ys)
            elif tracks[k, AGE] > 0.0:
                tracks[k, MISSES] += 1.0
                most = MOST_MOVING_MISSES if tracks[k, MOVES] > 0.0 else MOST_MISSES
                if tracks[k, MISSES] > most:
                    tracks[k, AGE] = 0.0
        free = 0
        for c in range(found):
            if matches[MOST_TRACKS + c] >= 0:
                continue
            while free < MOST_TRACKS and tracks[free, AGE] > 0.0:
                free += 1
            if free == MOST_TRACKS:
                break
            track, far = tracks[free], clusters.near[c] + clusters.radius[c]
            track[:] = 0.0
            track[X] = track[FROM_X] = eye.x + far * clusters.cos[c]
            track[Y] = track[FROM_Y] = eye.y + far * clusters.sin[c]
            track[RADIUS], track[AGE] = clusters.radius[c], 1.0
            track[VAR] = place_error(clusters.near[c], rays)
            track[RANGE_VAR] = RANGE_ERROR * RANGE_ERROR
            track[SPEED_VAR] = track[RANGE_SPEED_VAR] = NEW_SPEED * NEW_SPEED
            add_traces(record, free, clusters.first[c], clusters.rays[c], xs, ys, middle)
    mark_rays(tracks, xs, ys, ages, moving)


@subroutine
def mark_rays(tracks: Floats, xs: Floats, ys: Floats, ages: Floats, moving: Bytes) -> None:
    """Mark the rays that end in what moves, where it was when they were measured."""
    moving[:] = 0
    for k in range(MOST_TRACKS):
        if tracks[k, AGE] > 0.0 and tracks[k, MOVES] > 0.0:
            track = tracks[k]
            reach = track[RADIUS] + HULL_MARGIN
            for ray in range(len(moving)):
                dx = xs[ray] - track[X] - ages[ray] * track[VX]
                dy = ys[ray] - track[Y] - ages[ray] * track[VY]
                if dx * dx + dy * dy < reach * reach:
                    moving[ray] = 1


@subroutine
def follow_cluster(  # noqa: PLR0913, PLR0917 - compiled, so no keywords
    record: Any,
    k: int,
    clusters: Clusters,
    c: int,
    eye: Eye,
    middle: tuple[int, int],
    ranges: Floats,
    rays: Rays,
    xs: Floats,
    ys: Floats,
) -> None:
    """Correct track k by cluster c, and find out whether it moves."""
    track = record.tracks[k]
    track[AGE] += 1.0
    track[MISSES] = 0.0
    wider = max(1.0 / track[AGE], RADIUS_GAIN) * (clusters.radius[c] - track[RADIUS])
    track[RADIUS] += wider
    ray = clusters.cos[c], clusters.sin[c]
    track[X] += wider * ray[0]  # its near side stays where it is
    track[Y] += wider * ray[1]
    track[FROM_X] += wider * ray[0]
    track[FROM_Y] += wider * ray[1]
    far = clusters.near[c] + track[RADIUS]
    x, y = eye.x + far * ray[0], eye.y + far * ray[1]
    correct_track(track, ray, x, y, clusters.age[c], place_error(clusters.near[c], rays))
    count = clusters.rays[c]
    known = FRESH * add_traces(record, k, clusters.first[c], count, xs, ys, middle) >= count
    if track[MOVES] > 0.0:
        slow = track[VX] * track[VX] + track[VY] * track[VY] < STANDING_SPEED * STANDING_SPEED
        if slow or known:
            track[MOVES] = track[TRACES] = 0.0
            track[FROM_X], track[FROM_Y] = track[X], track[Y]
    elif not known and has_departed(track, eye, ranges, rays):
        track[MOVES] = track[HAS_MOVED] = 1.0
        grid = Grid(record.counts, record.costs)
        clear_cells(grid, record.stamp, record.traces[k], int(track[TRACES]), middle)
    else:
        track[FROM_X] += SETTLING * (track[X] - track[FROM_X])
        track[FROM_Y] += SETTLING * (track[Y] - track[FROM_Y])


@subroutine
def add_traces(
    record: Any,
    k: int,
    first: int,
    count: int,
    xs: Floats,
    ys: Floats,
    middle: tuple[int, int],
) -> int:
    """Keep the cells that rays of a track which stands are the first to hit.

    Returns:
        How many of the rays end in cells that the map remembers as occupied.
    """
    track, known, ray = record.tracks[k], 0, first - 1
    for _ in range(count):
        ray = ray + 1 if ray + 1 < len(xs) else 0
        i, j = cell_at(xs[ray], record.side), cell_at(ys[ray], record.side)
        if max(abs(i - middle[0]), abs(j - middle[1])) > REACH:
            continue
        p, q = i & LAST_CELL, j & LAST_CELL
        if record.counts[p, q] >= OCCUPIED:
            known += 1
        elif (
            record.counts[p, q] <= COUNT_FREE
            and track[MOVES] == 0.0
            and track[TRACES] < MOST_TRACES
        ):
            record.traces[k, int(track[TRACES])] = p * CELLS + q
            track[TRACES] += 1.0
    return known
