"""The robot's pose by odometry, from the observation alone.

An observation has the goal in the base frame, exactly, and the velocity at its end. Between two of
them the robot moves by a length s along an arc that turns by w. What is unknown are these two
numbers; the goal's two coordinates before and after the step give two equations,

    goal' = R(-w) (goal - s (cos w/2, sin w/2)),

which are solved by least squares (Gauss-Newton) together with the velocities' own estimate, which
counts little: it decides where the goal can't, as s does for a goal abeam.
"""

from __future__ import annotations

import math

Pose = tuple[float, float, float]
Point = tuple[float, float]
ROUNDS = 3
TRUST = 1e-4
"""Weight of the velocities against the goal's coordinates, both in [m] and [rad]."""


class Motion:
    """Dead reckoning from observations; the first pose is the origin.

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
            length, turn = moved(self._seen, goal, length, turn)
        x, y, theta = self.pose
        heading = theta + turn / 2.0
        self.pose = (x + length * math.cos(heading), y + length * math.sin(heading), theta + turn)
        self._seen, self._twist = goal, twist
        return self.pose


def moved(before: Point, after: Point, length: float, turn: float) -> tuple[float, float]:
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
    for _ in range(ROUNDS):
        cos, sin = math.cos(turn / 2.0), math.sin(turn / 2.0)
        dx, dy = before[0] - length * cos, before[1] - length * sin
        c, s = math.cos(turn), math.sin(turn)
        x, y = c * dx + s * dy, c * dy - s * dx
        # Derivatives of (x, y) by length and by turn.
        ex, ey = 0.5 * length * sin, -0.5 * length * cos
        x_l, y_l = -(c * cos + s * sin), -(c * sin - s * cos)
        x_t, y_t = y + c * ex + s * ey, -x + c * ey - s * ex
        rx, ry = after[0] - x, after[1] - y
        a = x_l * x_l + y_l * y_l + TRUST
        b = x_l * x_t + y_l * y_t
        d = x_t * x_t + y_t * y_t + TRUST
        u = x_l * rx + y_l * ry + TRUST * (first[0] - length)
        v = x_t * rx + y_t * ry + TRUST * (first[1] - turn)
        det = a * d - b * b
        length, turn = length + (d * u - b * v) / det, turn + (a * v - b * u) / det
    return length, turn
