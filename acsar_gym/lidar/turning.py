"""How far a robot really turns, in parts of what its odometry says, by its LiDAR.

Odometry knows the wheels, and how far they turn a skid-steer robot depends on the floor. Scans see
it: an older revolution, moved by odometry to where the robot is now, must look like the newest one,
and does so best with the right factor of turning. Correlative scan matching (Olson, "Real-time
correlative scan matching", ICRA 2009) searches in this way for the pose between two scans; here
many pairs of scans together search for one number, so no single one must match well.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable

import numpy as np

from acsar_gym.config import RobotConfig
from acsar_gym.jit import loop, subroutine
from acsar_gym.lidar.scan import (
    FULL_TURN,
    Floats,
    Rays,
    Revolution,
    Trail,
    count_trail_rows,
    fill_scan,
    make_rays,
)
from acsar_gym.odometry import Odometry
from acsar_gym.protocol import Speeds
from acsar_gym.trigonometry import cos_sin

FACTOR_STEP = 0.05
"""Between the logarithms of two candidates."""
UNCHANGED = 14
"""Place of the candidate 1."""
FACTORS = np.exp(FACTOR_STEP * (np.arange(2 * UNCHANGED + 1) - UNCHANGED))
"""The candidates: from half to twice as far as odometry says."""
PAUSE = 0.5
"""Two revolutions are compared that ended so far apart, or a little more [s]."""
LEAST_TURN = 0.2
"""They are compared where odometry has turned by so much in between [rad]."""
LEAST_RAYS = 8
"""They can tell where so many rays have met something in both."""
FARTHEST_APART = 0.2
"""Largest difference that counts of the logarithms of two ranges: rays that differ by more have met
two things, one of which may walk."""
LEAST_PAIRS, MOST_PAIRS = 5, 50
"""So many pairs are compared before the first correction, and count at most: floors change."""
LEAST_EVIDENCE = 0.1
"""With the first correction ranges must agree better by so much of their length, added up over the
pairs: an error of 30 %, as on MuJoCo's floor without calibration, shows after 5 pairs, which agree
better by 0.02 to 0.11 each, and one of 5 % in a room after 19 to 29."""
HISTORY = 60.0
"""It moves odometry to where it would be had it known the factor for so long [s]."""


@subroutine
def turn_trail(trail: Floats, newest: int, factor: float, turned: Floats) -> None:
    """Write the newest rows of a trail as they are where all turns are `factor` times as far."""
    slots, gained = len(trail), 0.0
    row = (newest + 1 - len(turned) + slots) % slots
    turned[0] = trail[row]
    for k in range(1, len(turned)):
        before, row = row, (row + 1) % slots
        cos, sin = cos_sin(gained)
        dx, dy = trail[row, 1] - trail[before, 1], trail[row, 2] - trail[before, 2]
        turn = trail[row, 3] - trail[before, 3]
        gained += (factor - 1.0) * (turn - FULL_TURN * np.floor(turn / FULL_TURN + 0.5))
        turned[k, 0] = trail[row, 0]
        turned[k, 1] = turned[k - 1, 1] + cos * dx - sin * dy
        turned[k, 2] = turned[k - 1, 2] + sin * dx + cos * dy
        turned[k, 3] = trail[row, 3] + gained


@loop
def compare_revolutions(
    older: Revolution,
    newer: Revolution,
    trail: Floats,
    newest: int,
    rays: Rays,
    turned: Floats,
    scans: Floats,
    costs: Floats,
) -> bool:
    """Measure how different two revolutions look from where the robot is now, for each candidate.

    Args:
        older: a revolution.
        newer: another one.
        trail: of odometry, as in `Trail`.
        newest: place of its newest row.
        rays: of the LiDAR.
        turned: (rows, 4): written to; so many rows of the trail reach back to the older one.
        scans: (2, rays): written to.
        costs: (len(FACTORS),): gets the mean difference of the logarithms of two ranges.

    Returns:
        Whether enough rays have met something in both.
    """
    before, now = scans[0], scans[1]
    farthest, last = rays.farthest - 1e-3, len(turned) - 1
    for k in range(len(FACTORS)):
        turn_trail(trail, newest, FACTORS[k], turned)
        fill_scan(older.bearings, older.distances, older.times, turned, last, rays, before)
        fill_scan(newer.bearings, newer.distances, newer.times, turned, last, rays, now)
        total, count = 0.0, 0
        for ray in range(scans.shape[1]):
            if 0.0 < before[ray] < farthest and 0.0 < now[ray] < farthest:
                total += min(abs(math.log(before[ray] / now[ray])), FARTHEST_APART)
                count += 1
        if count < LEAST_RAYS:
            return False
        costs[k] = total / count
    return True


@loop
def find_end(trail: Floats, newest: int, factor: float) -> tuple[float, float, float]:
    """Where a trail ends where all turns are `factor` times as far."""
    turned = np.empty_like(trail)
    turn_trail(trail, newest, factor, turned)
    return turned[-1, 1], turned[-1, 2], turned[-1, 3]


def find_factor(costs: Floats) -> float:
    """Find the factor of least cost: the lowest point of a parabola through three candidates."""
    k = min(max(int(np.argmin(costs)), 1), len(costs) - 2)
    before, least, after = costs[k - 1 : k + 2].tolist()
    bend = before - 2.0 * least + after
    shift = 0.5 * (before - after) / bend if bend > 0.0 else 0.0
    return float(FACTORS[k] * math.exp(FACTOR_STEP * min(max(shift, -1.0), 1.0)))


class TurnCorrection:
    """Lets a robot's odometry turn as far as its scans say.

    Args:
        config: of the robot.
        odometry: of the robot. Where scans are sure that it turns too far, or not far enough, it
            gets another `turn_factor`, and the first time in an episode another pose.
    """

    def __init__(self, config: RobotConfig, odometry: Odometry) -> None:
        self._odometry = odometry
        self._wheels = Odometry.of(config)
        """As if nothing were corrected."""
        self._rays = make_rays(config)
        self._trail = Trail(HISTORY, config.period)
        self._reach = min(PAUSE + config.lidar.timeout + 2.0 / config.lidar.rate, HISTORY)
        self._turned = np.empty((count_trail_rows(self._reach, config.period), 4))
        self._scans = np.empty((2, config.lidar.rays))
        self.reset(0.0)
        nothing = Revolution(np.zeros(0), np.zeros(0), np.zeros(0), 0.0)
        self._compare(nothing, nothing)  # compiles, before a robot waits for it
        find_end(self._trail.rows, self._trail.newest, 1.0)

    def reset(self, now: float) -> None:
        """Begin an episode: forget everything.

        Args:
            now: time [s].
        """
        self._wheels.reset()
        self._trail.clear()
        self._trail.mark(now, self._wheels.pose)
        self._angle = 0.0
        self._seen: deque[tuple[Revolution, float]] = deque()
        """Revolutions, and the angle turned by when they were new [rad]."""
        self._costs, self._pairs = np.zeros(len(FACTORS)), 0

    def follow(self, shares: Iterable[tuple[Speeds, float]], now: float) -> None:
        """Follow the wheels for a tick.

        Args:
            shares: wheel speeds [rad/s], and for how long each held [s].
            now: time at the end of the tick [s].
        """
        for speeds, share in shares:
            self._wheels.update(speeds, share)
            self._angle += self._wheels.twist[1] * share
        self._trail.mark(now, self._wheels.pose)

    def look(self, revolution: Revolution) -> None:
        """Compare the newest revolution with an older one, and correct odometry.

        Args:
            revolution: the newest; one that is known already is ignored.
        """
        seen, latest = self._seen, revolution.stamp - PAUSE
        if seen and revolution.stamp <= seen[-1][0].stamp:
            return
        seen.append((revolution, self._angle))
        while len(seen) > 1 and seen[1][0].stamp <= latest:
            seen.popleft()
        older, angle = seen[0]
        age = self._trail.rows[self._trail.newest, 0] - older.times.min(initial=latest)
        turn = abs(self._angle - angle)
        if older.stamp > latest or age > self._reach or turn < LEAST_TURN:
            return
        costs = self._compare(older, revolution)
        if costs is None:
            return
        self._pairs = min(self._pairs + 1, MOST_PAIRS)
        self._costs += (costs - self._costs) / self._pairs
        self._correct()

    def _compare(self, older: Revolution, newer: Revolution) -> Floats | None:
        """Compare two revolutions: the cost of each candidate, None where they can't tell."""
        trail, costs = self._trail, np.empty(len(FACTORS))
        work = self._turned, self._scans, costs
        can_tell = compare_revolutions(older, newer, trail.rows, trail.newest, self._rays, *work)
        return costs if can_tell else None

    def _correct(self) -> None:
        """Let odometry turn by the factor of least cost, once that is sure to be better than 1."""
        odometry, factor = self._odometry, find_factor(self._costs)
        if odometry.turn_factor == 1.0:
            gain = self._costs[UNCHANGED] - self._costs.min()
            if self._pairs < LEAST_PAIRS or self._pairs * gain < LEAST_EVIDENCE:
                return
            x, y, theta = find_end(self._trail.rows, self._trail.newest, factor)
            odometry.pose = x, y, math.remainder(theta, FULL_TURN)
        odometry.turn_factor = factor
