"""Moving objects around a robot, found in the scans of its LiDAR as tracks.

An object that a scan shows completely, nearer than its surroundings, is a cluster of rays. A track
follows it: a Kalman filter of a constant velocity in the odometry frame (Bar-Shalom, Li &
Kirubarajan, "Estimation with Applications to Tracking and Navigation", 2001), corrected at the time
at which the LiDAR measured. Each track stands at first. It moves once it is fast, has come a
distance, isn't where the map remembers an obstacle, and has left a place that the LiDAR looks
through now, or comes straight at it. The map doesn't remember moving objects: rays that meet them
aren't counted, and the cells that they were the first to hit while they stood are cleared.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acsar_gym.jit import jit, subroutine
from acsar_gym.lidar.scan import FULL_TURN
from acsar_gym.sensors.map.seen import (
    CELLS,
    COUNT_FREE,
    HALF,
    LAST_CELL,
    OCCUPIED,
    Floats,
    Grid,
    PlacedScan,
    cell_at,
    length_of,
    lower_costs,
)
from acsar_gym.trigonometry import angle_of, cos_sin

Axis = tuple[int, int, int]
MOST_TRACKS = 24
"""Tracks of a robot. Objects that appear while all are in use aren't followed."""
MOST_TRACES = 32
"""Cells that are kept of a track that stands, to be cleared when it moves."""
TRACK_NUMBERS = 18
(
    X,  # place [m]
    Y,
    VX,  # velocity [m/s]
    VY,
    RADIUS,  # [m]
    VAR,  # variance of the place across the ray that sees it [m^2]
    COV,  # covariance of place and speed across the ray
    SPEED_VAR,  # variance of the speed across the ray
    AGE,  # scans that matched it, 0 if the row is free
    MISSES,  # scans since the last match
    FROM_X,  # the place where it stood [m]
    FROM_Y,
    MOVES,  # 1 while it moves
    TRACES,  # number of its traces
    RANGE_VAR,  # as VAR, COV and SPEED_VAR, but along the ray
    RANGE_COV,
    RANGE_SPEED_VAR,
    HAS_MOVED,  # 1 once it has moved
) = range(TRACK_NUMBERS)
"""Columns of a track."""
(
    COS,  # direction of its middle in the odometry frame
    SIN,
    NEAR,  # shortest range [m]
    SIZE,  # radius [m]
    TIME,  # when it was measured, relative to now [s]
    ERROR,  # variance of its place across the ray [m^2]
    FIRST,  # first ray
    RAYS,  # number of rays that meet it
    IS_MATCHED,  # 1 if it belongs to a track
) = range(9)
"""Columns of a cluster, an object that a scan shows."""
ACROSS = (VAR, COV, SPEED_VAR)
ALONG = (RANGE_VAR, RANGE_COV, RANGE_SPEED_VAR)

# How these constants were found isn't recorded, except where a docstring says so. What they achieve
# is: tests/sensors/map/test_tracks.py checks how soon walkers of 0.4 to 1.8 m/s are found and how
# seldom standing objects move, and docs/your-own-sensor.md has the figures among people. A change
# of any of them changes every figure among people (docs/experiments.md).

# Which rays belong to an object.
EDGE_GAP = 0.25
"""Neighbouring rays that differ by more belong to two objects [m]."""
LARGEST = 0.65
"""Objects that look larger than this radius aren't followed. DynaBARN's have 0.5 m [m]."""
HULL_MARGIN = 0.15
"""Rays that end within this distance of a moving object also belong to it [m]."""
CLEAR_MARGIN = 0.2
"""A ray looks through a place if it ends at least this far behind it [m]."""

# The filter. It is sharper along the ray, where the place is measured directly, than across it,
# where the edges of an object are off by up to half a ray.
RANGE_ERROR = 0.04
"""Standard deviation of a cluster's place along the ray [m]."""
ACROSS_ERROR = 0.03
"""Constant part of the standard deviation of its place across the ray [m]."""
ERROR_SHARE = 0.3
"""The part that grows with range, as a share of the distance between two rays."""
NEW_SPEED = 1.0
"""Standard deviation of a coordinate of a new track's velocity [m/s]. With 0.5, and a JOLT of 1.0,
velocities in crowds were off by 0.18 instead of 0.19 m/s (docs/experiments.md)."""
JOLT = 0.7
"""Standard deviation of the acceleration that the filter expects [m/s^2]."""
RADIUS_GAIN = 0.15
"""Least share of a newly measured radius in the radius of a track."""
SETTLING = 0.03
"""Share by which the place where a track stood follows the track at each scan, as odometry
drifts."""

# Which cluster belongs to a track, and how long a track lasts without a cluster.
GATE_SIGMAS = 3.0
"""A cluster belongs to a track within this many standard deviations of their distance."""
LEAST_GATE = 0.25
"""A cluster nearer than this belongs to a track in any case [m]."""
LARGEST_GATE = 0.5
"""A cluster farther away than this never does [m]."""
MOST_MISSES = 2
"""A standing track ends after more scans in a row without a match."""
MOST_MOVING_MISSES = 4
"""A moving track ends after more scans in a row without a match."""

# When a track starts to move: it is fast compared with the doubt about its speed, and away from
# where it stood. The less sure the speed, the farther away.
FIRST_AGE = 4
"""Scans that have matched it at least."""
MOVING_SPEED = 0.25
"""Its least speed [m/s]."""
STANDING_SPEED = 0.15
"""A moving track that becomes slower stands again [m/s]."""
SURE = 3.0
"""A speed of this many standard deviations needs DEPARTURE only."""
DEPARTURE = 0.2
"""Least distance from where it stood [m]."""
UNSURE = 2.0
"""A speed of this many standard deviations needs FAR_DEPARTURE."""
FAR_DEPARTURE = 0.5
"""Least distance from where it stood if its speed is less sure [m]."""
STRAIGHT = 0.8
"""It comes straight at the LiDAR if this share of its way was along the ray [cosine]."""
MAX_REMEMBERED_SHARE = 1 / 2
"""It is an obstacle that stands if this share of its rays ends in cells that the map remembers."""
REACH = HALF - 2
"""Cells that are farther away than this, in rows or columns, count as outside the map."""


@subroutine
def predict_tracks(tracks: Floats, dt: float) -> None:
    """Advance all tracks by a time [s]."""
    noise = JOLT * JOLT * dt * dt
    for k in range(MOST_TRACKS):
        if tracks[k, AGE] > 0.0:
            track = tracks[k]
            track[X] += dt * track[VX]
            track[Y] += dt * track[VY]
            for var, cov, speed in (ACROSS, ALONG):
                track[var] += dt * (2.0 * track[cov] + dt * (track[speed] + 0.25 * noise))
                track[cov] += dt * (track[speed] + 0.5 * noise)
                track[speed] += noise


@subroutine
def find_clusters(scan: PlacedScan) -> Floats:
    """Find the objects that a scan shows completely: the rays on both sides of them go farther.

    Returns:
        (objects, columns): Their rows, which match no track yet.
    """
    ranges = scan.ranges
    n = len(ranges)
    clusters = np.empty((n, IS_MATCHED + 1))
    objects = 0

    # If the rays go all the way round, start at an edge.
    is_closed = abs(FULL_TURN / scan.step - n) < 1e-6
    start = 0
    while is_closed and start < n - 1 and abs(ranges[start] - ranges[start - 1]) <= EDGE_GAP:
        start += 1

    done = 0
    while done < n:
        first = (start + done) % n
        last = first
        near = ranges[first]
        age = scan.ages[first]
        count = 1
        while done + count < n:
            ray = last + 1 if last + 1 < n else 0
            if abs(ranges[ray] - ranges[last]) > EDGE_GAP:
                break
            near = min(near, ranges[ray])
            age += scan.ages[ray]
            last = ray
            count += 1
        done += count

        # A disc that fills the angle of the rays.
        sine = math.sin(min(0.5 * count * scan.step, 1.0))
        radius = near * sine / (1.0 - sine)
        if (
            near < scan.farthest
            and radius < LARGEST
            and (is_closed or (first > 0 and last < n - 1))
            and ranges[first - 1] > ranges[first]
            and ranges[(last + 1) % n] > ranges[last]
        ):
            cluster = clusters[objects]
            deviation = ACROSS_ERROR + ERROR_SHARE * scan.step * near
            cluster[COS], cluster[SIN] = cos_sin(
                scan.start + (first + 0.5 * (count - 1)) * scan.step
            )
            cluster[NEAR] = near
            cluster[SIZE] = radius
            cluster[TIME] = age / count
            cluster[ERROR] = deviation * deviation
            cluster[FIRST] = first
            cluster[RAYS] = count
            cluster[IS_MATCHED] = 0.0
            objects += 1
    return clusters[:objects]


@jit
def place_variance(track: Floats, axis: Axis, age: float, error: float) -> float:
    """Return the variance of a measured place minus the track's place at that time [m^2]."""
    var, cov, speed = axis
    doubt = 2.0 * track[cov] + age * track[speed]
    return track[var] + age * doubt + error  # type: ignore[no-any-return]


@subroutine
def match_clusters(  # noqa: C901 - a pass over tracks and clusters
    tracks: Floats, clusters: Floats, scan: PlacedScan
) -> NDArray[np.int64]:
    """Match tracks and clusters that are the nearest to each other, within the gate.

    Returns:
        (MOST_TRACKS,): Cluster of each track, -1 if there is none.
    """
    matches = np.full(MOST_TRACKS, -1)
    nearest_cluster = np.full(MOST_TRACKS, np.inf)
    nearest_track = np.full(len(clusters), np.inf)
    candidates = np.full(len(clusters), -1)
    for k in range(MOST_TRACKS):
        if tracks[k, AGE] <= 0.0:
            continue
        track = tracks[k]
        for c in range(len(clusters)):
            # Most pairs are too far from each other, which shows at little cost.
            distance = clusters[c, NEAR] + 0.5 * (clusters[c, SIZE] + track[RADIUS])
            age = clusters[c, TIME]
            dx = scan.x + distance * clusters[c, COS] - track[X] - age * track[VX]
            if abs(dx) > LARGEST_GATE:
                continue
            dy = scan.y + distance * clusters[c, SIN] - track[Y] - age * track[VY]
            square = dx * dx + dy * dy
            if square > LARGEST_GATE * LARGEST_GATE:
                continue

            variance = place_variance(track, ACROSS, age, error=clusters[c, ERROR])
            if square < max(GATE_SIGMAS * math.sqrt(variance), LEAST_GATE) ** 2:
                if square < nearest_cluster[k]:
                    nearest_cluster[k] = square
                    matches[k] = c
                if square < nearest_track[c]:
                    nearest_track[c] = square
                    candidates[c] = k

    for k in range(MOST_TRACKS):
        if matches[k] >= 0:
            if candidates[matches[k]] == k:
                clusters[matches[k], IS_MATCHED] = 1.0
            else:
                matches[k] = -1
    return matches


@subroutine
def correct_axis(
    track: Floats, axis: Axis, offset: float, age: float, error: float
) -> tuple[float, float]:
    """Correct the variances along an axis by a measured place at an offset [m].

    Returns:
        Changes of the place [m] and the speed [m/s].
    """
    var, cov, speed = axis
    variance = place_variance(track, axis, age, error=error)
    gain = (track[var] + age * track[cov]) / variance
    speed_gain = (track[cov] + age * track[speed]) / variance
    track[var] -= gain * gain * variance
    track[cov] -= gain * speed_gain * variance
    track[speed] -= speed_gain * speed_gain * variance
    return gain * offset, speed_gain * offset


@subroutine
def correct_track(track: Floats, cluster: Floats, scan: PlacedScan) -> None:
    """Correct a track by the place of a cluster."""
    cos = cluster[COS]
    sin = cluster[SIN]
    age = cluster[TIME]
    distance = cluster[NEAR] + track[RADIUS]

    dx = scan.x + distance * cos - track[X] - age * track[VX]
    dy = scan.y + distance * sin - track[Y] - age * track[VY]
    across, across_speed = correct_axis(
        track, ACROSS, dy * cos - dx * sin, age=age, error=cluster[ERROR]
    )
    along, along_speed = correct_axis(
        track, ALONG, dx * cos + dy * sin, age=age, error=RANGE_ERROR * RANGE_ERROR
    )
    track[X] += along * cos - across * sin
    track[Y] += along * sin + across * cos
    track[VX] += along_speed * cos - across_speed * sin
    track[VY] += along_speed * sin + across_speed * cos


@subroutine
def has_departed(track: Floats, scan: PlacedScan) -> bool:
    """Return whether a track is fast and away from where it stood, and the scan confirms that."""
    speed = length_of(track[VX], track[VY])
    if track[AGE] < FIRST_AGE or speed < MOVING_SPEED:
        return False

    dx = track[X] - track[FROM_X]
    dy = track[Y] - track[FROM_Y]
    departure = length_of(dx, dy)
    deviations = speed / math.sqrt(max(track[SPEED_VAR], track[RANGE_SPEED_VAR]))
    is_away = departure > (DEPARTURE if deviations > SURE else FAR_DEPARTURE)
    if deviations < UNSURE or not is_away:
        return False

    # It comes straight at the LiDAR, or the LiDAR looks through the place where it stood.
    to_x = track[FROM_X] - scan.x
    to_y = track[FROM_Y] - scan.y
    distance = length_of(to_x, to_y)
    if dx * to_x + dy * to_y < -STRAIGHT * departure * distance:
        return True
    n = len(scan.ranges)
    bearing = (angle_of(to_x, to_y) - scan.start) / scan.step
    ray = int(math.floor(bearing))  # noqa: RUF046 - a float when compiled
    range_ = min(scan.ranges[ray % n], scan.ranges[(ray + 1) % n])
    return range_ > distance + CLEAR_MARGIN  # type: ignore[no-any-return]


@subroutine
def clear_traces(record: Any, grid: Grid, k: int) -> None:
    """Free the cells that a track was the first to hit, because it moves on."""
    for n in range(int(record.tracks[k, TRACES])):
        p, q = divmod(record.traces[k, n], CELLS)
        count = grid.counts[p, q]
        if count > COUNT_FREE:
            grid.counts[p, q] = COUNT_FREE
            if count >= OCCUPIED:
                i = grid.first_i + ((p - grid.first_i) & LAST_CELL)
                j = grid.first_j + ((q - grid.first_j) & LAST_CELL)
                lower_costs(grid, i, j)


@subroutine
def update_tracks(record: Any, grid: Grid, scan: PlacedScan) -> None:
    """Follow the objects in a new scan, and mark the rays that meet moving objects.

    Args:
        record: `RECORD` of the robot.
        grid: Cells of the robot, to which the scan hasn't been added yet.
        scan: The scan, whose rays are marked.
    """
    tracks = record.tracks
    predict_tracks(tracks, scan.now - record.now)
    record.now = scan.now

    if scan.stamp > record.scanned:  # a revolution that the tracks haven't seen
        record.scanned = scan.stamp
        clusters = find_clusters(scan)
        matches = match_clusters(tracks, clusters, scan)
        for k in range(MOST_TRACKS):
            track = tracks[k]
            if matches[k] >= 0:
                follow_cluster(record, grid, scan, k=k, cluster=clusters[matches[k]])
            elif track[AGE] > 0.0:
                track[MISSES] += 1.0
                if track[MISSES] > (MOST_MOVING_MISSES if track[MOVES] > 0.0 else MOST_MISSES):
                    track[AGE] = 0.0
        start_tracks(record, grid, scan, clusters=clusters)

    mark_rays(tracks, scan)


@subroutine
def start_tracks(record: Any, grid: Grid, scan: PlacedScan, clusters: Floats) -> None:
    """Start a track for each cluster that matches none, as long as rows are free."""
    k = 0
    for c in range(len(clusters)):
        cluster = clusters[c]
        if cluster[IS_MATCHED] > 0.0:
            continue
        while k < MOST_TRACKS and record.tracks[k, AGE] > 0.0:
            k += 1
        if k == MOST_TRACKS:
            break

        track = record.tracks[k]
        distance = cluster[NEAR] + cluster[SIZE]
        track[:] = 0.0
        track[X] = track[FROM_X] = scan.x + distance * cluster[COS]
        track[Y] = track[FROM_Y] = scan.y + distance * cluster[SIN]
        track[RADIUS] = cluster[SIZE]
        track[AGE] = 1.0
        track[VAR] = cluster[ERROR]
        track[RANGE_VAR] = RANGE_ERROR * RANGE_ERROR
        track[SPEED_VAR] = track[RANGE_SPEED_VAR] = NEW_SPEED * NEW_SPEED
        add_traces(record, grid, scan, k=k, cluster=cluster)


@subroutine
def mark_rays(tracks: Floats, scan: PlacedScan) -> None:
    """Mark the rays that end in a moving object, at its place when they were measured."""
    for k in range(MOST_TRACKS):
        if tracks[k, AGE] > 0.0 and tracks[k, MOVES] > 0.0:
            track = tracks[k]
            reach = track[RADIUS] + HULL_MARGIN
            for ray in range(len(scan.moving)):
                dx = scan.xs[ray] - track[X] - scan.ages[ray] * track[VX]
                dy = scan.ys[ray] - track[Y] - scan.ages[ray] * track[VY]
                if dx * dx + dy * dy < reach * reach:
                    scan.moving[ray] = 1


@subroutine
def follow_cluster(record: Any, grid: Grid, scan: PlacedScan, k: int, cluster: Floats) -> None:
    """Correct track k by a cluster, and decide whether it moves."""
    track = record.tracks[k]
    track[AGE] += 1.0
    track[MISSES] = 0.0

    # If the radius changes, the near side stays where it is.
    growth = max(1.0 / track[AGE], RADIUS_GAIN) * (cluster[SIZE] - track[RADIUS])
    track[RADIUS] += growth
    track[X] += growth * cluster[COS]
    track[Y] += growth * cluster[SIN]
    track[FROM_X] += growth * cluster[COS]
    track[FROM_Y] += growth * cluster[SIN]
    correct_track(track, cluster, scan)

    remembered = add_traces(record, grid, scan, k=k, cluster=cluster)
    is_obstacle = remembered >= MAX_REMEMBERED_SHARE * cluster[RAYS]
    if track[MOVES] > 0.0:
        square = track[VX] * track[VX] + track[VY] * track[VY]
        if square < STANDING_SPEED * STANDING_SPEED or is_obstacle:
            track[MOVES] = track[TRACES] = 0.0
            track[FROM_X] = track[X]
            track[FROM_Y] = track[Y]
    elif not is_obstacle and has_departed(track, scan):
        track[MOVES] = track[HAS_MOVED] = 1.0
        clear_traces(record, grid, k)
    else:
        track[FROM_X] += SETTLING * (track[X] - track[FROM_X])
        track[FROM_Y] += SETTLING * (track[Y] - track[FROM_Y])


@subroutine
def add_traces(record: Any, grid: Grid, scan: PlacedScan, k: int, cluster: Floats) -> int:
    """Keep the cells that rays of a standing track are the first to hit.

    Returns:
        Number of rays that end in cells that the map remembers as occupied.
    """
    track = record.tracks[k]
    remembered = 0
    for n in range(int(cluster[RAYS])):
        ray = int(cluster[FIRST]) + n
        if ray >= len(scan.xs):  # a remainder takes long
            ray -= len(scan.xs)
        i = cell_at(scan.xs[ray], grid.side)
        j = cell_at(scan.ys[ray], grid.side)
        if max(abs(i - grid.first_i - HALF), abs(j - grid.first_j - HALF)) > REACH:
            continue

        cell = i & LAST_CELL, j & LAST_CELL
        count = grid.counts[cell]
        if count >= OCCUPIED:
            remembered += 1
        elif count <= COUNT_FREE and track[MOVES] == 0.0 and track[TRACES] < MOST_TRACES:
            record.traces[k, int(track[TRACES])] = cell[0] * CELLS + cell[1]
            track[TRACES] += 1.0
    return remembered
