"""The simulated LiDAR: its revolutions and their errors."""

from __future__ import annotations

import contextlib
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from acsar_gym import Robot, RobotConfig
from acsar_gym.errors import LidarError
from acsar_gym.lidar.scan import Revolution, Scan, make_rays
from acsar_gym.lidar.simulated import LidarTraits, SimulatedLidar, add_errors
from acsar_gym.links import open_link
from acsar_gym.physics import Physics, compute_physics
from acsar_gym.recording import Recorder
from acsar_gym.recording.replay import ReplayLink
from acsar_gym.sensors.lidar import LidarSensor
from acsar_gym.worlds import Scene, World

ACSAR = RobotConfig.preset("acsar")
PILLAR = World(np.array([[0.85, 2.0, 0.5]]))


def scanner(physics: Physics | None = None, seed: int = 0, **lidar: Any) -> LidarSensor:
    """A LiDAR at rest before a pillar, after its reset."""
    config = ACSAR.with_(lidar={"noise": 0.0, **lidar})
    link = open_link("planar", config)
    link.open()
    scene = Scene(start=(1.0, 0.0, 0.0), world=PILLAR, physics=physics)
    link.reset(scene)
    made = LidarSensor(SimulatedLidar(link, config), config)
    made.reset(scene, np.random.default_rng(seed))
    made.poll(link.truth, link.now())
    return made


def test_a_pillar_to_the_left_is_seen_from_the_lidars_own_place() -> None:
    """The LiDAR sits 15 cm behind the robot's centre, so the pillar is exactly at its side."""
    assert scanner(rays=4).scan.ranges == pytest.approx([5.0, 5.0, 5.0, 1.5], abs=1e-6)


def drive_scans(**lidar: Any) -> list[tuple[float, Revolution, Scan]]:
    """Time, revolution and scan after each of some steps of driving."""
    config = ACSAR.with_(lidar={"noise": 0.0, **lidar})
    found = []
    with Robot(open_link("planar", config), config, ["lidar"]) as robot:
        robot.reset(Scene(start=(1.0, 0.0, 0.0), world=PILLAR), np.random.default_rng(2))
        for _ in range(25):
            for _ in range(7):
                robot.drive(0.3, 0.8)
            sensor = robot.sensors[0]
            found.append((robot.link.now(), sensor.revolution, sensor.scan))
    return found


@pytest.mark.parametrize("rate", [5.5, 10.0])
def test_measurements_are_of_the_newest_complete_revolution(rate: float) -> None:
    scans = drive_scans(rate=rate)
    ages = [now - scan.stamp for now, _, scan in scans]
    assert 0.0 <= min(ages) < max(ages) <= 1.0 / rate
    assert max(ages) > 0.6 / rate
    for step, (_, revolution, scan) in enumerate(scans):
        since = revolution.times - (scan.stamp - 1.0 / rate)
        assert -1e-9 < since.min() < since.max() < 1.0 / rate + 1e-9
        # The head turns clockwise, evenly, from straight ahead. A robot's ramps bend that, and one
        # that turns against the head leaves a gap between the ends, in which the end counts.
        expected = -2.0 * math.pi * rate * since
        off = np.remainder(revolution.bearings - expected + math.pi, 2.0 * math.pi) - math.pi
        assert np.sort(np.abs(off))[-3] < (0.1 if step < 10 else 0.01)
        assert np.ptp(since) > 0.9 / rate
    turns = {round((scan.stamp - scans[0][2].stamp) * rate, 6) for *_, scan in scans}
    assert all(turn == round(turn) for turn in turns)


def noisy(true: float, revolutions: int = 300, beside: float = 0.0, **traits: float) -> Any:
    """Distances of many revolutions, (revolutions, 64); every second one is `beside` further."""
    given = {"scan_rate": 10.0, "noise": 0.0, "bias": 0.0, "dropouts": 0.0, "outliers": 0.0}
    given |= {"start": 0.0, "phase": 0.0, "key": 0.3}
    found = np.full((revolutions, 64), true)
    found[:, ::2] += beside
    for number, distances in enumerate(found):
        add_errors(distances, float(number - 1), LidarTraits(**given | traits), make_rays(ACSAR))
    return found


def test_noise_is_normal_and_every_measurement_has_its_own() -> None:
    errors = (noisy(2.0, noise=0.02) - 2.0) / 0.02
    assert errors.mean() == pytest.approx(0.0, abs=0.03)
    assert errors.std() == pytest.approx(1.0, abs=0.03)
    assert np.mean(np.abs(errors) < 1.0) == pytest.approx(0.683, abs=0.015)
    correlation = np.corrcoef(noisy(2.0, 4000, noise=0.05).T)
    assert np.abs(correlation - np.eye(64)).max() < 0.08
    assert (noisy(5.0, noise=0.5) == 0.0).all()  # out of reach
    assert (noisy(0.1, noise=1.0) > 0.0).all()  # near, not nothing


def test_dropouts_bias_and_outliers() -> None:
    found = noisy(2.0, noise=0.01, dropouts=0.2)
    assert np.mean(found == 0.0) == pytest.approx(0.2, abs=0.015)
    assert (np.abs(found[found > 0.0] - 2.0) < 0.1).all()
    assert noisy(2.0, bias=-0.03) == pytest.approx(1.97)
    assert (noisy(2.0, outliers=0.5) == 2.0).all()  # not an edge
    mixed = noisy(2.0, beside=1.0, outliers=0.3)
    between = (mixed > 2.0) & (mixed < 3.0)
    assert between.mean() == pytest.approx(0.3, abs=0.02)
    assert mixed[between].mean() == pytest.approx(2.5, abs=0.02)


def test_a_slow_lidar_of_an_episode_sees_the_wall_where_it_is(tmp_path: Path) -> None:
    """Its oldest measurements are two turns old; a replay sees the same, to the bit."""
    config = ACSAR.with_(lidar={"noise": 0.0})
    physics = compute_physics(config)._replace(scan_rate=0.5)
    wall = World(np.zeros((0, 3)), np.array([[4.0, -30.0, 4.0, 30.0]]))
    tape, seen, ahead = tmp_path / "tape.mcap", [], 32
    with Robot(open_link("planar", config), config, ["lidar"], Recorder(tape)) as robot:
        robot.reset(Scene(world=wall, physics=physics), np.random.default_rng(1))
        for _ in range(400):
            robot.drive(0.3, 0.0)
            x = robot.link.truth.pose[0] + config.lidar_x_offset  # type: ignore[union-attr]
            seen.append(robot.read())
            assert seen[-1][ahead] * 5.0 == pytest.approx(min(4.0 - x, 5.0), abs=0.02)
    replay = Robot(ReplayLink(tape, compare=False), config, ["lidar"])
    with replay as robot:
        robot.reset(Scene(), np.random.default_rng(1))
        for one in seen:
            robot.drive(0.3, 0.0)
            assert robot.read().tobytes() == one.tobytes()


GOOD: dict[str, Any] = {
    "bearings": [0.1, -0.1, 6.2],
    "distances": [1.0, 0.0, 1e6],
    "times": [0.0, -4e9, 0.1],
    "stamp": 0.1,
}


class Handmade:
    """A user's own LiDAR, which hands over whatever it is made with."""

    def __init__(self, made: Any) -> None:
        self.made = made

    def reset(self, scene: Scene, rng: np.random.Generator) -> None:
        """Nothing is opened."""

    def scan(self) -> Any:
        return self.made

    def close(self) -> None:
        """Nothing is open."""


def read_handmade(made: Any) -> Any:
    sensor = LidarSensor(Handmade(made), ACSAR)
    sensor.reset(Scene(), np.random.default_rng(0))
    sensor.poll(None, 0.2)
    return sensor.scan.ranges


class HandmadePolled(Handmade):
    """Sees every tick."""

    def poll(self, truth: Any, now: float) -> None:
        """There is nothing to do."""


@pytest.mark.parametrize("kind", [Handmade, HandmadePolled])
@pytest.mark.parametrize(
    ("changed", "now", "message"),
    [
        ({}, 1.0, None),
        ({}, 1.2, r"no complete turn for 1\.10 s \(lidar\.timeout = 1 s\)"),
        ({"stamp": 30.0}, 0.2, None),  # a recorded link's clock stands still at a reset
        ({"stamp": 1.7e9}, 0.2, r"measured 1\.7e\+09 s after now .*Link.clock"),
        ({"times": [0.0, 1.7e9, 0.0]}, 0.2, r"measured 1\.7e\+09 s after now"),
    ],
)
def test_a_users_own_lidar_that_hangs_or_has_another_clock_is_an_error(
    kind: type[Handmade], changed: dict[str, Any], now: float, message: str | None
) -> None:
    sensor = LidarSensor(kind(Revolution(**{**GOOD, **changed})), ACSAR)
    sensor.reset(Scene(), np.random.default_rng(0))
    expected = pytest.raises(LidarError, match=f"{kind.__name__}: {message}")
    with contextlib.nullcontext() if message is None else expected:
        sensor.poll(None, now)
        sensor.read(None, now)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"bearings": [0.0, 90.0, 180.0]}, "bearings = .*: must be 3 from -6.283 to 6.283 rad"),
        ({"distances": [1.0, math.inf, 1.0]}, r"distances = .* from 0 to 1e\+06 m: .* 0 where no"),
        ({"times": [0.0, -5e9, 0.0]}, r"times = .* -4e\+09 to 4e\+09 s"),
        ({"stamp": math.nan}, "stamp = nan: must be 1 from"),
        (None, "gave None"),
    ],
)
def test_what_a_users_own_lidar_hands_over_is_checked(
    changed: dict[str, Any] | None, message: str
) -> None:
    with pytest.raises(LidarError, match=message) as caught:
        read_handmade(None if changed is None else Revolution(**{**GOOD, **changed}))
    assert "Handmade" in str(caught.value)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 400
