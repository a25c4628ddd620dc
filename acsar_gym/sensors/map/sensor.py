"""A map that remembers, as a sensor: what is free around the robot, and the way to the goal.

It keeps what the LiDAR has seen in a grid of cells (`seen`), by the robot's odometry, and the way
to the goal over it (`way`). What it adds to the observation is in units of the robot, so that one
policy can drive robots of any size and speed. One robot and a batch call the same function.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
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
from acsar_gym.sensors.lidar import LidarSensor
from acsar_gym.sensors.map.arcs import ARCS, BANDS, LONGEST_ARC, measure_arcs, tabulate_arcs
from acsar_gym.sensors.map.courses import COURSE_STEPS, COURSES, tabulate_courses
from acsar_gym.sensors.map.seen import (
    CELL_SHIFT,
    CELL_SIDE,
    CELLS,
    COUNT_FREE,
    LAST_CELL,
    OCCUPIED,
    STAMP_REACH,
    STAMP_WIDTH,
    Floats,
    Grid,
    add_scan,
    cell_at,
    make_stamp,
    move_window,
)
from acsar_gym.sensors.map.tracks import (
    AGE,
    MOST_TRACES,
    MOST_TRACKS,
    MOVES,
    RADIUS,
    TRACK_NUMBERS,
    clear_tracks,
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
)
from acsar_gym.sensors.sensor import MAP, Sensor
from acsar_gym.trigonometry import angle_of, cos_sin
from acsar_gym.truth import GroundTruth
from acsar_gym.worlds import Scene
from acsar_gym.worlds.world import to_odometry

SECTORS = 48
"""Directions around the robot, in each of which the nearest obstacle counts."""
BEARING_SHIFT = 1e-5
"""Added to a ray's bearing, because rays often point to where two sectors meet [rad]."""
REACH_STEPS = 720
"""Directions in which the footprint's reach is tabulated."""
NEAR_SHARE = 0.25
"""Clearances are observed on a logarithmic scale, above this one, in radii of the footprint."""
FARTHEST_CLEARANCE = 16.0
"""Clearances beyond count as this one, in radii."""
UNSEEN_CELLS, UNSEEN_CLEARANCE = 6, 0.5
"""Where the LiDAR doesn't look, the nearest cells count: if most of them have never been seen, the
clearance is this one, in radii."""
FARTHEST_WAY = 64.0
"""So does a longer way to the goal, in radii."""
LOOKAHEADS = (2.0, 4.0, 8.0)
"""Points of the way are observed that lie so far ahead along it, in radii."""
OLDEST_WAY, NEWEST_WAY = 20, 3
"""A way is planned anew after so many steps, at most, and at least."""
DEARER = 1.1
"""It is planned anew where a piece of it has become dearer by this factor, or by DEARER_CELLS."""
DEARER_CELLS = 4.0
SWITCH = 1.05
"""The robot keeps to its way unless it costs more than another one by this factor, so that it
doesn't waver between two that are as good."""
SLIDE_ACCELERATION = 0.7
"""With more acceleration sideways tyres slide, and odometry drifts [m/s^2]. After 2 s of a circle
at 1 m/s^2 the heading of a simulated Jackal's odometry is off by up to 0.1 rad, at 2 m/s^2 by 0.5,
at 4 m/s^2 by more."""
STALL_STEPS, STALL_GAIN = 50, 0.25
"""A robot whose way hasn't become shorter by STALL_GAIN radii for so many steps is stalled."""
GAIN_LIMIT = 2.0
BODY = (
    "width",
    "top_speed",
    "top_turn_rate",
    "stopping",
    "turn_stopping",
    "lag",
    "sight",
    "grip",
)
"""What is told about the robot itself."""
GAINED = 0
"""Place of the number that says by how much the way has become shorter in the last step, in parts
of what the robot's top speed would give."""
MAP_NAMES = (
    "gained",
    "way_left",
    *(f"way_{part}_{n}" for n in range(len(LOOKAHEADS)) for part in ("cos", "sin")),
    *(f"way_cost_{n}" for n in range(len(LOOKAHEADS))),
    "stalled",
    *BODY,
    *(f"clearance_{n}" for n in range(SECTORS)),
    *(f"arc_{n}" for n in range(ARCS)),
    *(f"wide_arc_{n}" for n in range(ARCS)),
)
"""The numbers that the map adds to the observation."""
STALLED = MAP_NAMES.index("stalled")
"""Place of the number that says for how long the way hasn't become shorter."""
FIRST_SECTOR = MAP_NAMES.index("clearance_0")
FIRST_ARC = MAP_NAMES.index("arc_0")
MAP_LOW = np.array(
    [
        -GAIN_LIMIT if n == "gained" else -1.0 if n.startswith(("way_cos", "way_sin")) else 0.0
        for n in MAP_NAMES
    ]
)
MAP_HIGH = np.array([GAIN_LIMIT if n == "gained" else 1.0 for n in MAP_NAMES])

RECORD = np.dtype(
    [
        ("side", np.float64),  # of a cell [m]
        ("radius", np.float64),  # of the footprint's disc [m]
        ("pace", np.float64),  # what the top speed drives in a step [m]
        ("body", np.float64, (len(BODY),)),
        ("reach", np.float64, (REACH_STEPS,)),  # of the footprint, from the base's middle [m]
        ("spans", np.float64, (ARCS, 2)),  # of the footprint beside arcs [m]
        ("fronts", np.float64, (ARCS, BANDS, 4)),  # of the footprint along arcs [m]
        ("courses", np.float64, (len(COURSES), COURSE_STEPS, 2)),  # places on them [m]
        ("stamp", np.uint8, (2 * STAMP_REACH + 1, STAMP_WIDTH)),
        ("counts", np.uint8, (CELLS, CELLS)),
        ("costs", np.uint8, (CELLS, CELLS)),
        ("points", np.float64, (MOST_POINTS, 4)),
        ("draft", np.float64, (MOST_POINTS, 4)),  # of another way
        ("middle_i", np.float64),  # cell of the robot
        ("middle_j", np.float64),
        ("corners", np.float64),  # of the way
        ("corner", np.float64),  # that the robot drives to
        ("left", np.float64),  # length of the way [m]
        ("age", np.float64),  # of the way [steps]
        ("turn", np.float64),  # scans so far
        ("least", np.float64),  # least length of this way so far [m]
        ("waited", np.float64),  # steps since it was reached
        ("top_speed", np.float64),  # of the robot [m/s]
        ("tracks", np.float64, (MOST_TRACKS, TRACK_NUMBERS)),  # see `tracks`
        ("traces", np.int32, (MOST_TRACKS, MOST_TRACES)),  # cells: row * CELLS + column
        ("now", np.float64),  # time that the tracks refer to [s]
        ("scanned", np.float64),  # when the newest revolution ended [s]
    ]
)
"""Map of a robot: its own numbers, cells, the way, and what moves."""


def make_record(config: RobotConfig, period: float) -> NDArray[Any]:
    """Make the empty map of a robot, an array of one `RECORD`."""
    made = np.zeros(1, RECORD)
    outline = config.outline
    radius, inner = outline_radius(outline), border_distance(outline, 0.0, 0.0)
    made["side"], made["radius"] = CELL_SIDE * radius, radius
    made["pace"], made["top_speed"] = config.max_linear * period, config.max_linear
    made["body"], made["reach"] = describe_body(config), _reach(outline)
    made["spans"], made["fronts"] = tabulate_arcs(outline)
    made["courses"] = tabulate_courses(radius, config.max_linear, config.max_angular)
    made["stamp"] = make_stamp(inner, radius)
    return made


@lru_cache(maxsize=1024)
def _reach(outline: Outline) -> Floats:
    """(REACH_STEPS,): from the base's middle to the edge, in directions from -pi on [m]."""
    angles = (np.arange(REACH_STEPS) + 0.5) * FULL_TURN / REACH_STEPS - math.pi
    return outline_reach(outline, (0.0, 0.0), angles)


def describe_body(config: RobotConfig) -> Floats:
    """Compute what is told about a robot, (len(BODY),), each about 0 to 1.

    From its configuration alone: not what an episode has drawn.
    """
    radius = outline_radius(config.outline)
    inner = border_distance(config.outline, 0.0, 0.0)
    speed, turn = config.max_linear, config.max_angular
    slowing = config.motor.of_wheel(0).acceleration * config.wheel_radius
    most, most_turn = config.linear_limits.max_acceleration, config.angular_limits.max_acceleration
    slowing_turn = 2.0 * slowing / config.effective_separation
    slow = min(slowing, slowing if most is None else most)
    slow_turn = min(slowing_turn, slowing_turn if most_turn is None else most_turn)
    lag = 1.0 / config.feedback_rate + config.firmware.processing_time + config.encoder.window
    scale = 4.0
    return np.clip(
        [
            inner / radius,
            speed / radius / 10.0,
            turn / scale,
            speed * speed / (2.0 * slow) / radius / scale,
            turn * turn / (2.0 * slow_turn) / math.pi,
            (lag + 1.0 / config.lidar.rate) * speed / radius,
            config.lidar.max_range / radius / 32.0,
            SLIDE_ACCELERATION / (speed * turn),
        ],
        0.0,
        1.0,
    )


@subroutine
def clear_map(record: Any) -> None:
    """Forget everything, at the begin of an episode."""
    record.counts[:] = 0
    record.costs[:] = 0
    record.middle_i = record.middle_j = 0.0
    record.corners = record.corner = record.left = record.turn = 0.0
    record.least = record.waited = 0.0
    record.age = OLDEST_WAY
    clear_tracks(record)


@subroutine
def update_map(  # noqa: PLR0913, PLR0915, PLR0917 - compiled, so no keywords
    record: Any,
    now: float,
    pose: tuple[float, float, float],
    goal: tuple[float, float],
    ranges: Floats,
    rays: Rays,
    measured: tuple[Floats, Floats, float],
    scratch: Ints,
    out: Floats,
) -> None:
    """Add what the robot sees now, follow the way or plan another one, and say what is around.

    Args:
        record: `RECORD` of the robot.
        now: time [s].
        pose: by odometry, x [m], y [m], theta [rad].
        goal: in the odometry frame [m].
        ranges: (rays,): the scan [m].
        rays: of the LiDAR.
        measured: bearings [rad] and times [s] of the revolution that the scan is made of, and when
            it ended [s].
        scratch: (SCRATCH,): for the search.
        out: (len(MAP_NAMES),): gets what the map adds to the observation.
    """
    side, radius, points = record.side, record.radius, record.points
    grid = Grid(record.counts, record.costs)
    x, y = pose[0], pose[1]
    middle = cell_at(x, side), cell_at(y, side)
    move_window(grid, int(record.middle_i), int(record.middle_j), middle[0], middle[1])
    record.middle_i, record.middle_j = float(middle[0]), float(middle[1])
    moving = np.empty(len(ranges), np.uint8)
    update_tracks(record, now, pose, middle, ranges, rays, measured, moving)
    add_scan(grid, record.stamp, side, pose, middle, ranges, rays, int(record.turn), moving)
    record.turn += 1.0

    count, corner, before = int(record.corners), int(record.corner), record.left
    gained = 0.0
    record.age += 1.0
    stale = count == 0 or record.age >= OLDEST_WAY
    if count > 0:
        corner = next_corner(points, count, corner, x, y)
        gained = before - length_left(points, corner, x, y)
        if record.age >= NEWEST_WAY and not stale:
            _, stale = weigh_way(grid, side, middle, points, count, corner, (x, y), False)
    if stale:
        draft = record.draft
        found = plan_way(grid, side, middle, (x, y), goal, draft, scratch)
        cost, _ = weigh_way(grid, side, middle, points, count, corner, (x, y), True)
        if count == 0 or cost > SWITCH * sum_costs(draft, found):
            points[:], count, corner = draft, found, 1
            record.least = length_left(points, corner, x, y)
        record.corners, record.age = float(count), 0.0
    record.corner, record.left = float(corner), length_left(points, corner, x, y)
    record.waited += 1.0
    if record.left < record.least - STALL_GAIN * radius:
        record.least, record.waited = record.left, 0.0

    out[GAINED] = min(max(gained / record.pace, -GAIN_LIMIT), GAIN_LIMIT)
    out[1] = log_share(record.left / radius, FARTHEST_WAY)
    cos, sin = cos_sin(pose[2])
    from_x, from_y, place = x, y, 2
    for n in range(len(LOOKAHEADS)):
        to_x, to_y = point_ahead(points, count, corner, x, y, LOOKAHEADS[n] * radius)
        dx, dy = to_x - x, to_y - y
        far = max(math.sqrt(dx * dx + dy * dy), 1e-9)
        out[place] = min(max((dx * cos + dy * sin) / far, -1.0), 1.0)
        out[place + 1] = min(max((dy * cos - dx * sin) / far, -1.0), 1.0)
        _, dearest = piece_cost(grid.costs, side, middle, (from_x, from_y), (to_x, to_y))
        out[2 + 2 * len(LOOKAHEADS) + n] = min(dearest / 64.0, 1.0)
        from_x, from_y = to_x, to_y
        place += 2
    out[STALLED] = min(record.waited / STALL_STEPS, 1.0)
    place = STALLED + 1
    for n in range(len(BODY)):
        out[place + n] = record.body[n]
    spots = np.empty((len(ranges) + SECTORS, 2))
    seen = fill_sectors(record, pose, ranges, rays, out[FIRST_SECTOR:FIRST_ARC], spots)
    measure_arcs(record.spans, record.fronts, radius, spots[:seen], out[FIRST_ARC:])
    for n in range(FIRST_ARC, len(MAP_NAMES)):
        out[n] = log_share(out[n], LONGEST_ARC)


@jit
def log_share(value: float, most: float) -> float:
    """Length or clearance, in radii, on a logarithmic scale from 0 to 1."""
    share: float = math.log(1.0 + min(max(value, 0.0), most) / NEAR_SHARE) / math.log(
        1.0 + most / NEAR_SHARE
    )
    return share


@jit
def length_of_share(share: float, most: float) -> float:
    """Length in radii whose `log_share` this is."""
    length: float = NEAR_SHARE * ((1.0 + most / NEAR_SHARE) ** share - 1.0)
    return length


@subroutine
def weigh_way(
    grid: Grid,
    side: float,
    middle: tuple[int, int],
    points: Floats,
    count: int,
    corner: int,
    place: tuple[float, float],
    write: bool,
) -> tuple[float, bool]:
    """Measure what the pieces of the way cost now, from the robot on.

    Returns:
        Their sum [cells], and whether one has become dearer than it was when it was written, as
        where the robot has left the way. `write` writes what they cost now.
    """
    total, dearer = 0.0, False
    for k in range(corner, count):
        begin = place if k == corner else (points[k - 1, 0], points[k - 1, 1])
        cost, _ = piece_cost(grid.costs, side, middle, begin, (points[k, 0], points[k, 1]))
        total += cost
        dearer = dearer or cost > DEARER * points[k, 3] + DEARER_CELLS
        if write:
            points[k, 3] = cost
    return total, dearer


@jit
def sum_costs(points: Floats, count: int) -> float:
    """What the pieces of a way cost together [cells]."""
    total = 0.0
    for k in range(1, count):
        total += points[k, 3]
    return total


@subroutine
def fill_sectors(
    record: Any,
    pose: tuple[float, float, float],
    ranges: Floats,
    rays: Rays,
    out: Floats,
    spots: Floats,
) -> int:
    """Fill in the clearance of the footprint in each direction, see `log_share`.

    Where the LiDAR doesn't look, what was seen before counts.

    Returns:
        How many spots there are.
    """
    reach, radius = record.reach, record.radius
    nothing, seen = 2.0 * FARTHEST_CLEARANCE, 0
    for sector in range(SECTORS):
        out[sector] = nothing
    for ray in range(len(ranges)):
        c, s = cos_sin(rays.start + ray * rays.step)
        x, y = rays.mount_x + ranges[ray] * c, rays.mount_y + ranges[ray] * s
        share = (angle_of(x, y) + math.pi + BEARING_SHIFT) / FULL_TURN
        sector = int(share * SECTORS) % SECTORS
        edge = reach[int(share * REACH_STEPS) % REACH_STEPS]
        clearance = (math.sqrt(x * x + y * y) - edge) / radius
        if ranges[ray] >= rays.farthest - 1e-3:
            clearance = FARTHEST_CLEARANCE
        elif clearance < LONGEST_ARC + 1.0:
            spots[seen, 0], spots[seen, 1] = x, y
            seen += 1
        out[sector] = min(out[sector], clearance, FARTHEST_CLEARANCE)
    for sector in range(SECTORS):
        if out[sector] < nothing:
            continue
        # between two rays, or behind the LiDAR
        left, right = out[(sector + 1) % SECTORS], out[(sector - 1) % SECTORS]
        if left < nothing and right < nothing:
            out[sector] = min(left, right) + nothing
            continue
        bearing = (sector + 0.5) * FULL_TURN / SECTORS - math.pi
        edge = reach[int((sector + 0.5) / SECTORS * REACH_STEPS)]
        clearance = remembered_clearance(record, pose, bearing, edge) / radius
        out[sector] = nothing + (clearance if clearance >= 0.0 else UNSEEN_CLEARANCE)
        if 0.0 <= clearance < FARTHEST_CLEARANCE:
            far, (c, s) = edge + clearance * radius, cos_sin(bearing)
            spots[seen, 0], spots[seen, 1] = far * c, far * s
            seen += 1
    for sector in range(SECTORS):
        clearance = out[sector] - nothing if out[sector] >= nothing else out[sector]
        out[sector] = log_share(clearance, FARTHEST_CLEARANCE)
    return seen


@subroutine
def remembered_clearance(
    record: Any, pose: tuple[float, float, float], bearing: float, edge: float
) -> float:
    """Look for the nearest occupied cell in a direction in which the LiDAR doesn't look.

    Returns:
        Distance from the edge [m]; FARTHEST_CLEARANCE radii where there is none within 8, and -1
        where most of UNSEEN_CELLS have never been seen.
    """
    (c, s), unseen = cos_sin(pose[2] + bearing), 0
    side: float = record.side
    for step in range(int(8.0 / CELL_SIDE)):
        far = edge + step * side
        i, j = cell_at(pose[0] + far * c, side), cell_at(pose[1] + far * s, side)
        count = int(record.counts[i & LAST_CELL, j & LAST_CELL])
        if count >= OCCUPIED:
            return step * side
        if 0 < step <= UNSEEN_CELLS and count == 0:
            unseen += 1
        if 2 * unseen > UNSEEN_CELLS:
            return -1.0
    farthest: float = FARTHEST_CLEARANCE * record.radius
    return farthest


@loop
def update_alone(  # noqa: PLR0913, PLR0917 - as `update_map`
    records: Any,
    now: float,
    pose: tuple[float, float, float],
    goal: tuple[float, float],
    ranges: Floats,
    rays: Rays,
    measured: tuple[Floats, Floats, float],
    scratch: Ints,
    out: Floats,
) -> None:
    """`update_map` for the robot of a single environment."""
    update_map(records[0], now, pose, goal, ranges, rays, measured, scratch, out)


class MapSensor(Sensor):
    """Adds what has been seen around the robot, and the way to the goal, see `MAP_NAMES`.

    It needs a LiDAR among the robot's sensors, and a goal in the scene.

    Args:
        link: the wire to the robot.
        config: of the robot.
        period: of an env step [s].
    """

    name, size, low, high = MAP, len(MAP_NAMES), MAP_LOW, MAP_HIGH
    uses_truth = False
    _lidar: LidarSensor
    """Of the robot, see `watch`."""

    def __init__(self, link: Link | None, config: RobotConfig, period: float = 0.1) -> None:
        self.config = config
        self._records = make_record(config, period)
        self._rays = make_rays(config)
        self._scratch = np.zeros(SCRATCH, np.int32)
        self._odometry = Odometry.of(config)
        self.goal = (0.0, 0.0)

    @property
    def _record(self) -> Any:
        """The memory, as Python reads it: a view made anew, because copies share no memory."""
        return self._records.view(np.recarray)[0]

    def watch(self, lidar: LidarSensor | None) -> None:
        """Take over the LiDAR whose scans are remembered.

        Args:
            lidar: of the robot; None where it has none.

        Raises:
            ConfigError: for None.
        """
        if lidar is None:
            raise ConfigError("sensor 'map': the robot has no 'lidar', which it needs")
        self._lidar = lidar

    def follow(self, odometry: Odometry) -> None:
        """Take over the robot's odometry."""
        self._odometry = odometry

    def reset(self, scene: Scene, rng: np.random.Generator) -> None:
        """Forget everything.

        Args:
            scene: has the goal.
            rng: isn't used.

        Raises:
            ConfigError: the scene has no goal.
        """
        if scene.goal is None:
            raise ConfigError("sensor 'map': the scene has no goal, to which it shows the way")
        self.goal = to_odometry(scene.start, (*scene.goal, 0.0))[:2]
        clear_map(self._record)

    def read(self, truth: GroundTruth | None, now: float) -> Floats:
        """Return the numbers that `MAP_NAMES` names."""
        out, (bearings, _, times, stamp) = np.zeros(self.size), self._lidar.revolution
        update_alone(
            self._records,
            now,
            self._odometry.pose,
            self.goal,
            self._lidar.scan.ranges,
            self._rays,
            (bearings, times, stamp),
            self._scratch,
            out,
        )
        return out

    @property
    def records(self) -> NDArray[Any]:
        """(1,): the `RECORD` of the robot."""
        return self._records

    @property
    def time(self) -> float:
        """Time of the newest scan's reading, which `movers` refers to, on the link's clock [s]."""
        return float(self._record.now)

    @property
    def movers(self) -> Floats:
        """(n, 5): what moves, in the odometry frame: x, y [m], velocity x, y [m/s], radius [m]."""
        tracks = self._record.tracks
        moves = (tracks[:, AGE] > 0.0) & (tracks[:, MOVES] > 0.0)
        return np.array(tracks[moves, : RADIUS + 1])

    @property
    def pose(self) -> tuple[float, float, float]:
        """The robot's pose by odometry: x [m], y [m], theta [rad]."""
        return self._odometry.pose

    @property
    def cell_side(self) -> float:
        """Side of a cell [m]."""
        return float(self._record.side)

    @property
    def way(self) -> Floats:
        """(corners, 2): the way to the goal, from the robot's place when it was planned [m]."""
        return np.array(self._record.points[: int(self._record.corners), :2])

    @property
    def way_ahead(self) -> Floats:
        """(corners, 4): the corners that are ahead, the goal last, in the odometry frame.

        x [m], y [m], length of the way that is left from there [m], and cost of the piece that ends
        there [cells].
        """
        record = self._record
        return np.array(record.points[int(record.corner) : int(record.corners)])

    def point_ahead(self, length: float) -> tuple[float, float]:
        """Find the point that is so far along the way from the robot.

        Args:
            length: along the way [m].

        Returns:
            The point in the odometry frame, the goal at most [m].
        """
        way, (x, y, _) = self.way_ahead, self.pose
        return point_ahead(way, len(way), 0, x, y, length)

    def cells_met(self, reach: float) -> NDArray[np.int64]:
        """Find the cells around the robot in which scans have met something.

        Args:
            reach: half side of a square around the robot [m]; the map ends 16 radii away.

        Returns:
            (cells, 2): the cells, counted from the odometry frame's origin.
        """
        record, count = self._record, min(math.ceil(reach / self.cell_side), CELLS // 2 - 1)
        window = np.arange(-count, count + 1)
        i, j = window + int(record.middle_i), window + int(record.middle_j)
        met = record.counts[np.ix_(i & LAST_CELL, j & LAST_CELL)] > COUNT_FREE
        rows, columns = np.nonzero(met)
        return np.column_stack([i[rows], j[columns]])

    def cells_of(self, places: Floats) -> NDArray[np.int64]:
        """Find the cells that places lie in.

        Args:
            places: (n, 2), in the odometry frame [m].

        Returns:
            (n, 2): see `cells_met`.
        """
        return np.floor(places / self.cell_side + CELL_SHIFT).astype(np.int64)

    def centres_of(self, cells: NDArray[np.int64]) -> Floats:
        """Find the centres of cells.

        Args:
            cells: (n, 2), see `cells_met`.

        Returns:
            (n, 2), in the odometry frame [m].
        """
        return (cells.astype(np.float64) + 0.5 - CELL_SHIFT) * self.cell_side


def find_map(sensors: Sequence[Sensor]) -> MapSensor | None:
    """The map among a robot's sensors; None without one."""
    return next((sensor for sensor in sensors if isinstance(sensor, MapSensor)), None)
