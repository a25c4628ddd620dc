"""LaserScan messages: directions, times and mounts of any scanner, and back to messages."""

from __future__ import annotations

import math
from array import array
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from acsar_gym.errors import LidarError
from acsar_gym.lidar.contract import check_revolution
from acsar_gym.lidar.laser_scan import (
    LaserScan,
    Mount,
    Transform,
    find_mount,
    find_transform,
    make_scan,
    read_scan,
)
from acsar_gym.lidar.scan import Floats, Revolution

NAN, INF = math.nan, math.inf
TURN = 2.0 * math.pi
DEGREE = math.radians(1.0)
SCAN = LaserScan(-0.5, 0.25, 0.01, 0.1, 0.1, 10.0, [1.0, 2.0, 3.0, 4.0, 5.0], 7.0)
ANGLES = st.floats(-math.pi, math.pi)


def quaternion(roll: float, pitch: float, yaw: float) -> tuple[float, float, float, float]:
    """Of fixed-axis roll, pitch and yaw, as in a URDF's rpy."""
    (cr, sr), (cp, sp), (cy, sy) = (
        (math.cos(angle / 2.0), math.sin(angle / 2.0)) for angle in (roll, pitch, yaw)
    )
    return (
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    )


def apart(first: float, second: Floats) -> Floats:
    """Angles between a direction and others [rad]."""
    gaps: Floats = np.abs(np.mod(second - first + math.pi, TURN) - math.pi)
    return gaps


def test_rays_are_counted_from_the_first_one_and_its_stamp() -> None:
    got = check_revolution(read_scan(SCAN), "scan")
    assert got.bearings == pytest.approx([-0.5, -0.25, 0.0, 0.25, 0.5])
    assert got.distances.tolist() == [1.0, 2.0, 3.0, 4.0, 5.0]
    assert got.times == pytest.approx([7.0, 7.01, 7.02, 7.03, 7.04])
    assert got.stamp == pytest.approx(7.04)
    clockwise = read_scan(SCAN._replace(angle_min=0.5, angle_increment=-0.25))
    assert clockwise.bearings == pytest.approx([0.5, 0.25, 0.0, -0.25, -0.5])
    assert clockwise.times == pytest.approx(got.times)


def test_a_turn_takes_the_scans_time_where_rays_have_none() -> None:
    quarter = SCAN._replace(time_increment=0.0, angle_increment=-TURN / 20.0)
    assert read_scan(quarter).times == pytest.approx([7.0, 7.005, 7.01, 7.015, 7.02])
    assert read_scan(quarter._replace(scan_time=0.0)).times.tolist() == [7.0] * 5


def test_a_head_that_turns_against_the_order_of_rays_ends_with_the_first_one() -> None:
    got = read_scan(SCAN._replace(time_increment=-0.01))
    assert got.times == pytest.approx([7.0, 6.99, 6.98, 6.97, 6.96])
    assert got.stamp == 7.0


def test_what_isnt_a_measurement_is_zero_and_what_is_too_near_is_near() -> None:
    ranges = array("f", [INF, NAN, 0.05, 10.5, 0.0, -1.0, 9.5, -INF])
    got = read_scan(SCAN._replace(ranges=ranges))
    assert got.distances.tolist() == [0.0] * 6 + [9.5, 0.1]
    far = read_scan(SCAN._replace(ranges=[1e7, 20.0], range_max=INF))
    assert check_revolution(far, "scan").distances.tolist() == [0.0, 20.0]


@given(ANGLES, st.booleans(), st.booleans(), ANGLES, st.floats(-0.05, 0.05), st.floats(0.5, 2.0))
def test_a_mount_turns_and_mirrors_as_its_transform_does(
    yaw: float, inverted: bool, by_pitch: bool, angle: float, tilt: float, length: float
) -> None:
    flip = math.pi if inverted else 0.0
    roll, pitch = (tilt, flip) if by_pitch else (flip, tilt)
    turn = quaternion(roll, pitch, yaw)
    x, y, z, w = turn
    mount = find_mount((0.2, -0.1, 0.4), [length * number for number in turn])
    assert (mount.x, mount.y, mount.is_inverted) == (0.2, -0.1, inverted)
    ray = np.array([math.cos(angle), math.sin(angle), 0.0])
    across = np.cross([x, y, z], ray)
    turned = ray + 2.0 * (w * across + np.cross([x, y, z], across))
    got = read_scan(SCAN._replace(angle_min=angle, ranges=[1.0]), mount)
    assert -math.pi <= got.bearings[0] <= math.pi
    assert apart(math.atan2(turned[1], turned[0]), got.bearings).max() < tilt**2 + 1e-6


def rigid(transform: Transform) -> Floats:
    """The 4 x 4 matrix of a transform."""
    x, y, z, w = transform.rotation
    matrix = np.eye(4)
    for column in range(3):
        unit = np.eye(3)[column]
        across = np.cross([x, y, z], unit)
        matrix[:3, column] = unit + 2.0 * (w * across + np.cross([x, y, z], across))
    matrix[:3, 3] = transform.translation
    return matrix


NUMBER = st.floats(-2.0, 2.0)
TRANSFORMS = st.builds(
    lambda at, rpy: Transform("", at, quaternion(*rpy)),
    st.tuples(NUMBER, NUMBER, NUMBER),
    st.tuples(ANGLES, ANGLES, ANGLES),
)


@given(st.lists(TRANSFORMS, min_size=3, max_size=3))
def test_a_chain_of_transforms_is_their_product(chain: list[Transform]) -> None:
    tree = {
        "base_link": chain[0]._replace(parent="base_footprint"),
        "mast": chain[1]._replace(parent="/base_link"),
        "/laser": chain[2]._replace(parent="mast"),
        "wheel": chain[0]._replace(parent="mast"),
    }
    upward = find_transform(tree, "laser", "base_footprint")
    product = rigid(chain[0]) @ rigid(chain[1]) @ rigid(chain[2])
    assert rigid(Transform("", *upward)) == pytest.approx(product, abs=1e-9)
    aside = rigid(Transform("", *find_transform(tree, "laser", "wheel")))
    expected = np.linalg.inv(rigid(chain[0])) @ rigid(chain[2])
    assert aside == pytest.approx(expected, abs=1e-9)
    assert find_transform({}, "laser", "/laser") == ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))


def test_frames_that_nothing_connects_are_one_line() -> None:
    still = Transform("mast", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    circle = {"laser": still, "mast": still._replace(parent="laser")}
    for tree in ({}, circle):
        with pytest.raises(LidarError, match="says where its frame 'laser' is in 'base_link': pub"):
            find_transform(tree, "laser", "base_link", "/scan")


BAD_SCANS: dict[str, tuple[LaserScan, str]] = {
    "no rays": (SCAN._replace(ranges=[]), "/scan: has no ranges: see that"),
    "nan angle": (SCAN._replace(angle_min=NAN), "/scan: angle_min = nan: must be a finite number"),
    "inf step": (SCAN._replace(angle_increment=INF), "angle_increment = inf: must be a finite"),
    "no step": (SCAN._replace(angle_increment=0.0), "angle_increment = 0: must be the angle"),
    "nan time": (SCAN._replace(time_increment=NAN), "time_increment = nan: must be a finite"),
    "nan stamp": (SCAN._replace(stamp=NAN), "stamp = nan: must be a finite"),
    "negative time": (SCAN._replace(scan_time=-0.1), "scan_time = -0.1: must not be negative"),
    "nan range": (SCAN._replace(range_min=NAN), "range_min = nan: must be a finite number"),
    "nan most": (SCAN._replace(range_max=NAN), "range_min = 0.1: must be less than range_max"),
    "unset": (SCAN._replace(range_min=0.0, range_max=0.0), "range_min = 0: must be less than"),
    "degrees": (
        SCAN._replace(angle_increment=1.0, ranges=[1.0] * 360),
        "angle_increment = 1: 360 rays of 57 turns: must be rad",
    ),
}


@pytest.mark.parametrize("name", BAD_SCANS)
def test_a_bad_scan_is_one_line(name: str) -> None:
    scan, expected = BAD_SCANS[name]
    with pytest.raises(LidarError) as caught:
        read_scan(scan, source="/scan")
    assert expected in str(caught.value)
    assert str(caught.value).isprintable()


@pytest.mark.parametrize(
    ("translation", "rotation", "expected"),
    [
        ((0.0, 0.0, 0.3), (0.0, 0.0, 0.0, 0.0), "must be finite numbers and a quaternion"),
        ((NAN, 0.0, 0.3), (0.0, 0.0, 0.0, 1.0), "must be finite numbers and a quaternion"),
        ((0.0, 0.0, 0.3), (NAN, 0.0, 0.0, 1.0), "must be finite numbers and a quaternion"),
        ((0.0, 0.0, 0.3), quaternion(0.0, 0.2, 1.0), "/scan: its frame is tilted by 11.5 degrees"),
        ((0.0, 0.0, 0.3), quaternion(math.pi / 2.0, 0.0, 0.0), "is tilted by 90.0 degrees"),
    ],
)
def test_a_bad_mount_is_one_line(
    translation: Sequence[float], rotation: Sequence[float], expected: str
) -> None:
    with pytest.raises(LidarError) as caught:
        find_mount(translation, rotation, "/scan")
    assert expected in str(caught.value)
    assert str(caught.value).isprintable()


@st.composite
def revolutions(draw: st.DrawFn) -> Revolution:
    """A full turn of equal steps, clockwise or not, that begins anywhere; in any order."""
    count, first = draw(st.integers(3, 60)), draw(ANGLES)
    direction = draw(st.sampled_from([-1.0, 1.0]))
    distance = st.just(0.0) | st.floats(0.1, 12.1)
    distances = np.array(draw(st.lists(distance, min_size=count, max_size=count)))
    duration, ended = draw(st.floats(0.01, 2.0)), draw(st.floats(-1e3, 1e5))
    steps = np.arange(count)
    bearings = np.mod(first + direction * steps * TURN / count + math.pi, TURN) - math.pi
    times = ended - duration * (count - 1 - steps) / count
    order = np.array(draw(st.permutations(range(count))))
    return Revolution(bearings[order], distances[order], times[order], ended)


@given(revolutions())
def test_a_revolution_comes_back_from_its_message(revolution: Revolution) -> None:
    scan = make_scan(revolution, 0.1, 12.1)
    assert scan.angle_increment > 0.0
    got = check_revolution(read_scan(scan), "scan")
    assert len(got.bearings) == len(revolution.bearings)
    gaps = np.array([apart(bearing, got.bearings) for bearing in revolution.bearings])
    match = gaps.argmin(axis=1)
    assert sorted(match) == [*range(len(match))]
    assert gaps.min(axis=1).max() < 1e-4
    assert got.distances[match].tolist() == revolution.distances.astype(np.float32).tolist()
    tolerance = 1e-5 * (1.0 + scan.scan_time)
    assert got.times[match] == pytest.approx(revolution.times, abs=tolerance, rel=1e-12)
    assert got.stamp == pytest.approx(revolution.stamp, abs=tolerance, rel=1e-12)


@given(
    st.lists(st.tuples(ANGLES, st.floats(0.0, 20.0), st.floats(0.0, 1.0)), min_size=1, max_size=40),
    st.integers(1, 60),
)
def test_each_ray_has_a_measurement_next_to_it_or_none(
    measurements: list[tuple[float, float, float]], rays: int
) -> None:
    bearings, distances, times = np.array(measurements).T
    revolution = Revolution(bearings, distances, times, 1.0)
    scan = make_scan(revolution, 0.1, 10.0, angle_min=-math.pi, rays=rays)
    ranges = np.asarray(scan.ranges)
    assert len(ranges) == rays
    assert ranges.dtype == np.float32
    assert scan.angle_max <= math.pi + 1e-5
    step = TURN / rays
    for ray, distance in enumerate(ranges.tolist()):
        gaps = apart(-math.pi + ray * step, bearings)
        near = distances[gaps <= gaps.min() + 1e-5]
        if gaps.min() > step + 1e-5:
            assert distance == INF
        elif gaps.min() < step - 1e-5:
            if distance == INF:
                assert ((near == 0.0) | (near > 9.999)).any()
            elif distance == -INF:
                assert ((near > 0.0) & (near < 0.1001)).any()
            else:
                assert np.abs(near - distance).min() < 1e-6
    check_revolution(read_scan(scan), "scan")


def test_a_scanner_of_part_of_a_turn_keeps_its_density_and_its_rate() -> None:
    bearings = np.radians(np.arange(120.0, -121.0, -1.0))  # clockwise
    times = 5.0 + np.arange(241.0) * 0.1 / 360.0
    scan = make_scan(Revolution(bearings, np.full(241, 2.0), times, times[-1]), 0.1, 5.0)
    assert np.shape(scan.ranges) == (360,)
    assert scan.angle_min == pytest.approx(-120.0 * DEGREE)
    assert np.isfinite(scan.ranges).sum() == pytest.approx(241, abs=2)
    assert scan.scan_time == pytest.approx(0.1, rel=1e-3)
    assert scan.stamp == pytest.approx(times[-1], abs=1e-6)


def test_the_grid_stays_where_the_head_begins_a_bit_earlier() -> None:
    def turn(first: float) -> Revolution:
        bearings = first - np.arange(360.0) * DEGREE
        return Revolution(bearings, np.full(360, 2.0), np.arange(360.0) / 3600.0, 0.1)

    first = make_scan(turn(0.0), 0.1, 5.0)
    second = make_scan(
        turn(3.2 * DEGREE), 0.1, 5.0, angle_min=first.angle_min, rays=np.size(first.ranges)
    )
    assert (second.angle_min, second.angle_max) == (first.angle_min, first.angle_max)
    assert second.time_increment == pytest.approx(first.time_increment)
    assert second.stamp == pytest.approx(first.stamp + 3.2 / 3600.0, abs=1e-6)


def test_measurements_of_one_time_are_a_message_without_times() -> None:
    still = Revolution(np.array([0.0, 2.0, 4.0]), np.ones(3), np.full(3, 5.0), 5.0)
    scan = make_scan(still, 0.1, 5.0)
    assert (scan.time_increment, scan.scan_time, scan.stamp) == (0.0, 0.0, 5.0)
    with pytest.raises(LidarError, match="no measurements: look after the LiDAR"):
        make_scan(Revolution(np.zeros(0), np.zeros(0), np.zeros(0), 5.0), 0.1, 5.0)


def test_without_a_mount_a_scanner_is_as_the_base() -> None:
    ranges = [1.0, INF, 2.0]
    scan = SCAN._replace(ranges=ranges)
    for first, second in zip(read_scan(scan), read_scan(scan, Mount()), strict=True):
        np.testing.assert_array_equal(first, second)
