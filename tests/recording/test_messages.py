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
from acsar_gym.recording import read
from acsar_gym.recording.events import TABLES, Began, Event
from acsar_gym.recording.messages import TOPICS, make_header
from acsar_gym.recording.tabulator import Tabulator
from acsar_gym.recording.writer import RecordingWriter
from acsar_gym.worlds.world import to_odometry

TICKS = 120
UNUSED = {"/observation", "/action", "/movers", "/lateness", "/rosout"}
"""Topics of environments, movers, real time and faults, which this drive doesn't have."""


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
    assert set(messages) == set(TOPICS) - UNUSED
    for name in ("/odom", "/tf", "/joint_states", "/cmd_vel", "/cmd_vel_sent"):
        assert len(messages[name]) == TICKS
    assert len(messages["/scan"]) == 13


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


def test_movers_are_shown_in_the_frame_of_the_odometry(tmp_path: Path) -> None:
    path = record_env(tmp_path / "movers.mcap", "obstacle_goal", 1, worlds=HALL)
    shown = by_rosbags(path)["/movers"]
    (episode,) = read(path).episodes
    movers = episode.movers
    assert len(shown) == pytest.approx(len(movers.stamps) / 10, abs=1)
    states = movers.states[movers.exchanges % 10 == 0][0]
    cylinders = shown[0].markers
    assert [marker.type for marker in cylinders] == [3, 3, 3]
    assert {marker.header.frame_id for marker in cylinders} == {"odom"}
    start = tuple(episode.info["start"])
    for number, (cylinder, (x, y, _, _, radius)) in enumerate(
        zip(cylinders, states.tolist(), strict=True)
    ):
        place = cylinder.pose.position
        assert (cylinder.id, cylinder.scale.x) == (number, 2.0 * radius)
        assert [place.x, place.y] == pytest.approx(to_odometry(start, (x, y, 0.0))[:2])


def test_a_scan_is_of_one_moment_whose_pose_is_told(messages: dict[str, list[Any]]) -> None:
    def nanoseconds(message: Any) -> int:
        return int(message.header.stamp.sec * 10**9 + message.header.stamp.nanosec)

    poses = {nanoseconds(message) for message in messages["/odom"]}
    scans = messages["/scan"]
    assert {nanoseconds(scan) for scan in scans[1:]} <= poses
    assert {scan.time_increment for scan in scans} == {0.0}
    assert {round(scan.scan_time, 6) for scan in scans} == {0.1}


def test_reasons_lateness_and_age_are_plotted_ten_times_a_second(tmp_path: Path) -> None:
    """Each shows the worst of its tenth of a second. Faults are lines of the log."""
    config, path = RobotConfig.of(None), tmp_path / "tape.mcap"
    table = np.zeros(100, TABLES["ticks"])
    table["stamp"] = 0.01 * np.arange(100)
    table["lateness"] = np.random.default_rng(0).uniform(0.0, 0.01, 100)
    table["reason"][47] = 3
    writer = RecordingWriter(path, config, make_header(config, {}))
    faults = [(1.0, b"the cable is out")]
    events: list[Event] = [Began(0.0, 10**18, {}), *({"ticks": row} for row in table.tolist())]
    events.append({"faults": faults})
    for head, tables in Tabulator().add(events, is_last=True):
        writer.write(head, tables)
    writer.close(0)

    shown = by_rosbags(path)
    worst = table["lateness"].reshape(10, 10).max(axis=1)
    assert [message.data for message in shown["/lateness"]] == worst.tolist()
    reasons = [message.data for message in shown["/safety_reason"]]
    assert reasons == [0.0] * 4 + [3.0] + [0.0] * 5
    assert len(shown["/feedback_age"]) == 10
    assert [message.msg for message in shown["/rosout"]] == ["the cable is out"]


def test_an_unknown_robot_has_the_driver_s_constant_covariance(
    messages: dict[str, list[Any]],
) -> None:
    newest = messages["/odom"][-1]
    pose = newest.pose.covariance.reshape(6, 6)
    twist = newest.twist.covariance.reshape(6, 6)
    assert pose.diagonal().tolist() == [0.01, 0.01, 1e3, 1e3, 1e3, 0.01]
    assert twist.diagonal().tolist() == [0.01, 1e3, 1e3, 1e3, 1e3, 0.01]
    assert np.count_nonzero(pose) == np.count_nonzero(twist) == 6
