"""LaserScan messages: directions, times and mounts of scanners, and messages of revolutions."""

from __future__ import annotations

import math
from array import array
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from acsar_gym.errors import LidarError
from acsar_gym.lidar.contract import check_revolution
from acsar_gym.lidar.laser_scan import LaserScan, Mount, make_scan, read_mount, read_scan
from acsar_gym.lidar.scan import Floats, Revolution

NAN = math.nan
INF = math.inf
FULL_TURN = 2.0 * math.pi
ANGLES = st.floats(-math.pi, math.pi)
SCAN = LaserScan(
    angle_min=-0.5,
    angle_increment=0.25,
    time_increment=0.01,
    scan_time=0.1,
    range_min=0.1,
    range_max=10.0,
    ranges=[1.0, 2.0, 3.0, 4.0, 5.0],
    stamp=7.0,
)


def read(scan: LaserScan, mount: Mount = Mount()) -> Revolution:  # noqa: B008
    return check_revolution(read_scan(scan, mount, "/scan", timeout=1.0), "/scan")


def angles_between(first: Any, second: Floats) -> Any:
    return np.abs(np.mod(second - first + math.pi, FULL_TURN) - math.pi)


def test_read_scan_counts_rays_from_the_first_ray_and_its_stamp() -> None:
    revolution = read(SCAN)
    assert revolution.bearings == pytest.approx([-0.5, -0.25, 0.0, 0.25, 0.5])
    assert revolution.distances.tolist() == [1.0, 2.0, 3.0, 4.0, 5.0]
    assert revolution.times == pytest.approx([7.0, 7.01, 7.02, 7.03, 7.04])
    assert revolution.stamp == pytest.approx(7.04)
    clockwise = read(SCAN._replace(angle_min=0.5, angle_increment=-0.25, time_increment=-0.01))
    assert clockwise.bearings == pytest.approx(-revolution.bearings)
    assert clockwise.times == pytest.approx(14.0 - revolution.times)
    assert clockwise.stamp == 7.0


def test_read_scan_takes_the_time_of_the_scan_if_rays_have_no_times() -> None:
    scan = SCAN._replace(time_increment=0.0, angle_increment=-FULL_TURN / 20.0)
    assert read(scan).times == pytest.approx([7.0, 7.005, 7.01, 7.015, 7.02])
    assert read(scan._replace(scan_time=0.0)).times.tolist() == [7.0] * 5


def test_read_scan_makes_failures_zero_and_moves_the_others_by_the_mount() -> None:
    ranges = array("f", [INF, NAN, 0.05, 10.5, 0.0, -1.0, 9.5, -INF])
    assert read(SCAN._replace(ranges=ranges)).distances.tolist() == [0.0] * 6 + [9.5, 0.1]
    unlimited = SCAN._replace(ranges=[1e7, 20.0], range_max=INF)
    assert read(unlimited).distances.tolist() == [0.0, 20.0]
    moved = read(SCAN._replace(angle_min=0.0, ranges=[2.0, INF]), Mount(1.0, 3.0, math.pi / 2))
    assert moved.bearings == pytest.approx([math.atan2(5.0, 1.0), math.pi / 2 + 0.25])
    assert moved.distances == pytest.approx([math.hypot(1.0, 5.0), 0.0])


def make_transform(roll: float, pitch: float, yaw: float, *, scale: float = 1.0) -> Any:
    """The geometry_msgs/Transform of a URDF's rpy. A quaternion may have any length."""
    quaternion = scale * Rotation.from_euler("xyz", (roll, pitch, yaw)).as_quat()
    return SimpleNamespace(
        translation=SimpleNamespace(x=0.2, y=-0.1, z=0.4),
        rotation=SimpleNamespace(**dict(zip("xyzw", quaternion.tolist(), strict=True))),
    )


@given(yaw=ANGLES, roll=st.floats(-0.05, 0.05), pitch=st.floats(-0.05, 0.05))
def test_read_mount_turns_bearings_by_its_yaw(yaw: float, roll: float, pitch: float) -> None:
    mount = read_mount(make_transform(roll, pitch, yaw, scale=1.5), "/scan")
    assert mount[:2] == (0.2, -0.1)
    bearings = read(SCAN, Mount(yaw=mount.yaw)).bearings
    assert (np.abs(bearings) <= math.pi).all()
    assert angles_between(yaw - 0.5, bearings)[0] < 1e-9


@pytest.mark.parametrize(
    ("transform", "message"),
    [
        (make_transform(0.0, 0.0, 0.0, scale=1e-9), "must be finite numbers and a quaternion"),
        (make_transform(0.0, 0.1, 1.0), "/scan: its frame is tilted by 5.7 degrees"),
        (make_transform(math.pi, 0.0, 0.3), "is tilted by 180.0 degrees: .* upside down"),
    ],
)
def test_read_mount_refuses_a_bad_transform(transform: Any, message: str) -> None:
    with pytest.raises(LidarError, match=message):
        read_mount(transform, "/scan")


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"ranges": []}, "/scan: has no ranges: check that"),
        ({"angle_min": NAN}, "/scan: angle_min = nan: must be a finite number"),
        ({"angle_increment": 0.0}, "angle_increment = 0: must be the angle"),
        ({"time_increment": 0.1}, r"time_increment = 0.1: 5 rays would take 0.4 s, at most 0.2 s"),
        ({"time_increment": 0.4, "scan_time": 0.0}, r"would take 1.6 s, at most 1 s are possible"),
        ({"range_max": NAN}, "range_min = 0.1: must be less than range_max"),
        ({"angle_increment": 4.0}, "angle_increment = 4: 5 rays of 3 turns: must be rad"),
    ],
)
def test_read_scan_refuses_bad_fields(fields: dict[str, float], message: str) -> None:
    with pytest.raises(LidarError, match=message) as caught:
        read(SCAN._replace(**fields))
    assert str(caught.value).isprintable()


@st.composite
def revolutions(draw: st.DrawFn) -> Revolution:
    """A full turn of equal steps in either direction from any bearing, in any order."""
    count = draw(st.integers(3, 60))
    direction = draw(st.sampled_from([-1.0, 1.0]))
    steps = np.array(draw(st.permutations(range(count))))
    bearings = draw(ANGLES) + direction * steps * FULL_TURN / count
    ended = draw(st.floats(-1e3, 1e5))
    return Revolution(
        bearings=np.mod(bearings + math.pi, FULL_TURN) - math.pi,
        distances=np.where(steps % 7 == 3, 0.0, 0.1 + steps / 5.0),
        times=ended - draw(st.floats(0.01, 0.9)) * (count - 1 - steps) / count,
        stamp=ended,
    )


@given(revolutions())
def test_make_scan_is_read_back_as_the_revolution(revolution: Revolution) -> None:
    scan = make_scan(revolution, 0.1, 12.1)
    assert scan.angle_increment > 0.0
    returned = read(scan)
    gaps = angles_between(revolution.bearings[:, None], returned.bearings)
    match = gaps.argmin(axis=1)
    assert sorted(match) == [*range(len(returned.bearings))]
    assert gaps.min(axis=1).max() < 1e-4
    assert returned.distances[match].tolist() == revolution.distances.astype(np.float32).tolist()
    tolerance = 1e-5 * (1.0 + scan.scan_time)
    assert returned.times[match] == pytest.approx(revolution.times, abs=tolerance, rel=1e-12)
    assert returned.stamp == pytest.approx(revolution.stamp, abs=tolerance, rel=1e-12)


@pytest.mark.parametrize(
    ("distances", "ranges"),
    [([1.0, 2.0, 3.0, 4.0], [4.0, 2.0, 1.0, 3.0]), ([0.0, 0.05, 20.0, 9.0], [9.0, -INF, INF, INF])],
)
def test_make_scan_gives_each_ray_the_nearest_measurement(
    distances: list[float], ranges: list[float]
) -> None:
    """Rays are at -pi, -pi / 2, 0 and pi / 2. Each measurement may fill the two rays beside it."""
    bearings = np.array([0.1, -0.3, 1.5, 3.0])
    revolution = Revolution(bearings, np.array(distances), np.zeros(4), 1.0)
    scan = make_scan(revolution, 0.1, 10.0, angle_min=-math.pi, rays=4)
    assert np.asarray(scan.ranges).tolist() == ranges
    assert np.asarray(scan.ranges).dtype == np.float32
    dense = make_scan(revolution, 0.0, 100.0, angle_min=0.0, rays=60)
    assert np.isfinite(dense.ranges).sum() == 2 * np.count_nonzero(distances)


def test_make_scan_of_a_part_of_a_turn_keeps_density_and_rate() -> None:
    bearings = np.radians(np.arange(120.0, -121.0, -1.0))  # clockwise
    times = 5.0 + np.arange(241.0) * 0.1 / 360.0
    scan = make_scan(Revolution(bearings, np.full(241, 2.0), times, times[-1]), 0.1, 5.0)
    assert np.shape(scan.ranges) == (360,)
    assert scan.angle_min == pytest.approx(bearings[-1])
    assert np.isfinite(scan.ranges).sum() == pytest.approx(241, abs=2)
    assert scan.scan_time == pytest.approx(0.1, rel=1e-3)
    assert scan.stamp == pytest.approx(times[-1], abs=1e-6)


def test_make_scan_keeps_its_grid() -> None:
    def turn(start: float) -> Revolution:
        bearings = np.radians(start - np.arange(360.0))
        return Revolution(bearings, np.ones(360), np.arange(360.0) / 3600.0, 0.1)

    scan = make_scan(turn(0.0), 0.1, 5.0)
    following = make_scan(turn(3.2), 0.1, 5.0, angle_min=scan.angle_min, rays=360)
    assert following[:2] == scan[:2]
    assert following.angle_max == scan.angle_max
    assert following.time_increment == pytest.approx(scan.time_increment)
    assert following.stamp == pytest.approx(scan.stamp + 3.2 / 3600.0, abs=1e-6)


def test_make_scan_of_one_moment_has_no_times() -> None:
    still = Revolution(np.array([0.0, 2.0, 4.0]), np.ones(3), np.full(3, 5.0), 5.0)
    scan = make_scan(still, 0.1, 5.0)
    assert (scan.time_increment, scan.scan_time, scan.stamp) == (0.0, 0.0, 5.0)
    with pytest.raises(LidarError, match="no measurements: check the LiDAR"):
        make_scan(Revolution._make([*np.zeros((3, 0)), 5.0]), 0.1, 5.0)
