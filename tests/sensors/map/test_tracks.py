"""What moves around a robot: found in scans, and forgotten by the map."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from acsar_gym import RobotConfig
from acsar_gym.sensors.map.tracks import AGE, MISSES

ACSAR = RobotConfig.preset("acsar")
ROBOTS = pytest.mark.parametrize(
    "config", [ACSAR, RobotConfig.preset("jackal")], ids=["acsar", "jackal"]
)
WALKER = 0.25
"""Radius of a walker [m]."""
ORIGIN = (0.0, 0.0, 0.0)
STEP = 0.1
"""Time between two scans [s]."""


@ROBOTS
@pytest.mark.parametrize(
    ("speed", "scans", "start", "direction"),
    [
        (0.4, 20, 2.0 - 1.0j, 1.0j),  # across
        (1.3, 6, 3.5 + 0.3j, -1.0),  # nearer
        (1.8, 5, 1.2 + 0.4j, 0.8 + 0.6j),  # farther
    ],
)
def test_tracks_of_a_walker_who_has_been_seen_for_a_while(
    config: RobotConfig, speed: float, scans: int, start: complex, direction: complex, make_map: Any
) -> None:
    errors = []
    for seed in range(4):
        watcher = make_map(config, seed=seed)
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
def test_tracks_of_standing_objects_hardly_move(config: RobotConfig, make_map: Any) -> None:
    """Though odometry turns away: in less than 5 % of the scans."""
    drift = 0.05  # rad/s
    false_movers = 0
    for seed in range(6):
        watcher = make_map(config, seed=seed)
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


def test_tracks_of_what_is_seen_through_gaps_dont_move(make_map: Any) -> None:
    """A row of posts that no ray passes, behind posts that are an arm's length apart."""
    watcher = make_map(ACSAR)
    behind = [(x, 2.4, 0.06) for x in np.arange(-3.0, 9.0, 0.1)]
    ahead = [(x, 1.2, 0.15) for x in np.arange(-3.0, 9.0, 0.6)]
    for scan in range(80):
        assert not len(watcher.watch((0.05 * scan, 0.0, 0.0), behind + ahead))


def test_map_forgets_what_moves(make_map: Any) -> None:
    """Two scans after a walker has left a cell, at most a few cells remain."""
    speed = 1.3
    watcher = make_map(ACSAR)
    remembered = []
    for scan in range(int(3.0 / speed / STEP)):
        y = -1.5 + scan * STEP * speed
        watcher.watch(ORIGIN, (1.8, y, WALKER), speed * 1j)
        passed = y - 2.0 * STEP * speed - WALKER - ACSAR.lidar.noise
        remembered.append(int((watcher.occupied()[:, 1] < passed).sum()))
    assert remembered[-1] == 0
    assert max(remembered) <= 3


def test_tracks_of_a_person_who_stops_become_an_obstacle(make_map: Any) -> None:
    watcher = make_map(ACSAR)
    y = -1.2
    for scan in range(70):
        speed = 1.0 if scan < 12 or scan >= 40 else 0.0
        y += speed * STEP
        movers = watcher.watch(ORIGIN, (1.8, y, WALKER), speed * 1j)
        if scan == 38:
            assert not len(movers)
            assert len(watcher.occupied()) >= 3
    assert not len(watcher.occupied())


def test_tracks_count_a_scan_that_is_read_twice_once(make_map: Any) -> None:
    """Slow LiDARs hand over the same revolution at several steps: tracks go on meanwhile."""
    watcher = make_map(ACSAR)
    for scan in range(8):
        movers = watcher.watch(ORIGIN, (1.8, -1.0 + scan * STEP, WALKER), 1j)
    tracks = watcher.record.tracks.copy()
    watcher.see(ORIGIN, watcher.nothing, -STEP - 0.01)
    assert watcher.sensor.time == pytest.approx(9 * STEP)
    moved = watcher.sensor.movers
    assert moved[0, :2] == pytest.approx(movers[0, :2] + STEP * movers[0, 2:4])
    assert moved[0, 2:] == pytest.approx(movers[0, 2:])
    assert (watcher.record.tracks[:, [AGE, MISSES]] == tracks[:, [AGE, MISSES]]).all()
