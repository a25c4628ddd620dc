"""Optimal reciprocal collision avoidance: half planes of velocities that meet no mover.

Van den Berg, Guy, Lin & Manocha, "Reciprocal n-body collision avoidance", ISRR 2011. A mover
forbids the velocities with which the robot would meet it within a horizon if it kept its own. The
robot keeps to a half plane without them, and chooses the velocity within all half planes that is
nearest to the velocity along the way of its map. Obstacles forbid velocities with which the nearest
place of the exact footprint would reach it within a shorter horizon. These half planes hold in any
case.

A robot that can't move sideways turns towards that velocity within a disc that has a margin for the
difference, as in Alonso-Mora et al., "Optimal reciprocal collision avoidance for multiple
non-holonomic robots", DARS 2010. Its speed is what the half planes leave along its heading.
The frame is that of the robot when a command takes effect.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from acsar_gym.envs.robot_env import RobotEnv
from acsar_gym.errors import PolicyError
from acsar_gym.jit import loop
from acsar_gym.tasks.state import Floats
from acsar_gym.tools.baselines.base import Periods, Radii, RobotUnits, Speeds
from acsar_gym.tools.baselines.half_planes import BOX, A, B, C, make_box, solve_programme
from acsar_gym.tools.baselines.mapped import (
    NO_TRACKS,
    RADIUS,
    RATE_X,
    RATE_Y,
    MappedPolicy,
    Pose,
    X,
    Y,
    blend_of,
    to_base,
)
from acsar_gym.tools.policies.policy import DecodedObservation, PolicyContext
from acsar_gym.truth import GroundTruth
from acsar_gym.worlds.geometry import Surroundings, footprint_gap, make_surroundings

LAG_STEPS = 4
"""Steps in which the robot's motion until a command takes effect is predicted."""
ACROSS = 0.05
"""Half planes whose border is so nearly parallel to the heading don't limit the speed."""


class OrcaConstants(NamedTuple):
    """Constants of ORCA. `constants.yaml` has those of the presets."""

    horizon: float = 2.0
    """Movers that would be met later don't count [s]."""
    wall_horizon: float = 0.5
    """Obstacles aren't reached sooner [s]."""
    share: float = 1.0
    """Share of the avoidance that the robot takes: 0.5 if others take the rest."""
    mover_margin: float = 0.2
    """Margin of the disc around the footprint, as a share of its radius."""
    wall_margin: Radii = 0.1
    """Least clearance from obstacles [radius]."""
    lookahead: Radii = 3.0
    """Distance along the way of the point that the robot heads for [radius]."""
    delay: Periods = 1.5
    """Time until a command takes effect [period]."""
    turn_gain: float = 3.0
    """Yaw rate for a velocity whose bearing is 1 rad [1/s]."""
    reverse_share: Speeds = 0.4
    """Greatest speed backwards [top speed]."""
    reverse_bearing: float = 1.75
    """The robot backs off slowly if the bearing is larger [rad]."""


class Orca(MappedPolicy):
    """Chooses the velocity nearest to the wanted velocity that meets none of the tracked movers."""

    name = "orca"
    follows_movers = True
    constants = OrcaConstants()

    def equip(self, setting: PolicyContext) -> None:
        """Prepare for a robot and a task."""
        super().equip(setting)
        self._surroundings = make_surroundings(None, None, setting.config)

    def decide(self, pose: Pose, seen: DecodedObservation) -> tuple[float, float]:
        """Choose the velocity command [m/s, rad/s]."""
        # Where the robot will be when the command takes effect.
        units = self.units
        k = self.constants
        twist = (seen.linear, seen.angular)
        pose_then, speed = predict_pose(pose, twist, self.sent, units.lag, k.delay)

        # What obstacles and movers leave of the velocities.
        tracks = self.tracks()
        reach = units.speed * (k.wall_horizon + k.delay) + units.radius + k.wall_margin
        points = to_base(pose_then, self.obstacles(pose, seen, reach))
        moved = tracks[:, X:RATE_X] + k.delay * tracks[:, RATE_X:RADIUS]
        rates = to_base((0.0, 0.0, pose_then[2]), tracks[:, RATE_X:RADIUS])
        movers = np.column_stack([to_base(pose_then, moved), rates, tracks[:, RADIUS]])
        walls = forbid_walls(points, k, self._surroundings)
        planes = np.vstack([walls, forbid_movers(movers, speed, k, units)])
        hard = BOX + len(walls)

        # The velocity within them that is nearest to the velocity along the way.
        x, y = self.carrot(pose_then, k.lookahead)
        share = units.speed / max(math.hypot(x, y), 1e-6)
        speeds = (-units.speed, units.speed)
        within = np.vstack([make_box(speeds, speeds), planes])
        vx, vy = solve_programme(within, hard, share * x, share * y)

        # The command: turn towards it, or away from it to back off.
        bearing = math.atan2(vy, vx)
        fast = math.hypot(vx, vy)
        direction = 1.0
        if abs(bearing) > k.reverse_bearing and fast <= k.reverse_share:
            bearing = math.remainder(bearing + math.pi, math.tau)
            direction = -1.0
        turn = min(max(k.turn_gain * bearing, -units.turning), units.turning)
        wanted = direction * fast * max(math.cos(bearing), 0.0)
        box = make_box((-k.reverse_share, units.speed), (0.0, 0.0))
        within = np.vstack([box, planes_along(planes, units.period * turn)])
        speed, _ = solve_programme(within, hard, wanted, 0.0)
        return speed, turn


class OrcaTrue(Orca):
    """As `Orca`, with the true places and velocities."""

    name = "orca_true"
    privileged = True
    follows_movers = False
    env: RobotEnv
    """Env that it drives, see `watch`."""

    def watch(self, env: RobotEnv) -> None:
        """Take the env whose truth it knows.

        Args:
            env: Env that it will drive.

        Raises:
            PolicyError: The env isn't simulated.
        """
        if env.robot.link.truth is None:
            raise PolicyError(
                f"{self.path}: knows what only a simulator does, and drives no real robot: use "
                "--link planar, or another policy"
            )
        self.env = env

    def tracks(self) -> Floats:
        """As `MappedPolicy.tracks`, without an error."""
        return true_tracks(self.env.robot.link.truth or GroundTruth(), self.map.pose)


def true_tracks(truth: GroundTruth, pose: Pose) -> Floats:
    """(m, 5): as `MappedPolicy.tracks`, of a robot whose pose by odometry is `pose`."""
    if truth.crowd is None:
        return NO_TRACKS

    # The odometry has drifted: turn and move the world's places by the difference of the poses.
    states = truth.crowd.states
    turned = truth.pose[2] - pose[2]
    cos = math.cos(turned)
    sin = math.sin(turned)
    back = np.array([[cos, -sin], [sin, cos]])
    places = pose[:2] + (states[:, X:RATE_X] - truth.pose[:2]) @ back
    return np.column_stack([places, states[:, RATE_X:RADIUS] @ back, truth.crowd.radii])


@loop
def predict_pose(
    pose: Pose, twist: tuple[float, float], sent: tuple[float, float], lag: float, seconds: float
) -> tuple[Pose, float]:
    """Where the robot will be if the last command stays, and its speed then [m/s].

    `lag` is the time constant of the motors [s].
    """
    x, y, theta = pose
    linear, angular = twist
    step = seconds / LAG_STEPS
    blend = blend_of(step, lag)

    for _ in range(LAG_STEPS):
        linear += blend * (sent[0] - linear)
        angular += blend * (sent[1] - angular)
        theta += angular * step
        x += linear * step * math.cos(theta)
        y += linear * step * math.sin(theta)
    return (x, y, theta), linear


@loop
def forbid_walls(points: Floats, constants: OrcaConstants, footprint: Surroundings) -> Floats:
    """Return the half planes that obstacles leave, (n, 3), in the base frame.

    Args:
        points: (n, 2): obstacles [m].
        constants: The constants in SI units.
        footprint: Footprint of the robot.
    """
    planes = np.empty((len(points), 3))
    for n in range(len(points)):
        x = points[n, X]
        y = points[n, Y]
        gap, at_x, at_y = footprint_gap(x, y, footprint, 0)

        # An obstacle within the footprint pushes the robot's centre away.
        if gap == 0.0:
            at_x = at_y = 0.0
        distance = math.sqrt((x - at_x) ** 2 + (y - at_y) ** 2) + 1e-9
        fastest = max(gap - constants.wall_margin, 0.0) / constants.wall_horizon
        planes[n] = ((at_x - x) / distance, (at_y - y) / distance, -fastest)
    return planes


@loop
def forbid_movers(
    movers: Floats, speed: float, constants: OrcaConstants, units: RobotUnits
) -> Floats:
    """Return the half planes that movers leave to a robot of that speed, section 4 of the paper.

    Args:
        movers: (m, 5): x, y [m], their rates [m/s], and radius [m], in the base frame.
        speed: Speed of the robot [m/s].
        constants: The constants in SI units.
        units: Limits of the robot.

    Returns:
        (m, 3), in the base frame.
    """
    planes = np.empty((len(movers), 3))
    for m in range(len(movers)):
        x = movers[m, X]
        y = movers[m, Y]
        radius = (1.0 + constants.mover_margin) * units.radius + movers[m, RADIUS]
        square = x * x + y * y
        is_near = square <= radius * radius
        horizon = units.period if is_near else constants.horizon  # touching ends at once

        # The velocity relative to the mover, and to the centre of the cap of forbidden velocities.
        vx = speed - movers[m, RATE_X]
        vy = -movers[m, RATE_Y]
        wx = vx - x / horizon
        wy = vy - y / horizon
        along = wx * x + wy * y
        from_cap = wx * wx + wy * wy

        # The nearest border: of the cap, or of one of the legs.
        if is_near or (along < 0.0 and along * along > radius * radius * from_cap):
            length = math.sqrt(from_cap) + 1e-9
            a = wx / length
            b = wy / length
            push = radius / horizon - length
        else:
            side = 1.0 if x * wy - y * wx > 0.0 else -1.0
            leg = side * math.sqrt(square - radius * radius)
            a = -(x * radius + y * leg) / square
            b = (x * leg - y * radius) / square
            push = -(a * vx + b * vy)
        planes[m] = (a, b, a * speed + constants.share * push)
    return planes


def planes_along(planes: Floats, heading: float) -> Floats:
    """Return the half planes as limits of the speed along a heading."""
    slope = planes[:, A] * math.cos(heading) + planes[:, B] * math.sin(heading)
    limits = np.full_like(planes, (1.0, 0.0, -math.inf))
    rows = np.abs(slope) > ACROSS
    limits[rows, A] = np.sign(slope[rows])
    limits[rows, C] = planes[rows, C] / np.abs(slope[rows])
    return limits
