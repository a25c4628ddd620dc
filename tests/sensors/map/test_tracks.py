"""What moves around a robot: found in scans, and forgotten by the map."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from map_tools import STEP, Mapped, Pose

from acsar_gym import RobotConfig
from acsar_gym.sensors.map.seen import CELL_SHIFT, CELLS, HALF, OCCUPIED
from acsar_gym.sensors.map.tracks import AGE, MISSES

ACSAR = RobotConfig.preset("acsar")
ROBOTS = pytest.mark.parametrize(
    "config", [ACSAR, RobotConfig.preset("jackal")], ids=["acsar", "jackal"]
)
WALKER = 0.25
"""Radius of a walker [m]."""
ORIGIN = (0.0, 0.0, 0.0)


class Watcher(Mapped):
    """A map that is given noisy scans of circles."""

    def __init__(self, config: RobotConfig, seed: int = 0) -> None:
        super().__init__(config)
        self.rng = np.random.default_rng(seed)

    def watch(
        self, pose: Pose, circles: Any, velocity: complex = 0.0, odometry: Pose | None = None
    ) -> Any:
        """Scan circles, rows of place and radius, while the LiDAR turns, and return the movers."""
        x, y, radius = np.reshape(circles, (-1, 3)).T
        ages = -STEP * (1.0 - np.mod(-self.bearings / math.tau, 1.0))
        mount = complex(self.rays.mount_x, self.rays.mount_y)
        eye = complex(*pose[:2]) + mount * np.exp(1j * pose[2])
        toward = x + 1j * y - eye + ages[:, None] * velocity
        toward *= np.exp(-1j * (self.bearings + pose[2]))[:, None]
        depth = radius**2 - toward.imag**2
        hit = (depth > 0.0) & (toward.real > 0.0)
        distances = toward.real - np.sqrt(np.maximum(depth, 0.0))
        ranges = np.where(hit, distances, np.inf).min(axis=1)
        noisy = ranges + self.rng.normal(0.0, 0.01, len(ranges))
        self.see(odometry or pose, np.minimum(noisy, self.nothing), ages)
        return self.sensor.movers

    def occupied(self) -> Any:
        """(n, 2): Centres of occupied cells [m], of a robot near the origin."""
        cells = (np.argwhere(self.record.counts >= OCCUPIED) + HALF) % CELLS - HALF
        return (cells + 0.5 - CELL_SHIFT) * self.record.side


@ROBOTS
@pytest.mark.parametrize(("speed", "scans"), [(0.4, 20), (0.6, 12), (1.3, 6), (1.8, 5)])
@pytest.mark.parametrize(
    ("start", "direction"),
    [(2.0 - 1.0j, 1.0j), (3.5 + 0.3j, -1.0), (1.2 + 0.4j, 0.8 + 0.6j)],
    ids=["across", "nearer", "farther"],
)
def test_a_walker_is_tracked_once_he_has_been_seen_for_a_while(
    config: RobotConfig, speed: float, scans: int, start: complex, direction: complex
) -> None:
    errors = []
    for seed in range(4):
        watcher = Watcher(config, seed)
        velocity = speed * direction
        for scan in range(scans + 6):
            place = start + (scan + 0.1 * seed) * STEP * velocity
            movers = watcher.watch(ORIGIN, (place.real, place.imag, WALKER), velocity)

            if scan >= scans:
                errors += [
                    (abs(complex(x, y) - place), abs(complex(vx, vy) - velocity), abs(r - WALKER))
                    for x, y, vx, vy, r in movers
                ]
    assert 0.8 * 24 <= len(errors) <= 24
    assert (np.median(errors, axis=0) < [0.12, 0.15, 0.1]).all()


@ROBOTS
@pytest.mark.parametrize("drift", [0.0, 0.05])
def test_standing_objects_hardly_move_when_a_robot_drives_past(
    config: RobotConfig, drift: float
) -> None:
    """Nor if its odometry turns away by `drift` [rad/s]: in less than 5 % of the scans."""
    false_movers = 0
    for seed in range(6):
        watcher = Watcher(config, seed)
        circles = np.random.default_rng(seed).uniform([-2, -3, 0.08], [6, 3, 0.4], (24, 3))
        circles = circles[np.abs(circles[:, 1]) > 0.7]
        place = drifted = 0j
        for scan in range(60):
            heading = 0.2 * math.cos(place.real)
            turned = heading + drift * scan * STEP
            odometry = drifted.real, drifted.imag, turned
            pose = place.real, place.imag, heading
            false_movers += len(watcher.watch(pose, circles, odometry=odometry))
            place += 0.07 * np.exp(1j * heading)
            drifted += 0.07 * np.exp(1j * turned)
    assert false_movers < 0.05 * 6 * 60


def test_what_is_seen_through_gaps_doesnt_move() -> None:
    """A row of posts that no ray passes, behind posts that are an arm's length apart."""
    watcher = Watcher(ACSAR)
    behind = [(x, 2.4, 0.06) for x in np.arange(-3.0, 9.0, 0.1)]
    ahead = [(x, 1.2, 0.15) for x in np.arange(-3.0, 9.0, 0.6)]
    for scan in range(80):
        assert not len(watcher.watch((0.05 * scan, 0.0, 0.0), behind + ahead))


@ROBOTS
@pytest.mark.parametrize("speed", [0.6, 1.3])
def test_the_map_forgets_what_moves(config: RobotConfig, speed: float) -> None:
    """Two scans after a walker has left a cell, at most a few are left of him."""
    watcher = Watcher(config)
    remembered = []
    for scan in range(int(3.0 / speed / STEP)):
        y = -1.5 + scan * STEP * speed
        watcher.watch(ORIGIN, (1.8, y, WALKER), speed * 1j)
        passed = y - 2.0 * STEP * speed - WALKER - config.lidar.noise
        remembered.append(int((watcher.occupied()[:, 1] < passed).sum()))
    assert remembered[-1] == 0
    assert max(remembered) <= 3


def test_who_stops_is_an_obstacle_and_who_goes_on_is_none() -> None:
    watcher = Watcher(ACSAR)
    y = -1.2
    for scan in range(70):
        speed = 1.0 if scan < 12 or scan >= 40 else 0.0
        y += speed * STEP
        movers = watcher.watch(ORIGIN, (1.8, y, WALKER), speed * 1j)
        if scan == 38:
            assert not len(movers)
            assert len(watcher.occupied()) >= 3
    assert not len(watcher.occupied())


def test_a_scan_that_is_read_twice_counts_once() -> None:
    """Slow LiDARs hand over the same revolution at several steps: tracks go on meanwhile."""
    watcher = Watcher(ACSAR)
    for scan in range(8):
        movers = watcher.watch(ORIGIN, (1.8, -1.0 + scan * STEP, WALKER), 1j)
    tracks = watcher.record.tracks.copy()
    watcher.see(ORIGIN, watcher.nothing, -STEP - 0.01)
    assert watcher.sensor.time == pytest.approx(9 * STEP)
    moved = watcher.sensor.movers
    assert moved[0, :2] == pytest.approx(movers[0, :2] + STEP * movers[0, 2:4])
    assert moved[0, 2:] == pytest.approx(movers[0, 2:])
    assert (watcher.record.tracks[:, [AGE, MISSES]] == tracks[:, [AGE, MISSES]]).all()
