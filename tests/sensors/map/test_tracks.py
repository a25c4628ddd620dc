"""What moves around a robot: found in scans, and forgotten by the map."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from acsar_gym import RobotConfig
from acsar_gym.lidar.scan import make_rays
from acsar_gym.sensors.map.seen import CELL_SHIFT, CELLS, COUNT_FREE, OCCUPIED
from acsar_gym.sensors.map.sensor import MAP_NAMES, MapSensor, clear_map, update_alone
from acsar_gym.sensors.map.way import SCRATCH

ACSAR = RobotConfig.preset("acsar")
JACKAL = RobotConfig.preset("jackal")
STEP, WALKER = 0.1, 0.25
"""Time between two scans [s], and a walker's radius [m]."""
Pose = tuple[float, float, float]
Place = tuple[float, float]


class Watcher:
    """A robot's map that is given scans of circles, (n, 3), which each have a velocity, (n, 2)."""

    def __init__(self, config: RobotConfig, seed: int = 0) -> None:
        self.sensor = MapSensor(None, config)
        self.record: Any = self.sensor.records.view(np.recarray)[0]
        self.rays, self.count = make_rays(config), config.lidar.rays
        self.now, self._rng, self._scratch = (
            0.0,
            np.random.default_rng(seed),
            np.zeros(SCRATCH, np.int32),
        )
        clear_map(self.record)

    def see(
        self, pose: Pose, circles: Any, velocities: Any = 0.0, *, said: Pose | None = None
    ) -> Any:
        """Give it a scan that was measured while the LiDAR turned; `said` is the odometry's pose.

        Returns the movers.
        """
        self.now += STEP
        rays, circles = self.rays, np.reshape(circles, (-1, 3))
        bearings = rays.start + np.arange(self.count) * rays.step
        times = self.now - STEP * (1.0 - np.mod(-bearings / math.tau, 1.0))
        x = pose[0] + math.cos(pose[2]) * rays.mount_x - math.sin(pose[2]) * rays.mount_y
        y = pose[1] + math.sin(pose[2]) * rays.mount_x + math.cos(pose[2]) * rays.mount_y
        ranges = np.full(self.count, rays.farthest)
        for (cx, cy, radius), velocity in zip(
            circles, np.broadcast_to(velocities, (len(circles), 2)), strict=True
        ):
            dx = cx - x + (times - self.now) * velocity[0]
            dy = cy - y + (times - self.now) * velocity[1]
            cos, sin = np.cos(bearings + pose[2]), np.sin(bearings + pose[2])
            along, across = dx * cos + dy * sin, dy * cos - dx * sin
            inside = radius**2 - across**2
            hit = (inside > 0.0) & (along > 0.0)
            range_ = along - np.sqrt(np.maximum(inside, 0.0))
            ranges = np.where(hit, np.minimum(ranges, range_), ranges)
        noisy = ranges + self._rng.normal(0.0, 0.01, self.count)
        ranges = np.where(ranges < rays.farthest, noisy, ranges)
        self.give(said or pose, ranges, bearings, times)
        return self.sensor.movers

    def give(self, pose: Pose, ranges: Any, bearings: Any, times: Any) -> None:
        """Update the map."""
        measured, out = (bearings, times, float(times.max())), np.zeros(len(MAP_NAMES))
        given = self.now, pose, (9.0, 0.0), ranges, self.rays, measured, self._scratch, out
        update_alone(self.sensor.records, *given)

    def occupied(self) -> Any:
        """(n, 2): centres of occupied cells [m], of a robot that is near the origin."""
        cells = np.argwhere(self.record.counts >= OCCUPIED)
        cells = np.where(cells >= CELLS // 2, cells - CELLS, cells)
        return (cells + 0.5 - CELL_SHIFT) * self.record.side


@pytest.mark.parametrize("config", [ACSAR, JACKAL], ids=["acsar", "jackal"])
@pytest.mark.parametrize(("speed", "scans"), [(0.4, 20), (0.6, 12), (1.3, 6), (1.8, 5)])
@pytest.mark.parametrize(
    ("begin", "along"),
    [((2.0, -1.0), (0.0, 1.0)), ((3.5, 0.3), (-1.0, 0.0)), ((1.2, 0.4), (0.8, 0.6))],
    ids=["across", "nearer", "farther"],
)
def test_a_walker_is_tracked_once_he_has_been_seen_for_a_while(
    config: RobotConfig, speed: float, scans: int, begin: Place, along: Place
) -> None:
    errors, wanted = [], 0
    for seed in range(4):
        watcher, velocity = Watcher(config, seed), speed * np.array(along)
        for scan in range(scans + 6):
            place = begin + (scan + 0.1 * seed) * STEP * velocity
            movers = watcher.see((0.0, 0.0, 0.0), (*place, WALKER), velocity)
            if scan >= scans:
                wanted += 1
                for mover in movers:
                    apart = math.dist(mover[:2], place), math.dist(mover[2:4], velocity)
                    errors.append((*apart, abs(mover[4] - WALKER)))
    assert 0.8 * wanted <= len(errors) <= wanted
    assert (np.median(errors, axis=0) < [0.12, 0.15, 0.1]).all()


@pytest.mark.parametrize("config", [ACSAR, JACKAL], ids=["acsar", "jackal"])
@pytest.mark.parametrize("drift", [0.0, 0.05])
def test_what_stands_hardly_moves_where_a_robot_drives_past(
    config: RobotConfig, drift: float
) -> None:
    """Nor where its odometry turns away by `drift` [rad/s]: in less than 5 % of the scans."""
    seen = 0
    for seed in range(6):
        rng, watcher = np.random.default_rng(seed), Watcher(config, seed)
        circles = rng.uniform([-2.0, -3.0, 0.08], [6.0, 3.0, 0.4], (24, 3))
        circles = circles[np.abs(circles[:, 1]) > 0.7]
        x = y = said_x = said_y = 0.0
        for scan in range(60):
            heading = 0.2 * math.cos(x)
            said = heading + drift * scan * STEP
            seen += len(watcher.see((x, y, heading), circles, said=(said_x, said_y, said)))
            x, y = x + 0.07 * math.cos(heading), y + 0.07 * math.sin(heading)
            said_x, said_y = said_x + 0.07 * math.cos(said), said_y + 0.07 * math.sin(said)
    assert seen < 0.05 * 6 * 60


def test_what_is_seen_through_gaps_doesnt_move() -> None:
    """A row of posts that no ray passes, behind posts that are an arm's length apart."""
    watcher, row = Watcher(ACSAR), np.arange(-3.0, 9.0, 0.1)
    behind = np.column_stack([row, np.full(len(row), 2.4), np.full(len(row), 0.06)])
    ahead = np.column_stack([row[::6], np.full(len(row[::6]), 1.2), np.full(len(row[::6]), 0.15)])
    circles = np.concatenate([behind, ahead])
    for scan in range(80):
        assert not len(watcher.see((0.05 * scan, 0.0, 0.0), circles))


@pytest.mark.parametrize("config", [ACSAR, JACKAL], ids=["acsar", "jackal"])
@pytest.mark.parametrize("speed", [0.6, 1.3])
def test_the_map_forgets_what_moves(config: RobotConfig, speed: float) -> None:
    """Two scans after a walker has left a cell, at most a few are left of him."""
    watcher, velocity = Watcher(config), np.array([0.0, speed])
    left = []
    for scan in range(int(3.0 / speed / STEP)):
        place = (1.8, -1.5 + scan * STEP * speed)
        watcher.see((0.0, 0.0, 0.0), (*place, WALKER), velocity)
        occupied = watcher.occupied()
        gone = place[1] - 2.0 * STEP * speed - WALKER - config.lidar.noise
        left.append(int((occupied[:, 1] < gone).sum()))
    assert left[-1] == 0
    assert max(left) <= 3


def test_who_stops_is_an_obstacle_and_who_goes_on_is_none() -> None:
    watcher, y, occupied = Watcher(ACSAR), -1.2, []
    for scan in range(70):
        speed = 1.0 if scan < 12 or scan >= 40 else 0.0
        y += speed * STEP
        movers = watcher.see((0.0, 0.0, 0.0), (1.8, y, WALKER), (0.0, speed))
        occupied.append(len(watcher.occupied()))
        if scan == 38:
            assert not len(movers)
            assert occupied[-1] >= 3
            stood = watcher.occupied()
    ahead = watcher.occupied()
    assert len(stood) > 0
    assert not len(ahead)


def test_a_scan_that_is_read_twice_counts_once() -> None:
    """Slow LiDARs hand over the same revolution at several steps: tracks go on meanwhile."""
    watcher, velocity = Watcher(ACSAR), np.array([0.0, 1.0])
    for scan in range(8):
        movers = watcher.see((0.0, 0.0, 0.0), (1.8, -1.0 + scan * STEP, WALKER), velocity)
    before = watcher.record.tracks.copy()
    bearings = watcher.rays.start + np.arange(watcher.count) * watcher.rays.step
    ended = watcher.now
    watcher.now += STEP
    far = np.full(watcher.count, watcher.rays.farthest)
    watcher.give((0.0, 0.0, 0.0), far, bearings, np.full(watcher.count, ended - 1e-3))
    after = watcher.sensor.movers
    assert watcher.sensor.time == pytest.approx(ended + STEP)
    assert after[0, :2] == pytest.approx(movers[0, :2] + STEP * movers[0, 2:4])
    assert after[0, 2:] == pytest.approx(movers[0, 2:])
    assert (watcher.record.tracks[:, 8] == before[:, 8]).all()


def test_where_nothing_moves_the_map_is_as_without_tracks() -> None:
    """Whatever the times of the measurements are: tracks that stand leave no trace in it."""
    circles = [(1.5, 0.8, 0.2), (2.2, -0.9, 0.3), (-1.4, 0.3, 0.1)]
    timed, untimed = Watcher(ACSAR), Watcher(ACSAR)
    for scan in range(20):
        pose = (0.03 * scan, 0.0, 0.05 * scan)
        timed.see(pose, circles)
        untimed.record.tracks[:] = 0.0
        untimed.see(pose, circles)
    np.testing.assert_array_equal(timed.record.counts, untimed.record.counts)
    np.testing.assert_array_equal(timed.record.costs, untimed.record.costs)
    assert (timed.record.counts > COUNT_FREE).any()
