"""Optimal reciprocal collision avoidance: half planes of velocities that no mover forbids.

Van den Berg, Guy, Lin & Manocha, "Reciprocal n-body collision avoidance", ISRR 2011. Each mover
forbids the velocities with which the robot would meet it within a horizon, if it kept its own. Of
these the robot leaves out a half plane, and chooses the velocity within all half planes that is
nearest to the one along the way of its map.

A robot that can't move sideways controls its effective centre, a point some way ahead, which can
move in any direction: Snape, van den Berg, Guy & Manocha, "Smooth and collision-free navigation for
multiple robots under differential-drive constraints", IROS 2010. A wall forbids velocities with
which the nearest place of the exact footprint would reach it within a shorter horizon.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from acsar_gym.jit import jit, loop
from acsar_gym.tasks.state import Floats
from acsar_gym.tools.baselines.base import Privileged
from acsar_gym.tools.baselines.half_planes import BOX, make_box, solve_programme
from acsar_gym.tools.baselines.mapped import MappedPolicy, Pose, to_base, true_tracks
from acsar_gym.tools.policies.policy import DecodedObservation, PolicyContext
from acsar_gym.worlds.geometry import Obstacles, Surroundings, footprint_gap, make_surroundings


@dataclass(frozen=True)
class OrcaConstants:
    """Constants of ORCA; `constants.yaml` has those of the presets."""

    horizon: float = 3.0  # movers that would be met later don't count [s]
    wall_horizon: float = 0.6  # a wall is reached no sooner than this [s]
    share: float = 1.0  # of the avoidance that the robot takes: 0.5 where the others take the rest
    centre: float = 0.5  # the effective centre is so far ahead of the robot's [radius]
    mover_margin: float = 0.2  # added to the radius of movers [radius]
    wall_margin: float = 0.1  # least clearance from walls [radius]
    lookahead: float = 3.0  # distance along the way of the point that it heads for [radius]
    reverse_share: float = 0.3  # greatest speed backwards [top speed]


class CentreModel(NamedTuple):
    """The robot and the constants, in SI units; velocities are those of the effective centre."""

    ahead: float
    """How far the centre is ahead of the robot's [m]."""
    radius: float
    """Of the disc around the centre that covers the footprint, margin included [m]."""
    horizon: float
    wall_horizon: float
    wall_margin: float
    share: float
    period: float


class Orca(MappedPolicy):
    """Chooses the velocity nearest to the wanted one that meets nobody, from tracks of movers."""

    name = "orca"
    follows_movers = True
    constants_type = OrcaConstants
    constants: OrcaConstants

    def equip(self, setting: PolicyContext) -> None:
        """Prepare for a robot and a task."""
        super().equip(setting)
        units, k, config = self.units, self.constants, setting.config
        ahead = k.centre * units.radius
        corners = np.array(config.outline) - (ahead, 0.0)
        self._model = CentreModel(
            ahead=ahead,
            radius=float(np.hypot(*corners.T).max()) + k.mover_margin * units.radius,
            horizon=k.horizon,
            wall_horizon=k.wall_horizon,
            wall_margin=k.wall_margin * units.radius,
            share=k.share,
            period=units.period,
        )
        self._footprint = make_surroundings(Obstacles(), None, 1, config)

    def decide(self, pose: Pose, seen: DecodedObservation) -> tuple[float, float]:
        """Choose the velocity command [m/s, rad/s]."""
        units, k, ahead = self.units, self.constants, self._model.ahead
        x, y = self.carrot(pose, k.lookahead * units.radius)
        far = max(math.hypot(x - ahead, y), 1e-6)
        wanted = units.speed * (x - ahead) / far, units.speed * y / far
        reach = units.speed * k.wall_horizon + units.radius + self._model.wall_margin
        tracks = self.tracks()
        points = to_base(pose, self.obstacles(pose, seen, reach, tracks))
        movers = np.column_stack(
            [to_base(pose, tracks[:, :2]), to_base((0.0, 0.0, pose[2]), tracks[:, 2:4]), tracks[:, 4]]
        )
        window = self._window()
        twist = seen.linear, ahead * seen.angular
        forward, sideways = choose_velocity(
            window, wanted, twist, points, movers, self._model, self._footprint
        )
        return forward, sideways / ahead

    def _window(self) -> tuple[float, float, float, float]:
        """Least and greatest velocity of the centre in a step, ahead and sideways [m/s]."""
        units, (linear, angular) = self.units, self.sent
        faster, turn = units.acceleration * units.period, units.spin * units.period
        return (
            max(min(linear - faster, 0.0), -self.constants.reverse_share * units.speed),
            min(max(linear + faster, 0.0), units.speed),
            self._model.ahead * max(min(angular - turn, 0.0), -units.turning),
            self._model.ahead * min(max(angular + turn, 0.0), units.turning),
        )


class OrcaTrue(Privileged, Orca):
    """As `Orca`, with the true places and velocities."""

    name = "orca_true"
    follows_movers = False

    def tracks(self) -> Floats:
        """As `MappedPolicy.tracks`, without an error."""
        return true_tracks(self.truth, self.map.pose)


@loop
def choose_velocity(
    window: tuple[float, float, float, float],
    wanted: tuple[float, float],
    twist: tuple[float, float],
    points: Floats,
    movers: Floats,
    model: CentreModel,
    footprint: Surroundings,
) -> tuple[float, float]:
    """Choose the velocity of the effective centre; everything in the base frame.

    Args:
        window: least and greatest velocity ahead, and sideways [m/s].
        wanted: the velocity that leads along the way [m/s].
        twist: the present one of the centre [m/s].
        points: (n, 2): what stands [m].
        movers: (m, 5): x, y [m], their rates [m/s], and radius [m].
        model: of the robot.
        footprint: of the robot.

    Returns:
        Velocity ahead, and sideways [m/s].
    """
    planes, count = np.empty((BOX + len(points) + len(movers), 3)), BOX
    make_box(window[0], window[1], window[2], window[3], planes)
    for n in range(len(points)):
        gap, at_x, at_y = footprint_gap(points[n, 0], points[n, 1], footprint, 0)
        if gap == 0.0:
            at_x = at_y = 0.0
        dx, dy = points[n, 0] - at_x, points[n, 1] - at_y
        apart = math.sqrt(dx * dx + dy * dy) + 1e-9
        towards_x = dx / apart
        towards_y = (at_x * dy - at_y * dx) / (apart * model.ahead)
        length = math.sqrt(towards_x * towards_x + towards_y * towards_y)
        fastest = max(gap - model.wall_margin, 0.0) / model.wall_horizon
        if length > 1e-6:
            planes[count, 0], planes[count, 1] = -towards_x / length, -towards_y / length
            planes[count, 2] = -fastest / length
            count += 1
    hard = count
    for n in range(len(movers)):
        forbid_meeting(movers[n], twist, model, planes[count])
        count += 1
    return solve_programme(planes[:count], hard, wanted[0], wanted[1])


@jit
def forbid_meeting(
    mover: Floats, twist: tuple[float, float], model: CentreModel, plane: Floats
) -> None:
    """Write the half plane of velocities that a mover leaves, equations (3) to (5) of the paper."""
    x, y = mover[0] - model.ahead, mover[1]
    both, square = model.radius + mover[4], x * x + y * y
    vx, vy = twist[0] - mover[2], twist[1] - mover[3]
    touching = square <= both * both
    horizon = model.period if touching else model.horizon
    wx, wy = vx - x / horizon, vy - y / horizon
    along, from_cap = wx * x + wy * y, wx * wx + wy * wy
    if touching or (along < 0.0 and along * along > both * both * from_cap):
        length = math.sqrt(from_cap) + 1e-9
        a, b = wx / length, wy / length
        push = both / horizon - length
    else:
        leg = math.sqrt(square - both * both)
        if x * wy - y * wx > 0.0:
            a, b = -(x * both + y * leg) / square, (x * leg - y * both) / square
        else:
            a, b = -(x * both - y * leg) / square, -(x * leg + y * both) / square
        push = -(a * vx + b * vy)
    plane[0], plane[1] = a, b
    plane[2] = a * twist[0] + b * twist[1] + model.share * push
