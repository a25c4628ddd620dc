"""Each quirk of a board is found and named, and the robot's file that is written drives right."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
from boards import board
from integer_board import SIBLING, IntegerLink

from acsar_gym import Link, Robot, RobotConfig
from acsar_gym.errors import ConfigError, LinkError
from acsar_gym.protocol import MOTORS, WHEELS
from acsar_gym.tools.commission.board_checks import BoardExamination
from acsar_gym.tools.commission.checks import Check
from acsar_gym.tools.commission.wiring import parse_seen
from acsar_gym.worlds import Pose


def examined(
    link: Link, saw: Sequence[str] | None = None, config: RobotConfig | None = None
) -> tuple[BoardExamination, dict[str, Check]]:
    """Examine a board. Returns the examination and its rows by name."""
    turned = None if saw is None else parse_seen(saw)
    examination = BoardExamination(config or RobotConfig(), spin=True, seen=turned)
    return examination, {row.name: row for row in examination.run(link)}


SLOW_BOARD = {
    "motor": {"time_constant": 0.3, "deadband": 0.9, "acceleration": 10.0},
    "encoder": {"counts_per_revolution": 360, "window": 0.1},
}
"""As slow and as coarse as boards get."""
SWAPPED = ["b", "a", "d", "c"]
MIRRORED = ("swapped-motors", "swapped-encoders")
TIMEOUT = "stops when commands stop"


def test_run_finds_nothing_to_fix_on_a_board_as_documented(tmp_path: Path) -> None:
    result, rows = examined(board())
    assert {row.status for row in rows.values()} == {"ok"}
    assert "--saw" in rows["wiring"].fix
    assert result.changes == {}
    assert result.save(tmp_path / "robot.yaml").found.endswith("nothing differs")


@pytest.mark.parametrize(
    ("make", "configured", "status", "needed"),
    [
        (lambda: board("at-comma"), False, "warn", True),
        (lambda: board("no-comma"), True, "warn", False),
        (lambda: board("no-comma", "dead-wheel=a"), True, "warn", False),
    ],
    ids=["needed", "in the way", "with a dead wheel"],
)
def test_check_line_end(
    make: Callable[[], Link], configured: bool, status: str, needed: bool | None
) -> None:
    result, rows = examined(make(), config=RobotConfig(trailing_comma=configured))
    assert rows["line end"].status == status
    assert rows["rear_right"].status == "ok"
    assert result.changes.get("trailing_comma") == needed


@pytest.mark.parametrize("quirks", [(), ("no-comma",)], ids=["usual", "no comma"])
def test_spin_turns_the_wheels_in_the_order_of_their_letters(quirks: tuple[str, ...]) -> None:
    """Users note which wheel turns for each letter, so no other check turns a wheel before."""
    link = board(*quirks)
    turned = [""]
    write = link.write

    def note(data: bytes) -> None:
        letters = "".join(letter for letter in MOTORS if b"%cp03.00" % ord(letter) in data)
        if letters not in ("", turned[-1]):
            turned.append(letters)
        write(data)

    link.write = note  # type: ignore[method-assign]
    examined(link)
    assert turned[1:5] == list(MOTORS)


@pytest.mark.parametrize(
    ("quirk", "saw", "name", "text"),
    [
        ("runaway=b", None, "front_left", "set ENCODER_REVERSED"),
        ("feedback-factor=9.55", None, "rear_left", "rpm (x 9.55)"),
        ("feedback-factor=0.5", None, "front_left", "or the motor is too weak"),
        ("dead-encoder=c", None, "rear_left", "can't tell"),
        ("dead-wheel=c", ("a", "b", "none", "d"), "rear_left", "its motor is dead"),
        ("dead-encoder=c", "abcd", "rear_left", "its encoder is dead"),
        ("resets=4", None, "resets", "silent for 1.5 s"),
        ("echo=0.3", None, "echo", "this board echoes"),
        ("set-points", None, "measured speeds", "feedback is what was commanded"),
        ("upper-case-commands", None, "command letters", "upper-case letters only"),
    ],
)
def test_run_names_what_no_file_can_help(
    quirk: str, saw: Sequence[str] | None, name: str, text: str, tmp_path: Path
) -> None:
    result, rows = examined(board(quirk), saw)
    assert rows[name].status == "fail"
    assert text in f"{rows[name].found}; {rows[name].fix}"

    is_scale = quirk.startswith("feedback")
    assert {key for key, row in rows.items() if row.status == "fail"} == (
        set(WHEELS) if is_scale else {name}
    )
    assert result.save(tmp_path / "robot.yaml").status == "skip"


def test_check_wiring_compares_what_was_seen_with_the_robots_file() -> None:
    assert {row.status for row in examined(board(*MIRRORED))[1].values()} == {"ok"}
    row = examined(board(*MIRRORED), SWAPPED)[1]["wiring"]
    assert "left and right motors and encoders are swapped" in row.found
    result, rows = examined(board("swapped-motors"), SWAPPED)
    assert "left and right motors are swapped" in rows["wiring"].found
    assert "--out" in rows["wiring"].fix
    wired = RobotConfig(**result.changes)
    row = examined(board("swapped-motors"), SWAPPED, wired)[1]["wiring"]
    assert (row.status, "as the robot's file says" in row.found) == ("ok", True)
    row = examined(board(), "abcd", wired)[1]["wiring"]
    assert (row.status, row.found) == ("warn", "as seen, unlike in the robot's file")


def test_listen_warns_of_wheels_that_turn_while_zero_is_commanded() -> None:
    link = board("no-timeout", robot=RobotConfig(motor={"time_constant": 50.0}))
    link.write(b"ap00.00,bn09.00,cp00.00,dp09.00,\r\n")
    for _ in range(2000):
        link.advance(0.005)
    rows = {row.name: row for row in BoardExamination(RobotConfig()).run(link)}
    assert rows["standing"].status == "warn"
    assert rows["standing"].found.startswith("b, d: feedback isn't zero")


def test_run_refuses_wheels_that_never_stop() -> None:
    link = board("no-timeout", robot=RobotConfig(motor={"time_constant": 50.0}))
    link.write(b"ap09.00,bp09.00,cp09.00,dp09.00,\r\n")
    for _ in range(2000):
        link.advance(0.005)
    with pytest.raises(LinkError, match="still turn"):
        examined(link)


@pytest.mark.parametrize(
    ("quirks", "robot", "timeout"),
    [
        (("command-timeout=1.3", "feedback-rate=20"), SLOW_BOARD, 1.3),
        (("stale=2.3", "command-timeout=0.5"), SLOW_BOARD, 0.5),
        (("stale=2",), {}, 0.5),
        (("no-timeout",), {}, None),
    ],
    ids=str,
)
def test_check_timeout(quirks: tuple[str], robot: dict[str, Any], timeout: float | None) -> None:
    """Old lines that a board repeats don't spoil it."""
    unlike = RobotConfig(firmware={"command_timeout": 0.9})
    result, rows = examined(board(*quirks, robot=RobotConfig(**robot)), config=unlike)
    measured = result.changes["firmware"]["command_timeout"]
    assert measured == (None if timeout is None else pytest.approx(timeout, abs=0.06))
    assert rows[TIMEOUT].status == ("fail" if timeout is None else "ok")

    # The time after which nothing moves any more, if the program dies.
    at_rest = re.search("the wheels are at rest after (.*) s", rows[TIMEOUT].found)
    assert (at_rest is None) == (timeout is None)
    if at_rest is not None and timeout is not None:
        assert timeout + 0.1 < float(at_rest[1]) < timeout + 1.5


@pytest.mark.parametrize(
    ("delay", "status", "finding"),
    [(0.6, "warn", "6.. ms from a command's last byte"), (1.0, "fail", "no effect within 1 s")],
)
def test_run_times_a_board_that_answers_late(delay: float, status: str, finding: str) -> None:
    late = RobotConfig(firmware={"command_delay": delay})
    row = examined(board(robot=late))[1]["command to feedback"]
    assert row.status == status
    assert re.search(finding, row.found)


def drive(config: RobotConfig, *names: str) -> tuple[Pose, Pose]:
    """True poses of a robot behind a quirky board: after driving straight, and after a turn."""
    with Robot(board(*names), config) as robot:
        poses = []
        for angular in (0.0, 1.0):
            for _ in range(200):
                robot.drive(0.3, angular)
            assert robot.link.truth is not None
            poses.append(robot.link.truth.pose)
        return poses[0], poses[1]


@pytest.mark.parametrize(
    ("quirks", "saw"),
    [
        (("reversed-motor=c", "unpadded", "feedback-rate=50"), ("a", "b", "cn", "d")),
        (("swapped-encoders",), None),
        (("swapped-motors", "reversed-encoder=a", "at-comma", "padded-space"), SWAPPED),
    ],
    ids=lambda value: " ".join(value) if value else "",
)
def test_save_writes_a_file_that_drives_right(
    quirks: tuple[str, ...], saw: Sequence[str] | None, tmp_path: Path
) -> None:
    guess = RobotConfig(trailing_comma="at-comma" not in quirks)
    result = examined(board(*quirks), saw, guess)[0]
    path = tmp_path / "robot.yaml"
    is_assumed = saw is None
    assert result.save(path).status == ("warn" if is_assumed else "ok")
    assert ("# An assumption: " in path.read_text()) == is_assumed
    robot = RobotConfig.load(path)
    for right, pose in zip(drive(RobotConfig()), drive(robot, *quirks), strict=True):
        assert math.dist(right[:2], pose[:2]) < 0.02
        assert abs(right[2] - pose[2]) < 0.03

    again, rows = examined(board(*quirks), None, robot)
    assert again.changes == {}
    assert {rows[name].status for name in (*WHEELS, "wiring")} == {"ok"}


def test_save_fails_for_a_bad_file(tmp_path: Path) -> None:
    result = examined(board())[0]
    assert result.save(tmp_path / "missing" / "robot.yaml").status == "fail"
    result.changes = {"firmware": {"feedback_rate": 1000.0}}
    assert result.save(tmp_path / "robot.yaml").status == "fail"
    assert not (tmp_path / "robot.yaml").exists()


@pytest.mark.parametrize(
    ("saw", "message"),
    [
        ("eabc", "'e': write the wheel"),
        ("aacd", "one wheel turned for two"),
        ("ba", "must be four"),
    ],
)
def test_parse_seen_refuses_what_cannot_have_been_seen(saw: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        parse_seen(saw)


def test_run_measures_a_foreign_board() -> None:
    result, rows = examined(IntegerLink(SIBLING), config=RobotConfig(trailing_comma=False))
    warned = {name for name, row in rows.items() if row.status != "ok"}
    assert warned == {"feedback rate", "line end"}
    assert result.changes == {"trailing_comma": True, "firmware": {"feedback_rate": 50.0}}
    assert result.times is not None
    assert result.times.command_timeout == pytest.approx(0.5, abs=0.03)
