"""What the planners with a map share: odometry, the map kept from the scans, and the plan on it."""

from __future__ import annotations

import math
from abc import abstractmethod
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import footprint
from acsar_gym.errors import require_extra
from acsar_gym.jit import jit, loop
from acsar_gym.lidar.scan import ray_spec
from acsar_gym.tasks.state import Floats
from acsar_gym.tasks.task import OBSERVATION_LIMIT
from acsar_gym.tools.baselines.base import BaselinePolicy
from acsar_gym.tools.baselines.tuning import Constants, constant
from acsar_gym.tools.policies.policy import GOAL_NUMBERS, DecodedObservation, PolicyContext
from acsar_gym.worlds.geometry import is_inside
from acsar_gym.worlds.search import COST_FADE, Costs, clearance_costs, sweep_distances


@loop
def polygon_distance(x: float, y: float, sides: Floats) -> float:
    """Distance of a point from a polygon, (sides, 4); 0 inside [m]."""
    best = np.inf
    for n in range(len(sides)):
        ax, ay = sides[n, 0], sides[n, 1]
        ex, ey = sides[n, 2] - ax, sides[n, 3] - ay
        share = ((x - ax) * ex + (y - ay) * ey) / (ex * ex + ey * ey)
        share = min(max(share, 0.0), 1.0)
        dx, dy = x - ax - share * ex, y - ay - share * ey
        best = min(best, dx * dx + dy * dy)
    return 0.0 if is_inside(x, y, sides) else math.sqrt(best)


@loop
def points_clearance(
    x: float, y: float, theta: float, points: Floats, sides: Floats, outer: float, most: float
) -> float:
    """Distance of the footprint at a pose from the nearest point.

    Args:
        x: of the pose [m].
        y: of the pose [m].
        theta: of the pose [rad].
        points: (n, 2), in the same frame as the pose [m].
        sides: of the footprint, (sides, 4), in the base frame [m].
        outer: radius of the disc around the footprint [m].
        most: farther points don't count [m].

    Returns:
        The distance, at most `most`; 0 where a point lies within the footprint [m].
    """
    cos, sin, best = math.cos(theta), math.sin(theta), most
    for n in range(len(points)):
        dx, dy = points[n, 0] - x, points[n, 1] - y
        reach = outer + best
        if dx * dx + dy * dy < reach * reach:
            gap = polygon_distance(dx * cos + dy * sin, dy * cos - dx * sin, sides)
            best = min(best, gap)
    return best


CELL_SIZE = 0.05
"""Side of a cell [m]."""
MAP_MARGIN = 5.0
"""How far the map reaches around the line from start to goal [m]."""
HIT_ODDS, MISS_ODDS, MIN_ODDS, MAX_ODDS = 1.0, -0.1, -1.0, 4.0
"""Change of a cell's log odds by a ray's end and by a ray across it, and their bounds."""
OPEN_DISTANCE = 0.1
"""A ray clears no cell within this distance of its end [m]."""


class Costmap:
    """Occupied cells in the odometry frame, kept from the scans: what a ROS user's costmap holds.

    Log odds of each cell: a ray's end makes a cell likelier to be occupied, its way makes those
    that it crosses less so (Moravec & Elfes 1985; Nav2's obstacle layer marks and clears likewise).
    Each cell also keeps the mean place of what was met in it, so that the map is finer than its
    cells.

    Attributes: `odds`, (nx, ny), log odds of cells; `x`, `y`, centre of cell (0, 0) [m].

    Args:
        goal: of the episode, whose start is the origin [m].
    """

    def __init__(self, goal: tuple[float, float]) -> None:
        low = [math.floor((min(0.0, end) - MAP_MARGIN) / CELL_SIZE) for end in goal]
        high = [math.ceil((max(0.0, end) + MAP_MARGIN) / CELL_SIZE) for end in goal]
        self.x, self.y = low[0] * CELL_SIZE, low[1] * CELL_SIZE
        self.odds = np.zeros((high[0] - low[0] + 1, high[1] - low[1] + 1))
        self._places = np.zeros((*self.odds.shape, 3))

    def update(self, origin: tuple[float, float], ends: Floats, met: Floats) -> None:
        """Enter a scan.

        Args:
            origin: of the LiDAR, in the odometry frame [m].
            ends: (rays, 2): ends of the rays, in the odometry frame [m].
            met: (rays,): 1 for a ray that has met something, otherwise 0.
        """
        mark_scan(self.odds, self._places, (self.x, self.y), origin, ends, met)

    def points(self, x: float, y: float, reach: float) -> Floats:
        """(n, 2): what was met within a square of this half side around a point [m]."""
        i, j = round((x - self.x) / CELL_SIZE), round((y - self.y) / CELL_SIZE)
        n = math.ceil(reach / CELL_SIZE)
        part = np.s_[max(i - n, 0) : max(i + n + 1, 0), max(j - n, 0) : max(j + n + 1, 0)]
        places: Floats = self._places[part][self.odds[part] > 0.0][:, :2]
        return places


@loop
def mark_scan(
    odds: Floats,
    places: Floats,
    corner: tuple[float, float],
    origin: tuple[float, float],
    ends: Floats,
    met: Floats,
) -> None:
    """Enter the rays of one scan into the log odds and mean places of cells, see `Costmap`."""
    nx, ny = odds.shape
    for ray in range(len(ends)):
        dx, dy = ends[ray, 0] - origin[0], ends[ray, 1] - origin[1]
        length = math.sqrt(dx * dx + dy * dy)
        last_i, last_j = -1, -1
        for step in range(int((length - OPEN_DISTANCE) / (0.5 * CELL_SIZE))):
            share = 0.5 * CELL_SIZE * step / length
            i = math.floor((origin[0] + share * dx - corner[0]) / CELL_SIZE + 0.5)
            j = math.floor((origin[1] + share * dy - corner[1]) / CELL_SIZE + 0.5)
            if (i != last_i or j != last_j) and 0 <= i < nx and 0 <= j < ny:
                odds[i, j] = max(odds[i, j] + MISS_ODDS, MIN_ODDS)
            last_i, last_j = i, j
    for ray in range(len(ends)):
        i = math.floor((ends[ray, 0] - corner[0]) / CELL_SIZE + 0.5)
        j = math.floor((ends[ray, 1] - corner[1]) / CELL_SIZE + 0.5)
        if met[ray] > 0.0 and 0 <= i < nx and 0 <= j < ny:
            if odds[i, j] <= 0.0:
                places[i, j, 2] = 0.0
            odds[i, j] = min(max(odds[i, j], 0.0) + HIT_ODDS, MAX_ODDS)
            count = min(places[i, j, 2] + 1.0, 10.0)
            places[i, j, 0] += (ends[ray, 0] - places[i, j, 0]) / count
            places[i, j, 1] += (ends[ray, 1] - places[i, j, 1]) / count
            places[i, j, 2] = count


Integers = NDArray[np.int64]
Pose = tuple[float, float, float]
Point = tuple[float, float]
SOLVER_ROUNDS = 3
VELOCITY_WEIGHT = 1e-4
"""Weight of the velocities against the goal's coordinates, both in [m] and [rad]."""


class DeadReckoning:
    """The robot's pose by odometry, from observations alone; the first pose is the origin.

    An observation has the goal in the base frame, exactly, and the velocity at its end. Between two
    of them the robot moves by a length s along an arc that turns by w. What is unknown are these
    two numbers; the goal's two coordinates before and after the step give two equations,

        goal' = R(-w) (goal - s (cos w/2, sin w/2)),

    which are solved by least squares (Gauss-Newton) together with the velocities' own estimate,
    which counts little: it decides where the goal can't, as s does for a goal abeam.

    Attributes: `pose`, x [m], y [m] and theta [rad]; `goal`, in the same frame [m].

    Args:
        goal: in the base frame at the first observation [m].
        period: time between two observations [s].
    """

    def __init__(self, goal: Point, period: float) -> None:
        self.pose: Pose = (0.0, 0.0, 0.0)
        self.goal = goal
        self._seen, self._period = goal, period
        self._twist = (0.0, 0.0)

    def update(self, goal: Point, twist: tuple[float, float], farthest: float) -> Pose:
        """Take the next observation.

        Args:
            goal: in the base frame [m].
            twist: linear [m/s] and angular velocity [rad/s].
            farthest: goals at this distance are farther away than an observation says [m].
        """
        length = (self._twist[0] + twist[0]) / 2.0 * self._period
        turn = (self._twist[1] + twist[1]) / 2.0 * self._period
        if max(math.hypot(*goal), math.hypot(*self._seen)) < farthest:
            length, turn = solve_motion(self._seen, goal, length, turn)
        x, y, theta = self.pose
        heading = theta + turn / 2.0
        self.pose = (x + length * math.cos(heading), y + length * math.sin(heading), theta + turn)
        self._seen, self._twist = goal, twist
        return self.pose


def solve_motion(before: Point, after: Point, length: float, turn: float) -> tuple[float, float]:
    """Solve for the motion between two views of the goal.

    Args:
        before: the goal in the base frame, before [m].
        after: the goal in the base frame, after [m].
        length: first estimate [m].
        turn: first estimate [rad].

    Returns:
        Length [m] and turn [rad] of the motion.
    """
    first = (length, turn)
    for _ in range(SOLVER_ROUNDS):
        cos, sin = math.cos(turn / 2.0), math.sin(turn / 2.0)
        dx, dy = before[0] - length * cos, before[1] - length * sin
        c, s = math.cos(turn), math.sin(turn)
        x, y = c * dx + s * dy, c * dy - s * dx
        # Derivatives of (x, y) by length and by turn.
        ex, ey = 0.5 * length * sin, -0.5 * length * cos
        x_l, y_l = -(c * cos + s * sin), -(c * sin - s * cos)
        x_t, y_t = y + c * ex + s * ey, -x + c * ey - s * ex
        rx, ry = after[0] - x, after[1] - y
        a = x_l * x_l + y_l * y_l + VELOCITY_WEIGHT
        b = x_l * x_t + y_l * y_t
        d = x_t * x_t + y_t * y_t + VELOCITY_WEIGHT
        u = x_l * rx + y_l * ry + VELOCITY_WEIGHT * (first[0] - length)
        v = x_t * rx + y_t * ry + VELOCITY_WEIGHT * (first[1] - turn)
        det = a * d - b * b
        length, turn = length + (d * u - b * v) / det, turn + (a * v - b * u) / det
    return length, turn


FIELD_MARGIN = 1.5
"""How far the field reaches around start, robot, goal and all that is known [m]."""
LETHAL_COST = 60.0
"""Cost of a metre where the footprint would touch something."""


@dataclass(frozen=True)
class MapConstants(Constants):
    """Constants of the plan on the map."""

    tight: float = constant(8.0, 2.0, 20.0)
    """Additional cost of a metre where only the footprint itself fits; it falls to 0 where the disc
    around it does."""
    heavy: float = constant(4.0, 0.5, 12.0)
    """Additional cost of a metre up to there, which fades beyond it."""
    fade: float = constant(0.5, 0.15, 1.5)
    """Distance over which it falls to 1/e [radius]."""


class Potential(NamedTuple):
    """Cost of the cheapest way to the goal, as equivalent metres, on a grid.

    Each cell costs 1 a metre, and more near obstacles. The cost of the cheapest way to the goal, T,
    solves |grad T| = cost, see `acsar_gym.worlds.search`. Nav2's NavFn planner interpolates it too.
    """

    values: Floats
    """(nx, ny), at the cells' centres."""
    x: float
    """x of cell (0, 0) [m], with y the next one."""
    y: float

    def way(self, x: float, y: float, length: float) -> Floats:
        """(n, 2): the way down the potential from a point, so long at most, every half cell [m]."""
        return descend_field(
            self.values, self.x, self.y, x, y, math.ceil(length / (0.5 * CELL_SIZE))
        )


def compute_potential(
    known: Costmap,
    robot: tuple[float, float],
    goal: tuple[float, float],
    radii: tuple[float, float],
    constants: MapConstants,
) -> Potential:
    """Compute the potential of a goal.

    Args:
        known: the map.
        robot: where the robot is [m].
        goal: the goal [m].
        radii: of the circle within the footprint, and of the one around it [m].
        constants: of the costs near obstacles.
    """
    with require_extra("the baseline navfn", "scipy"):
        from scipy.ndimage import distance_transform_edt  # noqa: PLC0415 - slow to import

    occupied = known.odds > 0.0
    more = math.ceil(FIELD_MARGIN / CELL_SIZE)
    window = []  # of the map around what is occupied, the robot and the goal
    for axis, first in ((0, known.x), (1, known.y)):
        filled = np.flatnonzero(occupied.any(axis=1 - axis))
        cells = [round((end[axis] - first) / CELL_SIZE) for end in (robot, goal)]
        cells += [int(filled[0]), int(filled[-1])] if len(filled) else []
        size = occupied.shape[axis]
        low, high = min(max(min(cells) - more, 0), size - 2), max(min(max(cells) + more, size), 2)
        window.append(slice(low, high))
    x, y = known.x + window[0].start * CELL_SIZE, known.y + window[1].start * CELL_SIZE
    occupied = occupied[window[0], window[1]]
    distances = np.full(occupied.shape, 1e3)
    if occupied.any():
        distances = distance_transform_edt(~occupied, sampling=CELL_SIZE)
    values = np.full(occupied.shape, 1e9)
    i, j = round((goal[0] - x) / CELL_SIZE), round((goal[1] - y) / CELL_SIZE)
    near = Costs(lethal=LETHAL_COST, tight=constants.tight, heavy=constants.heavy)
    unit = constants.fade * radii[1] / COST_FADE  # so that they fade over that distance
    costs = clearance_costs(distances / unit, (radii[0] / unit, radii[1] / unit), near)
    sweep_distances(values, costs * CELL_SIZE, i, j)
    return Potential(values, x, y)


@loop
def interpolate_field(values: Floats, left: float, low: float, x: float, y: float) -> float:
    """A field between the centres of its cells; outside it goes on with the slope of distance."""
    u, v = (x - left) / CELL_SIZE, (y - low) / CELL_SIZE
    most_u, most_v = values.shape[0] - 1.001, values.shape[1] - 1.001
    p, q = min(max(u, 0.0), most_u), min(max(v, 0.0), most_v)
    i, j = int(p), int(q)
    a, b = p - i, q - j
    inner = (1.0 - a) * ((1.0 - b) * values[i, j] + b * values[i, j + 1]) + a * (
        (1.0 - b) * values[i + 1, j] + b * values[i + 1, j + 1]
    )
    outside = CELL_SIZE * math.sqrt((u - p) * (u - p) + (v - q) * (v - q))
    value: float = inner + outside
    return value


@loop
def descend_field(values: Floats, left: float, low: float, x: float, y: float, most: int) -> Floats:
    """Points down a field's gradient, every half cell, (n, 2) [m]; ends at the minimum."""
    way = np.empty((most + 1, 2))
    way[0, 0], way[0, 1] = x, y
    for n in range(most):
        here = interpolate_field(values, left, low, x, y)
        gx = interpolate_field(values, left, low, x + CELL_SIZE, y) - interpolate_field(
            values, left, low, x - CELL_SIZE, y
        )
        gy = interpolate_field(values, left, low, x, y + CELL_SIZE) - interpolate_field(
            values, left, low, x, y - CELL_SIZE
        )
        size = math.sqrt(gx * gx + gy * gy)
        if here < CELL_SIZE or size < 1e-9:
            return way[: n + 1]
        x -= 0.5 * CELL_SIZE * gx / size
        y -= 0.5 * CELL_SIZE * gy / size
        way[n + 1, 0], way[n + 1, 1] = x, y
    return way


MotionState = tuple[float, float, float, float, float, float, float]
"""Pose (x, y, theta), twist, and last command (linear, angular) [m, rad, s]."""


BUCKET_SIZE = 0.4
"""Side of the squares into which obstacles are sorted [m]."""


@loop
def sort_points(points: Floats, x: float, y: float, count: int) -> tuple[Floats, Integers]:
    """Sort points into a square of `count` by `count` buckets.

    Args:
        points: (n, 2) [m]; those outside count to the nearest bucket.
        x: of the square's corner [m].
        y: of the square's corner [m].
        count: of buckets along a side.

    Returns:
        The points by bucket, (n, 2), and the place of each bucket's first one, (count^2 + 1,).
    """
    buckets = np.empty(len(points), np.int64)
    firsts = np.zeros(count * count + 1, np.int64)
    for n in range(len(points)):
        i = min(max(int((points[n, 0] - x) / BUCKET_SIZE), 0), count - 1)
        j = min(max(int((points[n, 1] - y) / BUCKET_SIZE), 0), count - 1)
        buckets[n] = i * count + j
        firsts[buckets[n] + 1] += 1
    for k in range(count * count):
        firsts[k + 1] += firsts[k]
    found, filled = np.empty_like(points), firsts.copy()
    for n in range(len(points)):
        found[filled[buckets[n]]] = points[n]
        filled[buckets[n]] += 1
    return found, firsts


class Surroundings(NamedTuple):
    """What surrounds the robot, in the frame of its pose."""

    near: Floats
    """(n, 2): obstacles, sorted into buckets [m]."""
    firsts: Integers
    """See `sort_points`."""
    corner_x: float
    """Of the buckets [m], with y the next one."""
    corner_y: float
    buckets: int
    """How many along a side."""
    sides: Floats
    """(sides, 4): of the footprint, in the base frame [m]."""
    outer: float
    """Radius of the disc around the footprint [m]."""
    values: Floats
    """The navigation function at the centres of its cells [m]."""
    left: float
    """x of its first cell [m], with y the next one."""
    low: float
    x: float
    """Of the goal [m]."""
    y: float
    radius: float
    """Of the goal [m]."""


@loop
def pose_clearance(x: float, y: float, theta: float, around: Surroundings, most: float) -> float:
    """Clearance of the footprint at a pose, at most `most` [m]."""
    reach, count, sides = around.outer + most, around.buckets, around.sides
    left, low = x - reach - around.corner_x, y - reach - around.corner_y
    i0 = min(max(int(left / BUCKET_SIZE), 0), count - 1)
    j0 = min(max(int(low / BUCKET_SIZE), 0), count - 1)
    i1 = min(max(int((left + 2.0 * reach) / BUCKET_SIZE), 0), count - 1)
    j1 = min(max(int((low + 2.0 * reach) / BUCKET_SIZE), 0), count - 1)
    nearest, square = -1, reach * reach
    for i in range(i0, i1 + 1):
        for n in range(around.firsts[i * count + j0], around.firsts[i * count + j1 + 1]):
            dx, dy = around.near[n, 0] - x, around.near[n, 1] - y
            if dx * dx + dy * dy < square:
                nearest, square = n, dx * dx + dy * dy
    if nearest < 0:
        return most
    cos, sin = math.cos(theta), math.sin(theta)
    dx, dy = around.near[nearest, 0] - x, around.near[nearest, 1] - y
    best = min(most, polygon_distance(dx * cos + dy * sin, dy * cos - dx * sin, sides))
    for i in range(i0, i1 + 1):
        for n in range(around.firsts[i * count + j0], around.firsts[i * count + j1 + 1]):
            dx, dy = around.near[n, 0] - x, around.near[n, 1] - y
            if dx * dx + dy * dy < (around.outer + best) * (around.outer + best):
                gap = polygon_distance(dx * cos + dy * sin, dy * cos - dx * sin, sides)
                best = min(best, gap)
                if best == 0.0:
                    return 0.0
    return best


@jit
def in_goal(x: float, y: float, around: Surroundings) -> bool:
    """Whether a place is within the goal."""
    dx, dy = around.x - x, around.y - y
    return dx * dx + dy * dy < around.radius * around.radius


@loop
def way_left(x: float, y: float, theta: float, nose: float, around: Surroundings) -> float:
    """The navigation function `nose` ahead of a pose, so that the heading matters [m]."""
    ahead_x, ahead_y = x + nose * math.cos(theta), y + nose * math.sin(theta)
    return interpolate_field(around.values, around.left, around.low, ahead_x, ahead_y)


REPLAN_STEPS = 3
"""Steps between two plans."""


class MappedPolicy(BaselinePolicy):
    """Keeps a map of the obstacles seen so far, and plans the way to the goal on it."""

    needs = GOAL_NUMBERS
    lidar = True
    constants_type = MapConstants

    def equip(self, setting: PolicyContext) -> None:
        """Prepare for a robot and a task."""
        super().equip(setting)
        config = setting.config
        corners = np.array(config.outline)
        self.sides = np.hstack([corners, np.roll(corners, -1, axis=0)])
        self.outer = self.units.radius
        self.radii = (footprint.border_distance(config.outline, 0.0, 0.0), self.outer)
        self._angles = ray_spec(config).angles()
        self.reset()

    def reset(self) -> None:
        """Forget map and motion."""
        super().reset()
        self._motion: DeadReckoning | None = None
        self._scan = np.zeros((0, 2))
        self._steps = 0
        self.sent = (0.0, 0.0)

    def act(self, seen: DecodedObservation) -> tuple[float, float]:
        """Update pose, map and plan, then decide."""
        if self._motion is None:
            self._motion = DeadReckoning(seen.goal, self.setting.period)
            self.known = Costmap(seen.goal)
        farthest = OBSERVATION_LIMIT * (self.setting.scale or 1.0) - 1e-3
        motion = self._motion
        pose = motion.update(seen.goal, (seen.linear, seen.angular), farthest)
        if seen.ranges is not None:
            config, (x, y, theta) = self.setting.config, pose
            cos, sin = math.cos(theta), math.sin(theta)
            origin = (
                x + cos * config.lidar_x_offset - sin * config.lidar_y_offset,
                y + sin * config.lidar_x_offset + cos * config.lidar_y_offset,
            )
            along = np.column_stack([np.cos(self._angles + theta), np.sin(self._angles + theta)])
            met = seen.ranges < config.lidar.max_range - 1e-3
            ends = origin + seen.ranges[:, None] * along
            self.known.update(origin, ends, met.astype(np.float64))
            self._scan = ends[met]
        if self._steps % REPLAN_STEPS == 0:
            self.plan: Potential = compute_potential(
                self.known, pose[:2], motion.goal, self.radii, self.constants
            )
        self._steps += 1
        self.sent = self.decide(pose, motion.goal, seen)
        return self.sent

    @abstractmethod
    def decide(
        self, pose: Pose, goal: tuple[float, float], seen: DecodedObservation
    ) -> tuple[float, float]:
        """Choose the velocity command.

        Args:
            pose: x [m], y [m], theta [rad] in the odometry frame.
            goal: in the odometry frame [m].
            seen: the observation.

        Returns:
            Linear [m/s] and angular velocity [rad/s].
        """

    def obstacles(self, pose: Pose, reach: float) -> Floats:
        """(n, 2): what is known within a square around the robot, in the odometry frame [m].

        The newest scan counts as it is, too: the mean of a cell may hide a corner.
        """
        near = np.abs(self._scan - pose[:2]).max(axis=1) <= reach
        return np.concatenate([self.known.points(pose[0], pose[1], reach), self._scan[near]])

    def around(
        self, pose: Pose, reach: float, goal: tuple[float, float], radius: float
    ) -> Surroundings:
        """Collect what predicted motions are scored by.

        Args:
            pose: of the robot.
            reach: how far from the robot obstacles count [m].
            goal: in the odometry frame [m].
            radius: of the goal [m].
        """
        plan, (x, y) = self.plan, (pose[0] - reach, pose[1] - reach)
        count = math.ceil(2.0 * reach / BUCKET_SIZE)
        near, firsts = sort_points(self.obstacles(pose, reach), x, y, count)
        return Surroundings(
            near,
            firsts,
            x,
            y,
            count,
            self.sides,
            self.outer,
            plan.values,
            plan.x,
            plan.y,
            *goal,
            radius,
        )

    def carrot(
        self, pose: Pose, goal: tuple[float, float], lookahead: float
    ) -> tuple[float, float]:
        """The point of the plan that is so far from the robot, in the base frame [m].

        Args:
            pose: of the robot.
            goal: which ends the plan [m].
            lookahead: [m].
        """
        way = self.plan.way(pose[0], pose[1], 1.5 * lookahead)
        far = np.hypot(way[:, 0] - pose[0], way[:, 1] - pose[1]) >= lookahead
        x, y = way[int(far.argmax())].tolist() if far.any() else goal
        dx, dy, cos, sin = x - pose[0], y - pose[1], math.cos(pose[2]), math.sin(pose[2])
        return dx * cos + dy * sin, dy * cos - dx * sin
