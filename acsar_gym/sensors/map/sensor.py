"""The map, a sensor that remembers what is free around the robot and knows the way to the goal.

It keeps what the LiDAR has seen in a grid of cells (`seen`), by the robot's odometry, and the way
to the goal over it (`way`). Its numbers in the observation are in units of the robot, so that one
policy can drive robots of any size and speed. A single robot and a batch call the same function.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.config.footprint import Outline, border_distance, outline_radius, outline_reach
from acsar_gym.errors import ConfigError
from acsar_gym.jit import jit, loop, subroutine
from acsar_gym.lidar.scan import FULL_TURN, Rays, make_rays
from acsar_gym.links.base import Link
from acsar_gym.odometry import Odometry
from acsar_gym.sensors.map.arcs import ARCS, BANDS, LONGEST_ARC, measure_arcs, tabulate_arcs
from acsar_gym.sensors.map.courses import COURSE_STEPS, COURSES, tabulate_courses
from acsar_gym.sensors.map.seen import (
    CELL_SIDE,
    CELLS,
    COUNT_FREE,
    HALF,
    LAST_CELL,
    OCCUPIED,
    STAMP_SHAPE,
    Floats,
    Grid,
    Measured,
    Place,
    Pose,
    add_scan,
    cell_at,
    length_of,
    make_stamp,
    move_window,
    place_scan,
)
from acsar_gym.sensors.map.tracks import (
    AGE,
    MOST_TRACES,
    MOST_TRACKS,
    MOVES,
    RADIUS,
    TRACK_NUMBERS,
    update_tracks,
)
from acsar_gym.sensors.map.way import (
    MOST_POINTS,
    SCRATCH,
    Ints,
    length_left,
    next_corner,
    piece_cost,
    plan_way,
    point_ahead,
    weigh_way,
)
from acsar_gym.sensors.sensor import LIDAR, MAP, Sensor, SensorInput, find_sensor
from acsar_gym.trigonometry import angle_of, cos_sin
from acsar_gym.worlds.world import to_odometry

# What surrounds the robot.
SECTORS = 48
"""Directions around the robot. The nearest obstacle counts in each."""
BEARING_SHIFT = 1e-5
"""Added to a ray's bearing, because rays often point to where two sectors meet, where rounding
would decide [rad]."""
REACH_STEPS = 720
"""Directions in which the footprint's reach is tabulated."""
NEAR_SHARE = 0.25
"""Lengths are observed on a logarithmic scale, which is about linear below this, in radii."""
FARTHEST_CLEARANCE = 16.0
"""Larger clearances count as this, in radii: the half width of the map."""
UNSEEN_CELLS = 6
"""Nearest cells in a direction in which the LiDAR doesn't look."""
UNSEEN_CLEARANCE = 0.5
"""Clearance in that direction if most of UNSEEN_CELLS have never been seen, in radii. Without it
robots that see half a turn drove backwards into obstacles, in 18 % of the episodes of `drawn:2023`
(docs/experiments.md)."""
FILLED = 2.0 * FARTHEST_CLEARANCE
"""Added to the clearance of a direction that no ray has measured until all directions are filled
in. A negative clearance between two rays is therefore taken for a measured clearance, and observed
as free. Packaged policies were trained with that."""

# The way.
FARTHEST_WAY = 64.0
"""A longer way to the goal counts as this, in radii."""
LOOKAHEADS = (2.0, 4.0, 8.0)
"""Distances along the way of the points that are observed, in radii."""
OLDEST_WAY = 20
"""A way is replaced after this many steps at the latest."""
NEWEST_WAY = 3
"""A way is kept for this many steps, even if a piece of it has become dearer."""
SWITCH = 1.05
"""The robot keeps to its way unless it costs more than a new way by this factor, so that the robot
doesn't waver between two that are equally good."""
STALL_STEPS = 50
"""A robot is stalled if its way hasn't become shorter by STALL_GAIN for this many steps. Without
this number policies stood still in front of gaps that were wide enough (docs/experiments.md)."""
STALL_GAIN = 0.25
"""Least shortening of the way that counts, in radii."""
GAIN_LIMIT = 2.0
"""Largest observed gain."""
SLIDE_ACCELERATION = 0.7
"""With more acceleration sideways tyres slide, and odometry drifts [m/s^2]. After 2 s of a circle
at 1 m/s^2 the heading of a simulated Jackal's odometry is off by up to 0.1 rad, at 2 m/s^2 by 0.5,
at 4 m/s^2 by more."""

BODY = ("width", "top_speed", "top_turn_rate", "stopping", "turn_stopping", "lag", "sight", "grip")
"""Numbers that describe the robot itself."""
MAP_NAMES = (
    "gained",
    "way_left",
    *(f"way_{axis}_{n}" for n in range(len(LOOKAHEADS)) for axis in ("cos", "sin")),
    *(f"way_cost_{n}" for n in range(len(LOOKAHEADS))),
    "stalled",
    *BODY,
    *(f"clearance_{n}" for n in range(SECTORS)),
    *(f"arc_{n}" for n in range(ARCS)),
    *(f"wide_arc_{n}" for n in range(ARCS)),
)
"""Names of the numbers that the map adds to the observation."""
GAINED = 0
"""Index of the number that tells by how much the way has become shorter in the last step, as a
share of the distance at top speed."""
WAY_LEFT = 1
FIRST_POINT = 2
FIRST_COST = MAP_NAMES.index("way_cost_0")
STALLED = MAP_NAMES.index("stalled")
"""Index of the number that tells for how long the way hasn't become shorter."""
FIRST_SECTOR = MAP_NAMES.index("clearance_0")
FIRST_ARC = MAP_NAMES.index("arc_0")
MAP_LOW = np.zeros(len(MAP_NAMES))
MAP_LOW[GAINED] = -GAIN_LIMIT
MAP_LOW[FIRST_POINT:STALLED] = -1.0
MAP_HIGH = np.ones(len(MAP_NAMES))
MAP_HIGH[GAINED] = GAIN_LIMIT

RECORD = np.dtype(
    [
        # the robot
        ("side", "f8"),  # of a cell [m]
        ("radius", "f8"),  # of the disc around the footprint [m]
        ("pace", "f8"),  # distance in a step at top speed [m]
        ("top_speed", "f8"),  # [m/s]
        ("body", "f8", len(BODY)),
        ("reach", "f8", REACH_STEPS),  # from the base's middle to the footprint's edge [m]
        ("spans", "f8", (ARCS, 2)),  # of the footprint beside arcs [m]
        ("fronts", "f8", (ARCS, BANDS, 4)),  # of the footprint along arcs [m]
        ("courses", "f8", (len(COURSES), COURSE_STEPS, 2)),  # places on courses [m]
        ("stamp", "u1", STAMP_SHAPE),
        # the grid
        ("counts", "u1", (CELLS, CELLS)),
        ("costs", "u1", (CELLS, CELLS)),
        ("first_i", "i8"),  # first cell of the window
        ("first_j", "i8"),
        ("turn", "i8"),  # number of scans
        # the way
        ("points", "f8", (MOST_POINTS, 4)),  # corners, see `way`
        ("draft", "f8", (MOST_POINTS, 4)),  # corners of a possible new way
        ("corners", "i8"),  # number of corners
        ("corner", "i8"),  # corner that the robot drives to
        ("age", "i8"),  # [steps]
        ("way_left", "f8"),  # length from the robot to the goal [m]
        ("shortest", "f8"),  # shortest length of this way until now [m]
        ("waited", "i8"),  # steps since then
        # moving objects
        ("tracks", "f8", (MOST_TRACKS, TRACK_NUMBERS)),
        ("traces", "i4", (MOST_TRACKS, MOST_TRACES)),  # cells: row * CELLS + column
        ("now", "f8"),  # time to which the tracks refer [s]
        ("scanned", "f8"),  # end of the newest revolution [s]
    ]
)
"""Map of a robot: its numbers, cells, way and tracks."""


def make_record(config: RobotConfig, period: float) -> NDArray[Any]:
    """Make the empty map of a robot, an array of one `RECORD`.

    Args:
        config: Robot configuration.
        period: Duration of an env step [s].
    """
    outline = config.outline
    radius = outline_radius(outline)
    record = np.zeros(1, RECORD)
    record["side"] = CELL_SIDE * radius
    record["radius"] = radius
    record["pace"] = config.max_linear * period
    record["top_speed"] = config.max_linear
    record["body"] = describe_body(config)
    record["reach"] = _reach(outline)
    record["spans"], record["fronts"] = tabulate_arcs(outline)
    record["courses"] = tabulate_courses(radius, config.max_linear, config.max_angular)
    record["stamp"] = make_stamp(border_distance(outline, 0.0, 0.0), radius)
    return record


@lru_cache(maxsize=1024)
def _reach(outline: Outline) -> Floats:
    """(REACH_STEPS,): From the base's middle to the edge, in directions from -pi on [m]."""
    angles = (np.arange(REACH_STEPS) + 0.5) * FULL_TURN / REACH_STEPS - math.pi
    return outline_reach(outline, (0.0, 0.0), angles)


def describe_body(config: RobotConfig) -> Floats:
    """Compute the numbers that describe a robot, (len(BODY),), each about 0 to 1.

    They follow from its configuration and don't reveal what an episode has drawn.
    """
    radius = outline_radius(config.outline)
    speed = config.max_linear
    turn = config.max_angular

    slowing = config.motor.of_wheel(0).acceleration * config.wheel_radius
    slowing_turn = 2.0 * slowing / config.effective_separation
    slow = min(slowing, config.linear_limits.max_acceleration or math.inf)
    slow_turn = min(slowing_turn, config.angular_limits.max_acceleration or math.inf)
    lag = 1.0 / config.feedback_rate + config.firmware.processing_time + config.encoder.window

    body = [
        border_distance(config.outline, 0.0, 0.0) / radius,
        speed / radius / 10.0,
        turn / 4.0,
        speed * speed / (2.0 * slow) / radius / 4.0,
        turn * turn / (2.0 * slow_turn) / math.pi,
        (lag + 1.0 / config.lidar.rate) * speed / radius,
        config.lidar.max_range / radius / 32.0,
        SLIDE_ACCELERATION / (speed * turn),
    ]
    return np.clip(body, 0.0, 1.0)


@subroutine
def clear_map(record: Any) -> None:
    """Forget everything, at the start of an episode."""
    record.counts[:] = 0
    record.costs[:] = 0
    record.tracks[:] = 0.0
    record.corners = record.corner = record.turn = record.waited = 0
    record.way_left = record.shortest = record.now = 0.0
    record.age = OLDEST_WAY
    record.scanned = -math.inf


@subroutine
def update_map(  # noqa: PLR0913, PLR0917 - as the batch has them
    record: Any,
    now: float,
    pose: Pose,
    goal: Place,
    ranges: Floats,
    rays: Rays,
    measured: Measured,
    scratch: Ints,
    out: Floats,
) -> None:
    """Add a scan to the map, follow the way or plan a new way, and describe the surroundings.

    Args:
        record: `RECORD` of the robot.
        now: Time of the pose and the scan [s].
        pose: The robot's pose by odometry.
        goal: The goal.
        ranges: The scan, (rays,) [m].
        rays: Rays of the LiDAR.
        measured: The revolution that the scan was made of.
        scratch: (SCRATCH,): Memory of the search.
        out: (len(MAP_NAMES),): Gets the numbers that the map adds to the observation.
    """
    radius = record.radius
    grid = Grid(
        counts=record.counts,
        costs=record.costs,
        stamp=record.stamp,
        side=record.side,
        first_i=cell_at(pose[0], record.side) - HALF,
        first_j=cell_at(pose[1], record.side) - HALF,
    )
    move_window(grid, record.first_i, record.first_j)
    record.first_i = grid.first_i
    record.first_j = grid.first_j

    # Moving objects first, because the grid leaves them out.
    scan = place_scan(pose, ranges, rays, measured=measured, now=now)
    update_tracks(record, grid, scan)
    add_scan(grid, scan, record.turn)
    record.turn += 1

    gained = follow_way(record, grid, (pose[0], pose[1]), goal=goal, scratch=scratch)
    out[GAINED] = clip(gained / record.pace, GAIN_LIMIT)
    out[WAY_LEFT] = log_share(record.way_left / radius, FARTHEST_WAY)
    out[STALLED] = min(record.waited / STALL_STEPS, 1.0)
    describe_way(record, grid, pose, out=out)
    out[STALLED + 1 : FIRST_SECTOR] = record.body

    spots = fill_sectors(record, pose, ranges, rays=rays, out=out[FIRST_SECTOR:FIRST_ARC])
    measure_arcs(record.spans, record.fronts, radius, spots=spots, out=out[FIRST_ARC:])
    for n in range(FIRST_ARC, len(MAP_NAMES)):
        out[n] = log_share(out[n], LONGEST_ARC)


@subroutine
def follow_way(record: Any, grid: Grid, place: Place, goal: Place, scratch: Ints) -> float:
    """Follow the way, or replace it if it is old or a piece of it has become dearer.

    Returns:
        The length by which the way has become shorter since the last step [m].
    """
    points = record.points
    way = points[: record.corners]
    corner = int(record.corner)
    gained = 0.0
    record.age += 1
    replace = record.age >= OLDEST_WAY
    if len(way) > 0:
        corner = next_corner(way, corner, place)
        gained = record.way_left - length_left(way, corner, place)
        if record.age >= NEWEST_WAY and not replace:
            _, replace = weigh_way(grid, place, way[corner:], write=False)

    if replace:
        draft = record.draft
        corners, draft_cost = plan_way(grid, place, goal, points=draft, scratch=scratch)
        cost, _ = weigh_way(grid, place, way[corner:], write=True)
        if len(way) == 0 or cost > SWITCH * draft_cost:
            points[:] = draft
            record.corners = corners
            corner = 1
            record.shortest = length_left(points, corner, place)
        record.age = 0

    record.corner = corner
    record.way_left = length_left(points, corner, place)
    record.waited += 1
    if record.way_left < record.shortest - STALL_GAIN * record.radius:
        record.shortest = record.way_left
        record.waited = 0
    return gained


@subroutine
def describe_way(record: Any, grid: Grid, pose: Pose, out: Floats) -> None:
    """Fill in where the points ahead on the way are, and the largest costs before them."""
    ahead = record.points[record.corner : record.corners]
    cos, sin = cos_sin(pose[2])
    start = pose[0], pose[1]
    for n in range(len(LOOKAHEADS)):
        end = point_ahead(ahead, (pose[0], pose[1]), LOOKAHEADS[n] * record.radius)
        dx = end[0] - pose[0]
        dy = end[1] - pose[1]
        distance = max(length_of(dx, dy), 1e-9)
        out[FIRST_POINT + 2 * n] = clip((dx * cos + dy * sin) / distance, 1.0)
        out[FIRST_POINT + 2 * n + 1] = clip((dy * cos - dx * sin) / distance, 1.0)

        _, highest = piece_cost(grid, start, end)
        out[FIRST_COST + n] = min(highest / 64.0, 1.0)
        start = end


@jit
def clip(value: float, limit: float) -> float:
    """Clip a value to -limit to limit."""
    return min(max(value, -limit), limit)


@jit
def log_share(value: float, limit: float) -> float:
    """Return a length or clearance, in radii, on a logarithmic scale from 0 to 1."""
    clipped = min(max(value, 0.0), limit)
    return math.log(1.0 + clipped / NEAR_SHARE) / math.log(1.0 + limit / NEAR_SHARE)


@jit
def length_of_share(share: float, limit: float) -> float:
    """Return the length in radii whose `log_share` this is."""
    return NEAR_SHARE * ((1.0 + limit / NEAR_SHARE) ** share - 1.0)  # type: ignore[no-any-return]


@subroutine
def fill_sectors(  # noqa: C901 - three passes over directions
    record: Any, pose: Pose, ranges: Floats, rays: Rays, out: Floats
) -> Floats:
    """Fill in the clearance of the footprint in each direction, see `log_share`.

    Where the LiDAR doesn't look, the map's memory counts.

    Returns:
        (n, 2): Obstacles near the robot, in the base frame [m].
    """
    radius = record.radius
    reach = record.reach
    spots = np.empty((len(ranges) + SECTORS, 2))
    count = 0
    out[:] = FILLED
    for ray in range(len(ranges)):
        distance = ranges[ray]
        cos, sin = cos_sin(rays.start + ray * rays.step)
        x = rays.mount_x + distance * cos
        y = rays.mount_y + distance * sin
        share = (angle_of(x, y) + math.pi + BEARING_SHIFT) / FULL_TURN
        edge = reach[int(share * REACH_STEPS) % REACH_STEPS]
        clearance = (length_of(x, y) - edge) / radius
        if distance >= rays.farthest - 1e-3:
            clearance = FARTHEST_CLEARANCE
        elif clearance < LONGEST_ARC + 1.0:
            spots[count, 0] = x
            spots[count, 1] = y
            count += 1
        sector = int(share * SECTORS) % SECTORS
        out[sector] = min(out[sector], clearance, FARTHEST_CLEARANCE)

    for sector in range(SECTORS):
        if out[sector] < FILLED:
            continue
        previous = out[(sector - 1) % SECTORS]
        following = out[(sector + 1) % SECTORS]
        if max(previous, following) < FILLED:  # between two rays
            clearance = min(previous, following)
        else:  # behind the LiDAR
            bearing = (sector + 0.5) * FULL_TURN / SECTORS - math.pi
            edge = reach[int((sector + 0.5) / SECTORS * REACH_STEPS)]
            clearance = remembered_clearance(record, pose, bearing, edge=edge) / radius
            if clearance < 0.0:
                clearance = UNSEEN_CLEARANCE
            elif clearance < FARTHEST_CLEARANCE:
                cos, sin = cos_sin(bearing)
                distance = edge + clearance * radius
                spots[count, 0] = distance * cos
                spots[count, 1] = distance * sin
                count += 1
        out[sector] = FILLED + clearance

    for sector in range(SECTORS):
        if out[sector] >= FILLED:
            out[sector] -= FILLED
        out[sector] = log_share(out[sector], FARTHEST_CLEARANCE)
    return spots[:count]


@subroutine
def remembered_clearance(record: Any, pose: Pose, bearing: float, edge: float) -> float:
    """Look for the nearest occupied cell in a direction in which the LiDAR doesn't look.

    Returns:
        Distance from the edge [m], FARTHEST_CLEARANCE radii if there is no such cell within 8
        radii, and -1 if most of UNSEEN_CELLS have never been seen.
    """
    cos, sin = cos_sin(pose[2] + bearing)
    side: float = record.side
    unseen = 0

    for step in range(int(8.0 / CELL_SIDE)):
        distance = edge + step * side
        i = cell_at(pose[0] + distance * cos, side)
        j = cell_at(pose[1] + distance * sin, side)
        count = int(record.counts[i & LAST_CELL, j & LAST_CELL])
        if count >= OCCUPIED:
            return step * side
        if 0 < step <= UNSEEN_CELLS and count == 0:
            unseen += 1
        if 2 * unseen > UNSEEN_CELLS:
            return -1.0
    return FARTHEST_CLEARANCE * record.radius  # type: ignore[no-any-return]


@loop
def update_alone(records: Any, *inputs: Any) -> None:
    """`update_map` for the robot of a single environment. `inputs` are its other arguments."""
    update_map(records[0], *inputs)


class MapSensor(Sensor):
    """Adds what has been seen around the robot, and the way to the goal, see `MAP_NAMES`.

    It needs a LiDAR among the robot's sensors, and a goal in the scene.

    Args:
        link: Link of the robot.
        config: Robot configuration.
        period: Duration of an env step [s].
    """

    name = MAP
    size = len(MAP_NAMES)
    low = MAP_LOW
    high = MAP_HIGH
    needs = (LIDAR,)

    def __init__(self, link: Link | None, config: RobotConfig, period: float = 0.1) -> None:
        self.config = config
        self.records = make_record(config, period)
        """(1,): The `RECORD` of the robot."""
        self._rays = make_rays(config)
        self._scratch = np.zeros(SCRATCH, np.int32)
        self.odometry = Odometry.of(config)
        self.goal = (0.0, 0.0)

    @property
    def _record(self) -> Any:
        """The memory, for Python. The view isn't kept, because copies would not share memory."""
        return self.records.view(np.recarray)[0]

    def reset(self, robots: SensorInput) -> None:
        """Forget everything.

        Raises:
            ConfigError: The scene has no goal.
        """
        scene = robots.scenes[0]
        if scene.goal is None:
            raise ConfigError("sensor 'map': the scene has no goal, to which it shows the way")
        self.goal = to_odometry(scene.start, (*scene.goal, 0.0))[:2]
        clear_map(self._record)

    def read(self, robots: SensorInput, out: Floats) -> None:
        """Fill in the numbers that `MAP_NAMES` names, (1, size)."""
        lidar: Any = self.needed[LIDAR]
        bearings, _, times, stamp = lidar.revolution
        inputs = (
            float(robots.now[0]),
            self.odometry.pose,
            self.goal,
            lidar.scan.ranges,
            self._rays,
            (bearings, times, stamp),
            self._scratch,
            out[0],
        )
        update_alone(self.records, *inputs)

    def move_goal(self, goal: Place) -> None:
        """Lead to another goal of the running episode, x and y in the odometry frame [m].

        The way is planned again in the next step. If the goal has moved by less than a cell, as by
        a small correction of a map, the robot keeps to its way.
        """
        if math.dist(goal, self.goal) >= self.cell_side:
            self.goal = goal
            record = self._record
            record.corners = record.corner = 0
            record.age = OLDEST_WAY

    @property
    def time(self) -> float:
        """Time of the newest scan on the link's clock, to which `movers` refers [s]."""
        return float(self._record.now)

    @property
    def movers(self) -> Floats:
        """(n, 5): Moving objects in the odometry frame: x, y [m], velocity [m/s], radius [m]."""
        tracks = self._record.tracks
        moves = (tracks[:, AGE] > 0.0) & (tracks[:, MOVES] > 0.0)
        return np.array(tracks[moves, : RADIUS + 1])

    @property
    def pose(self) -> Pose:
        """The robot's pose by odometry: x [m], y [m], theta [rad]."""
        return self.odometry.pose

    @property
    def cell_side(self) -> float:
        """Side of a cell [m]."""
        return float(self._record.side)

    @property
    def way_ahead(self) -> Floats:
        """(corners, 4): The corners ahead in the odometry frame, the last of which is the goal.

        x [m], y [m], length of the way from there to the goal [m], and cost of the piece that ends
        there [cells].
        """
        record = self._record
        return np.array(record.points[record.corner : record.corners])

    def point_ahead(self, length: float) -> Place:
        """Find the point at a distance from the robot along the way.

        Args:
            length: Distance along the way [m].

        Returns:
            The point in the odometry frame, at most the goal [m].
        """
        return point_ahead(self.way_ahead, self.pose[:2], length)

    def cells_met(self, reach: float) -> NDArray[np.int64]:
        """Find the cells around the robot in which scans have met something.

        Args:
            reach: Half side of a square around the robot [m]. The map ends 16 radii away.

        Returns:
            (cells, 2): The cells, counted from the odometry frame's origin.
        """
        record = self._record
        count = min(math.ceil(reach / self.cell_side), HALF - 1)
        window = np.arange(-count, count + 1) + HALF
        i = window + record.first_i
        j = window + record.first_j
        met = record.counts[np.ix_(i & LAST_CELL, j & LAST_CELL)] > COUNT_FREE
        first = i[0], j[0]
        cells: NDArray[np.int64] = np.argwhere(met) + first
        return cells


def find_map(sensors: Iterable[Sensor]) -> MapSensor | None:
    """Return the map among a robot's sensors, or None."""
    map_sensor: MapSensor | None = find_sensor(sensors, MAP)
    return map_sensor
