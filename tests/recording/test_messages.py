"""The messages of a recording, as other people's libraries read them."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mover_tools import HALL
from recording_tools import drive, record_env
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from acsar_gym import RobotConfig
from acsar_gym.recording import read
from acsar_gym.recording.events import TABLES, Began, Event
from acsar_gym.recording.messages import make_header
from acsar_gym.recording.writer import RecordingWriter, Tabulator
from acsar_gym.worlds.world import to_odometry

TICKS = 120
EACH_TICK = ("/odom", "/tf", "/joint_states", "/cmd_vel", "/cmd_vel_sent")
OTHERS = ("/tf_static", "/scan", "/safety_reason", "/feedback_age", "/truth", "/time_reference")
Messages = dict[str, list[Any]]


@pytest.fixture(scope="module")
def tape(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return drive(tmp_path_factory.mktemp("tape") / "tape.mcap", RobotConfig.of(None), TICKS)


@pytest.fixture(scope="module")
def messages(tape: Path) -> Messages:
    """All messages by topic, as rosbags reads them."""
    return read_messages(tape)


def read_messages(path: Path) -> Messages:
    messages: Messages = {}
    with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        for connection, _, data in reader.messages():
            message = reader.deserialize(data, connection.msgtype)
            messages.setdefault(connection.topic, []).append(message)
    return messages


def test_messages_are_read_by_rosbags_and_mcap(tape: Path, messages: Messages) -> None:
    assert set(messages) == {*EACH_TICK, *OTHERS}
    for name in EACH_TICK:
        assert len(messages[name]) == TICKS
    assert len(messages["/scan"]) == 13
    with tape.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert {channel.topic for channel in summary.channels.values()} == set(messages)


def test_frames_form_the_tree_of_a_base_with_a_lidar(messages: Messages) -> None:
    fixed = {t.child_frame_id: t for t in messages["/tf_static"][0].transforms}
    moving = messages["/tf"][-1].transforms[0]
    edges = {(t.header.frame_id, child) for child, t in fixed.items()}
    assert edges == {("base_footprint", "base_link"), ("base_link", "lidar_link")}
    assert (moving.header.frame_id, moving.child_frame_id) == ("odom", "base_footprint")
    assert fixed["base_link"].transform.translation.z == 0.05
    assert fixed["base_link"].transform.rotation.w == 1.0
    place = fixed["lidar_link"].transform.translation
    assert (place.x, place.y, place.z) == (-0.15, 0.0, 0.37)
    odom = messages["/odom"][-1]
    assert (odom.header.frame_id, odom.child_frame_id) == ("odom", "base_footprint")
    assert odom.pose.pose.position.x == moving.transform.translation.x


def test_messages_hold_what_the_robot_did(tape: Path, messages: Messages) -> None:
    (episode,) = read(tape).episodes
    for tick in (0, 60, TICKS - 1):
        odom, joints, wanted, sent = (
            messages[f"/{name}"][tick]
            for name in ("odom", "joint_states", "cmd_vel", "cmd_vel_sent")
        )
        pose = odom.pose.pose
        theta = 2.0 * math.atan2(pose.orientation.z, pose.orientation.w)
        assert [pose.position.x, pose.position.y, theta] == pytest.approx(episode.poses[tick])
        assert odom.twist.twist.linear.x == episode.twists[tick, 0]
        assert odom.twist.twist.angular.z == episode.twists[tick, 1]
        assert joints.name[0] == "front_right_wheel_joint"
        assert joints.velocity.tolist() == episode.speeds[tick].tolist()
        assert [wanted.linear.x, wanted.angular.z] == episode.asked[tick].tolist()
        assert [sent.linear.x, sent.angular.z] == episode.sent[tick].tolist()
    assert episode.asked[0].tolist() == [0.3, 0.0]
    assert episode.sent[0].tolist() == [0.02, 0.0]
    truth = messages["/truth"][-1].pose.pose.position
    assert [truth.x, truth.y] == episode.truth[-1, :2].tolist()

    newest = messages["/odom"][-1]
    pose_variances = newest.pose.covariance.reshape(6, 6)
    twist_variances = newest.twist.covariance.reshape(6, 6)
    assert pose_variances.diagonal().tolist() == [0.01, 0.01, 1e3, 1e3, 1e3, 0.01]
    assert twist_variances.diagonal().tolist() == [0.01, 1e3, 1e3, 1e3, 1e3, 0.01]
    assert np.count_nonzero(pose_variances) == np.count_nonzero(twist_variances) == 6


def test_movers_are_in_the_frame_of_the_odometry(tmp_path: Path) -> None:
    path = record_env(tmp_path / "movers.mcap", "obstacle_goal", 1, worlds=HALL)
    messages = read_messages(path)["/movers"]
    (episode,) = read(path).episodes
    movers = episode.movers
    assert len(messages) == pytest.approx(len(movers.stamps) / 10, abs=1)
    states = movers.states[movers.exchanges % 10 == 0][0]
    cylinders = messages[0].markers
    start = tuple(episode.info["start"])
    rows = zip(cylinders, states.tolist(), strict=True)
    for number, (cylinder, (x, y, _, _, radius)) in enumerate(rows):
        place = cylinder.pose.position
        assert (cylinder.type, cylinder.header.frame_id) == (3, "odom")
        assert (cylinder.id, cylinder.scale.x) == (number, 2.0 * radius)
        assert [place.x, place.y] == pytest.approx(to_odometry(start, (x, y, 0.0))[:2])


def test_scan_is_of_the_moment_of_a_pose(messages: Messages) -> None:
    def nanoseconds(message: Any) -> int:
        return int(message.header.stamp.sec * 10**9 + message.header.stamp.nanosec)

    poses = {nanoseconds(message) for message in messages["/odom"]}
    scans = messages["/scan"]
    assert {nanoseconds(scan) for scan in scans[1:]} <= poses
    assert {scan.time_increment for scan in scans} == {0.0}
    assert {round(scan.scan_time, 6) for scan in scans} == {0.1}


def test_reason_and_lateness_are_the_worst_of_a_tenth_of_a_second(tmp_path: Path) -> None:
    """Faults are lines of the log."""
    config = RobotConfig.of(None)
    path = tmp_path / "tape.mcap"
    table = np.zeros(100, TABLES["ticks"])
    table["stamp"] = 0.01 * np.arange(100)
    table["lateness"] = np.random.default_rng(0).uniform(0.0, 0.01, 100)
    table["reason"][47] = 3
    writer = RecordingWriter(path, config, make_header(config, {}))
    events: list[Event] = [Began(0.0, 10**18, {}), *({"ticks": row} for row in table.tolist())]
    events.append({"faults": [(1.0, b"the cable is out")]})
    Tabulator([writer]).add(events, is_last=True)
    writer.close(0)

    messages = read_messages(path)
    worst = table["lateness"].reshape(10, 10).max(axis=1)
    assert [message.data for message in messages["/lateness"]] == worst.tolist()
    reasons = [message.data for message in messages["/safety_reason"]]
    assert reasons == [0.0] * 4 + [3.0] + [0.0] * 5
    assert len(messages["/feedback_age"]) == 10
    assert [message.msg for message in messages["/rosout"]] == ["the cable is out"]
