"""The messages of a recording, as other people's libraries read them."""

from __future__ import annotations

import math
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from recording_tools import drive, record_env
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore
from scenes import HALL

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
    assert [len(messages[name]) for name in (*EACH_TICK, "/scan")] == [TICKS] * 5 + [13]
    with tape.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert {channel.topic for channel in summary.channels.values()} == set(messages)


def test_frames_form_the_tree_of_a_base_with_a_lidar(messages: Messages) -> None:
    moving = messages["/tf"][-1].transforms[0]
    base, lidar = messages["/tf_static"][0].transforms
    edges = [(t.header.frame_id, t.child_frame_id) for t in (moving, base, lidar)]
    frames = ["odom", "base_footprint", "base_link", "lidar_link"]
    assert edges == [*pairwise(frames)]
    assert (base.transform.translation.z, base.transform.rotation.w) == (0.05, 1.0)
    place = lidar.transform.translation
    assert (place.x, place.y, place.z) == (-0.15, 0.0, 0.37)
    odom = messages["/odom"][-1]
    assert (odom.header.frame_id, odom.child_frame_id) == edges[0]
    assert odom.pose.pose.position.x == moving.transform.translation.x


def list_twist(twist: Any) -> list[float]:
    return [twist.linear.x, twist.angular.z]


def test_messages_hold_what_the_robot_did(tape: Path, messages: Messages) -> None:
    (episode,) = read(tape).episodes
    for tick in (0, 60, TICKS - 1):
        odom, _, joints, wanted, sent = (messages[name][tick] for name in EACH_TICK)
        pose = odom.pose.pose
        theta = 2.0 * math.atan2(pose.orientation.z, pose.orientation.w)
        assert [pose.position.x, pose.position.y, theta] == pytest.approx(episode.poses[tick])
        assert list_twist(odom.twist.twist) == episode.twists[tick].tolist()
        assert joints.name[0] == "front_right_wheel_joint"
        assert joints.velocity.tolist() == episode.speeds[tick].tolist()
        assert list_twist(wanted) == episode.asked[tick].tolist()
        assert list_twist(sent) == episode.sent[tick].tolist()
    assert episode.asked[0].tolist() == [0.3, 0.0]
    assert episode.sent[0].tolist() == [0.02, 0.0]
    truth = messages["/truth"][-1].pose.pose.position
    assert not messages["/truth"][-1].pose.covariance.any()
    assert [truth.x, truth.y] == episode.truth[-1, :2].tolist()

    newest = messages["/odom"][-1]
    pose_variances = np.diag([0.01, 0.01, 1e3, 1e3, 1e3, 0.01])
    twist_variances = np.diag([0.01, 1e3, 1e3, 1e3, 1e3, 0.01])
    assert newest.pose.covariance.tolist() == pose_variances.ravel().tolist()
    assert newest.twist.covariance.tolist() == twist_variances.ravel().tolist()


def test_movers_are_in_the_frame_of_the_odometry(tmp_path: Path) -> None:
    path = record_env(tmp_path / "movers.mcap", "obstacle_goal", 1, worlds=HALL)
    messages = read_messages(path)["/movers"]
    (episode,) = read(path).episodes
    movers = episode.movers
    shown = movers.states[movers.exchanges % 10 == 0]
    assert len(messages) == len(shown)
    start = tuple(episode.info["start"])
    rows = zip(messages[0].markers, shown[0].tolist(), strict=True)
    for number, (cylinder, (x, y, _, _, radius)) in enumerate(rows):
        place = cylinder.pose.position
        assert (cylinder.type, cylinder.header.frame_id) == (3, "odom")
        assert (cylinder.id, cylinder.scale.x) == (number, 2.0 * radius)
        assert [place.x, place.y] == pytest.approx(to_odometry(start, (x, y, 0.0))[:2])


def test_scan_is_of_the_moment_of_a_pose(messages: Messages) -> None:
    poses, scans = (
        {message.header.stamp.sec * 10**9 + message.header.stamp.nanosec for message in stamped}
        for stamped in (messages["/odom"], messages["/scan"][1:])
    )
    assert scans <= poses
    scan = messages["/scan"][-1]
    assert (scan.time_increment, scan.scan_time) == (0.0, pytest.approx(0.1))


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
