"""The manoeuvres: what each run drives, and how much floor it needs."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from acsar_gym.config import Geofence, RobotConfig
from acsar_gym.errors import ConfigError
from acsar_gym.worlds.search import footprint_radius

SLACK = 0.25
"""How far a run may end from where odometry puts it, as a share of its extent, before it is
calibrated."""
MARGIN = 0.1
"""Distance to be kept from the edge of the space [m]."""
BACKWARDS = ", backwards"
SLOWER = 0.07
"""How much slower the second and third of three runs are, as a share of the speed."""
MOST_RUNS = 200
"""Most runs of one call."""


@dataclass(frozen=True, slots=True)
class Leg:
    """A part of a run that keeps one turn radius."""

    distance: float
    """Along the path of the robot's centre [m], not negative."""
    angle: float
    """Turned on the way [rad], counter-clockwise positive."""


@dataclass(frozen=True, slots=True)
class Plan:
    """One run: legs from standstill to standstill."""

    name: str
    manoeuvre: str
    """straight, turn or square."""
    legs: tuple[Leg, ...]
    linear: float
    """Speed on the legs that go ahead [m/s]."""
    angular: float
    """Speed of turns in place [rad/s]."""
    back: bool = False
    """Whether it goes backwards, so that the robot returns to where the run before began."""

    def ahead(self) -> Plan:
        """The same, not backwards."""
        return replace(self, name=self.name.removesuffix(BACKWARDS), back=False)


def straights(distance: float, speed: float, repeats: int) -> list[Plan]:
    """Straight runs.

    Args:
        distance: [m].
        speed: of the first run [m/s]; the next ones are slower, so that roundings differ.
        repeats: how many runs; every second one goes backwards, to the start of the one before.
    """
    _positive("--distance", distance, 100.0)
    found = []
    for number in range(1, _count(repeats) + 1):
        back = number % 2 == 0
        name = f"straight {number}" + (BACKWARDS if back else "")
        own = speed * (1.0 - SLOWER * ((number - 1) % 3))
        found.append(Plan(name, "straight", (Leg(distance, 0.0),), own, 0.0, back))
    return found


def turns(
    turned: float, speeds: Sequence[float], radii: Sequence[float], repeats: int
) -> list[Plan]:
    """Turns on the spot and in circles: every speed with every radius, left, right, left...

    Args:
        turned: full turns of each run.
        speeds: [rad/s].
        radii: of the circle of the robot's centre [m]; 0 turns in place.
        repeats: how often each.
    """
    _positive("--turns", turned, 1000.0)
    for radius in radii:
        if not 0.0 <= radius <= 100.0:
            raise ConfigError(f"--radii {radius:g}: must be 0 to 100 m")
    pairs = list(itertools.product(speeds, radii)) * _count(repeats)
    found = []
    for number, (speed, radius) in enumerate(pairs, start=1):
        side = 1.0 if number % 2 else -1.0
        angle = side * turned * math.tau
        where = f", radius {radius:g} m" if radius else ""
        name = f"turn {number}, {'left' if side > 0.0 else 'right'}, {speed:g} rad/s{where}"
        leg = Leg(radius * abs(angle), angle)
        found.append(Plan(name, "turn", (leg,), speed * radius, speed))
    return found


def squares(size: float, linear: float, angular: float, clockwise: int, counter: int) -> list[Plan]:
    """Squares of UMBmark: first all clockwise, then all counter-clockwise; each ends with a turn.

    Args:
        size: length of a side [m].
        linear: speed on the sides [m/s].
        angular: speed at the corners [rad/s].
        clockwise: how many clockwise runs, to the right of the start.
        counter: how many counter-clockwise runs, to the left.
    """
    _positive("--size", size, 100.0)
    _count(clockwise + counter)
    found = []
    for name, side, count in (("cw", -1.0, clockwise), ("ccw", 1.0, counter)):
        legs = (Leg(size, 0.0), Leg(0.0, side * math.pi / 2.0)) * 4
        found += [
            Plan(f"square {name} {n}", "square", legs, linear, angular) for n in range(1, count + 1)
        ]
    return found


def needed(plans: Sequence[Plan], config: RobotConfig) -> tuple[float, float]:
    """The floor that runs need ahead of the robot's centre, and to each of its sides [m].

    Includes the robot itself, a margin, and slack for what isn't calibrated yet.
    """
    reach = footprint_radius(config) + MARGIN
    points = [point for plan in plans for point in _outline(plan)]
    ahead, aside = max(x for x, _ in points), max(abs(y) for _, y in points)
    slack = SLACK * max(ahead, aside)
    return ahead + slack + reach, aside + slack + reach


def check_space(
    config: RobotConfig, plans: Sequence[Plan], space: tuple[float, float] | None
) -> tuple[float, float]:
    """Return the space that the runs may use: the stated one, or what they need if it is None.

    Raises:
        ConfigError: the stated space is too small; it says how much is needed.
    """
    ahead, aside = needed(plans, config)
    if space is None:
        return ahead, aside
    if not (space[0] >= ahead - 1e-9 and space[1] >= aside - 1e-9):
        raise ConfigError(
            f"--space {space[0]:g} {space[1]:g}: too small: this needs {_up(ahead)} m ahead of the "
            f"robot's centre and {_up(aside)} m to each side, itself included: clear more floor, "
            "or drive less (--distance, --radii, --size)"
        )
    return space


def fence(config: RobotConfig, plan: Plan, space: tuple[float, float]) -> Geofence:
    """Return a geofence around the space, in the frame of one run's start.

    Args:
        config: of the robot.
        plan: what is to be driven.
        space: free floor ahead of the robot's centre, and to each of its sides [m]; behind it,
            the shorter of the two is taken. A run that goes backwards begins at its far end.
    """
    reach = footprint_radius(config)
    x, y = space[0] - reach, space[1] - reach
    behind = min(x, y)
    ends = (-x, behind) if plan.back else (-behind, x)
    return Geofence(min_x=ends[0], max_x=ends[1], min_y=-y, max_y=y)


def _outline(plan: Plan) -> list[tuple[float, float]]:
    """Points of the plan's path: the ends of legs, and the extremes of circles [m]."""
    x = y = theta = 0.0
    points = [(x, y)]
    for leg in plan.legs:
        parts = max(1, math.ceil(abs(leg.angle) / 0.1)) if leg.distance and leg.angle else 1
        for _ in range(parts):
            middle = theta + leg.angle / parts / 2.0
            x += leg.distance / parts * math.cos(middle)
            y += leg.distance / parts * math.sin(middle)
            theta += leg.angle / parts
            points.append((x, y))
    return points


def _up(length: float) -> str:
    """Format a length, rounded up to centimetres."""
    return f"{math.ceil(length * 100.0 - 1e-6) / 100.0:.2f}"


def _positive(option: str, value: float, most: float) -> None:
    """Raise ConfigError unless 0 < value <= most."""
    if not 0.0 < value <= most:
        raise ConfigError(f"{option} {value:g}: must be more than 0, at most {most:g}")


def _count(runs: int) -> int:
    """Check how many runs are asked for; ConfigError."""
    if not 1 <= runs <= MOST_RUNS:
        raise ConfigError(f"{runs} runs: must be 1 to {MOST_RUNS}")
    return runs
