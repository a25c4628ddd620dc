"""Boards that send commands back: driven, recorded, replayed, and refused if that is all."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from board_like import LikeABoard
from board_tools import board
from recording_tools import drive as record_drive
from serial_tools import RobotFile, StartEmulator, cli

from acsar_gym import Robot, RobotConfig, open_link
from acsar_gym.errors import LinkError, SafetyWarning
from acsar_gym.links.replay import ReplayLink
from acsar_gym.protocol import FEWEST_ECHOES, Decoder, EchoDecoder, encode
from acsar_gym.recording import Recorder, read
from acsar_gym.safety.set_points import SetPointWatch

ACSAR = RobotConfig.preset("acsar")
KNOWN = ACSAR.with_(echo=True)
ECHOES = (
    ("echo",),
    ("echo=0.08",),
    ("echo", "at-comma"),
    ("echo", "feedback-rate=20"),
    ("echo-newest",),
    ("echo-newest", "feedback-rate=50"),
)
COMMANDS = (1.0, 2.0, -3.0, 4.0), (1.0, 2.0, -3.0, 4.5), (0.0, 0.0, 0.0, 0.0)


def like_a_board(*quirks: str, echoes: bool, robot: RobotConfig = ACSAR) -> Any:
    """A board in simulated time; `echoes` is what its link has found out."""
    link: Any = LikeABoard(board(*quirks, robot=robot))
    link.echoes = echoes
    return link


def drive(robot: Robot, ticks: int = 100) -> None:
    """Ahead at a steady speed, then to the left."""
    for angular in (0.0, 1.0):
        for _ in range(ticks):
            robot.drive(0.4, angular)


def decoder_after(*commands: tuple[float, ...]) -> tuple[EchoDecoder, list[bytes]]:
    decoder = EchoDecoder()
    return decoder, [decoder.mark(encode(command)) for command in commands]


@pytest.mark.parametrize("end", [b"\r\n", b"\n", b"\r", b"\r\r\n"])
@pytest.mark.parametrize("before", [b"", b"> ", b"echo: "])
def test_an_echo_is_told_from_feedback_by_what_was_sent(before: bytes, end: bytes) -> None:
    decoder, sent = decoder_after(*COMMANDS)
    echoes = [before + line.rstrip(b",\r\n") + end for line in sent]
    feedback = encode((0.5, 1.5, -2.5, 3.5))
    assert decoder.feed(echoes[0] + feedback + echoes[1]) == [((0.5, 1.5, -2.5, 3.5),)]
    assert decoder.feed(echoes[2] + encode((0.0,) * 4)) == [((0.0,) * 4,)]
    assert (decoder.echoes, decoder.lines, decoder.refused) == (3, 2, {})
    assert not decoder.only_echoes
    assert decoder.feed(echoes[2] * FEWEST_ECHOES) == []
    assert decoder.only_echoes


def test_echoes_come_late_not_at_all_again_and_in_one_line_with_feedback() -> None:
    decoder, sent = decoder_after(*[COMMANDS[0]] * 5, COMMANDS[1])
    assert len(set(sent)) == 4  # the same command again is sent with 0.01 rad/s more and less
    assert [decoder.feed(line) for line in (sent[1], sent[3], sent[3], sent[5])] == [[]] * 4
    assert decoder.feed(encode(COMMANDS[0])) == [(COMMANDS[0],)]  # wheels that turn exactly so
    _, sent = decoder_after(COMMANDS[0])
    decoder.expect(sent[0])
    assert decoder.feed(sent[0].rstrip() + encode(COMMANDS[1])) == [(COMMANDS[1],)]


@pytest.mark.parametrize("quirks", ECHOES, ids=" ".join)
def test_a_drive_is_the_same_with_an_echo(quirks: tuple[str, ...]) -> None:
    rate = [quirk for quirk in quirks if quirk.startswith("feedback-rate")]
    poses = []
    for names, echoes in ((rate, False), (quirks, True)):
        with Robot(like_a_board(*names, echoes=echoes), KNOWN) as robot:
            drive(robot)
            poses.append(robot.odometry.pose)
    assert poses[1] == pytest.approx(poses[0], abs=0.01)


@pytest.mark.parametrize("quirk", ["echo", "echo-newest"])
def test_feedback_that_equals_the_command_counts(quirk: str) -> None:
    """Feedback in whole numbers, of wheels that turn at a whole number."""
    whole = ACSAR.with_(encoder={"quantum": 1.0}, firmware={"feedback_rate": 50.0})
    with Robot(like_a_board(quirk, echoes=True, robot=whole), KNOWN) as robot:
        for _ in range(300):
            robot.tick((10.0, 10.0, 10.0, 10.0))
            assert robot.feedback_age < 0.1
        assert robot.speeds == (10.0, 10.0, 10.0, 10.0)


@pytest.mark.parametrize(
    ("quirks", "echoes", "said"),
    [
        (("echo=0.3",), False, "this board echoes, or sends its set points.*echo: true"),
        (("set-points",), False, "this board echoes, or sends its set points"),
        (("set-points", "echo"), True, "but this board's echo of the commands, or what equals it"),
        (("set-points", "dead-wheel=c", "feedback-rate=20"), False, "sends its set points"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, tuple) else "",
)
def test_set_points_are_refused(quirks: tuple[str, ...], echoes: bool, said: str) -> None:
    with (
        pytest.raises(LinkError, match=said),
        Robot(like_a_board(*quirks, echoes=echoes), KNOWN) as robot,
    ):
        for _ in range(2):
            drive(robot)


def test_wheels_that_start_again_and_again_are_measured() -> None:
    """They pass a few speeds of the same ramp each time."""
    watch = SetPointWatch(echoes=False)
    for _ in range(20):
        for speed in (*[0.0] * 100, 0.4, 0.8, 1.2, 1.6, 2.0):
            (reading,) = Decoder().feed(encode((0.5 * speed,) * 4))
            watch.note((speed,) * 4)
            watch.check(reading)


def test_a_recorded_echo_is_left_out_and_replays_bit_for_bit(tmp_path: Path) -> None:
    tape = tmp_path / "echo.mcap"
    with Robot(like_a_board("echo", echoes=True), KNOWN, recorder=Recorder(tape)) as robot:
        drive(robot)
        pose, speeds = robot.odometry.pose, robot.speeds
    (episode,) = read(tape).episodes
    assert episode.wire.echoes
    for config in (ACSAR, KNOWN):
        stamps, rows = episode.wire.feedback(config)
        assert len(stamps) == pytest.approx(len(episode.stamps), abs=5)
        assert tuple(rows[-1]) == speeds
    with Robot(ReplayLink(tape), ACSAR) as robot:
        drive(robot)
        assert (robot.odometry.pose, robot.speeds) == (pose, speeds)
    plain = tmp_path / "plain.mcap"
    record_drive(plain, ACSAR)
    assert not read(plain).episodes[0].wire.echoes
    assert np.isfinite(read(plain).episodes[0].speeds).all()


@pytest.mark.usefixtures("deadline")
@pytest.mark.parametrize(
    ("quirks", "codes", "said"),
    [
        (("echo",), {0}, "this board echoes: it sends each command back"),
        (("echo-newest", "feedback-rate=50", "dead-wheel=c"), {3}, "rear_left stands still"),
        (("set-points",), {3}, "this board echoes, or sends its set points"),
    ],
    ids=["echo", "dead", "set points"],
)
def test_a_policy_drives_by_feedback_alone(
    quirks: tuple[str, ...],
    codes: set[int],
    said: str,
    start_emulator: StartEmulator,
    robot_file: RobotFile,
) -> None:
    device = start_emulator("--quirk", *quirks).device
    options = ("--robot", robot_file(), "--yes", "--late-share", "1")
    done = cli("run", "0.8", "0.2", "--link", device, *options)
    assert done.returncode in codes, done.stderr
    assert said in done.stderr


@pytest.mark.usefixtures("deadline")
def test_an_echo_is_found_when_the_port_opens(
    config: RobotConfig, start_emulator: StartEmulator
) -> None:
    device = start_emulator("--quirk", "echo").device
    link: Any = open_link(device, config)
    with pytest.warns(SafetyWarning, match="this board echoes"):
        link.open()
    assert link.echoes
    with Robot(link, config) as robot:
        for _ in range(20):
            robot.drive(0.2, 0.0)
    known: Any = open_link(device, config.with_(echo=True))
    known.open()
    assert known.echoes
    known.close()
