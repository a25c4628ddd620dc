"""The messages of a recording, as other people's libraries read them."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mover_tools import HALL
from recording_tools import drive, record_env
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from acsar_gym import RobotConfig
from acsar_gym.config import Measured
from acsar_gym.recording import read
from acsar_gym.recording.encoder import LEAST_DEVIATION, SLIP_SHARE
from acsar_gym.recording.messages import TICK_COLUMNS, TOPICS
from acsar_gym.worlds.world import to_odometry

TICKS = 120
UNUSED = {"/observation", "/action", "/acsar/steps", "/movers", "/acsar/movers"}
"""Topics of environments and of movers, which a Robot alone doesn't have."""


@pytest.fixture(scope="module")
def tape(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return drive(tmp_path_factory.mktemp("tape") / "tape.mcap", RobotConfig.of(None), TICKS)


@pytest.fixture(scope="module")
def messages(tape: Path) -> dict[str, list[Any]]:
    """All messages by topic, as rosbags reads them."""
    return by_rosbags(tape)


def by_rosbags(path: Path) -> dict[str, list[Any]]:
    found: dict[str, list[Any]] = {}
    with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        for connection, _, data in reader.messages():
            message = reader.deserialize(data, connection.msgtype)
            found.setdefault(connection.topic, []).append(message)
    return found


def test_rosbags_reads_all_of_it(messages: dict[str, list[Any]]) -> None:
    assert set(messages) == {topic.name for topic in TOPICS} - UNUSED
    for name in ("/odom", "/tf", "/joint_states", "/cmd_vel", "/cmd_vel_sent", "/acsar/ticks"):
        assert len(messages[name]) == TICKS
    assert len(messages["/scan"]) == 13
    assert len(messages["/diagnostics"]) == 1


def test_frames_form_the_tree_of_a_base_with_a_lidar(messages: dict[str, list[Any]]) -> None:
    fixed = {t.child_frame_id: t for t in messages["/tf_static"][0].transforms}
    moving = messages["/tf"][-1].transforms[0]
    edges = {(t.header.frame_id, child) for child, t in fixed.items()}
    assert edges == {("base_footprint", "base_link"), ("base_link", "lidar_link")}
    assert (moving.header.frame_id, moving.child_frame_id) == ("odom", "base_footprint")
    assert fixed["base_link"].transform.translation.z == 0.05
    at = fixed["lidar_link"].transform.translation
    assert (at.x, at.y, at.z) == (-0.15, 0.0, 0.37)
    odom = messages["/odom"][-1]
    assert (odom.header.frame_id, odom.child_frame_id) == ("odom", "base_footprint")
    assert odom.pose.pose.position.x == moving.transform.translation.x


def test_messages_tell_what_the_robot_did(tape: Path, messages: dict[str, list[Any]]) -> None:
    (episode,) = read(tape).episodes
    for tick in (0, 60, TICKS - 1):
        odom, joints = messages["/odom"][tick], messages["/joint_states"][tick]
        pose, turned = odom.pose.pose, odom.pose.pose.orientation
        theta = 2.0 * math.atan2(turned.z, turned.w)
        assert [pose.position.x, pose.position.y, theta] == pytest.approx(episode.poses[tick])
        assert odom.twist.twist.angular.z == episode.twists[tick, 1]
        assert joints.name[0] == "front_right_wheel_joint"
        assert joints.velocity.tolist() == episode.speeds[tick].tolist()
        asked, sent = messages["/cmd_vel"][tick], messages["/cmd_vel_sent"][tick]
        assert [asked.linear.x, asked.angular.z] == episode.asked[tick].tolist()
        assert [sent.linear.x, sent.angular.z] == episode.sent[tick].tolist()
    assert episode.asked[0].tolist() == [0.3, 0.0]
    assert episode.sent[0].tolist() == [0.02, 0.0]
    truth = messages["/truth"][-1].pose.pose.position
    assert [truth.x, truth.y] == episode.truth[-1, :2].tolist()
    row = dict(zip(TICK_COLUMNS, messages["/acsar/ticks"][-1].data.tolist(), strict=True))
    assert (row["x"], row["asked_linear"]) == (episode.poses[-1, 0], 0.3)
    assert bytes(messages["/wire/sent"][-1].data).startswith(b"ap00.00,bp00.00")


def test_only_where_something_moves_there_are_movers(tape: Path, tmp_path: Path) -> None:
    """In the frame of the odometry, as cylinders, with lines of their velocities."""
    path = record_env(tmp_path / "movers.mcap", "obstacle_goal", 1, worlds=HALL)
    shown = by_rosbags(path)["/movers"]
    (episode,) = read(path).episodes
    movers = episode.movers
    assert len(shown) == pytest.approx(len(movers.stamps) / 10, abs=1)
    (*cylinders, lines), states = shown[0].markers, movers.states[0]
    assert [marker.type for marker in shown[0].markers] == [3, 3, 3, 5]
    assert {marker.header.frame_id for marker in shown[0].markers} == {"odom"}
    start = tuple(episode.info["start"])
    for number, (cylinder, (x, y, vx, vy, radius)) in enumerate(
        zip(cylinders, states.tolist(), strict=True)
    ):
        at, ahead = to_odometry(start, (x, y, 0.0)), to_odometry(start, (x + vx, y + vy, 0.0))
        place, end = cylinder.pose.position, lines.points[2 * number + 1]
        assert (cylinder.id, cylinder.scale.x) == (number, 2.0 * radius)
        assert [place.x, place.y, end.x, end.y] == pytest.approx([*at[:2], *ahead[:2]])
    topics = b"/acsar/movers", b"visualization_msgs"
    assert [topic in path.read_bytes() for topic in topics] == [True, True]
    assert [topic in tape.read_bytes() for topic in topics] == [False, False]


def test_a_scan_is_of_one_moment_whose_pose_is_told(messages: dict[str, list[Any]]) -> None:
    def nanoseconds(message: Any) -> int:
        return int(message.header.stamp.sec * 10**9 + message.header.stamp.nanosec)

    poses = {nanoseconds(message) for message in messages["/odom"]}
    scans = messages["/scan"]
    assert {nanoseconds(scan) for scan in scans[1:]} <= poses
    assert {scan.time_increment for scan in scans} == {0.0}
    assert [scan.scan_time for scan in scans] == pytest.approx([0.0] + [0.1] * 12)


def test_diagnostics_tell_of_loop_safety_wire_and_recorder(messages: dict[str, list[Any]]) -> None:
    (told,) = messages["/diagnostics"]
    states = {state.name: state for state in told.status}
    assert list(states) == [
        "acsar: control loop",
        "acsar: safety",
        "acsar: wire",
        "acsar: recorder",
    ]
    values = {pair.key: pair.value for pair in states["acsar: control loop"].values}
    assert values["ticks"] == "97"  # the first second, less the reset's three periods
    assert states["acsar: recorder"].message == "0 dropped"


def test_an_unknown_robot_has_the_driver_s_constant_covariance(
    messages: dict[str, list[Any]],
) -> None:
    newest = messages["/odom"][-1]
    pose = newest.pose.covariance.reshape(6, 6)
    twist = newest.twist.covariance.reshape(6, 6)
    assert pose.diagonal().tolist() == [0.01, 0.01, 1e3, 1e3, 1e3, 0.01]
    assert twist.diagonal().tolist() == [0.01, 1e3, 1e3, 1e3, 1e3, 0.01]
    assert np.count_nonzero(pose) == np.count_nonzero(twist) == 6


def test_the_covariance_grows_with_what_was_measured(tmp_path: Path) -> None:
    value = RobotConfig.of(None).wheel_separation_multiplier
    known = Measured(low=value * 0.98, high=value * 1.02, method="calibrate turn")
    config = RobotConfig.of(None).with_(measured={"wheel_separation_multiplier": known})
    odometry = by_rosbags(drive(tmp_path / "tape.mcap", config))["/odom"]
    first, last = (odometry[place].pose.covariance for place in (0, -1))
    assert first[35] == pytest.approx(LEAST_DEVIATION**2, rel=0.01)
    (episode,) = read(tmp_path / "tape.mcap").episodes
    dt = np.diff(episode.stamps, prepend=episode.stamps[0])
    turned = float(np.sum(np.abs(episode.twists[:, 1]) * dt))
    grown = math.hypot(0.02 / 1.96, SLIP_SHARE) * turned
    assert math.sqrt(last[35]) == pytest.approx(math.hypot(LEAST_DEVIATION, grown), rel=1e-3)
    assert last[0] == last[7] > first[0] >= 0.01  # the radius is unknown
