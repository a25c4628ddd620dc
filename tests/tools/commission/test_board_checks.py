"""Each quirk of a board is found and named, and the robot's file that is written drives right."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
from board_tools import NoTrailingComma, Sibling, board, examined

from acsar_gym import Link, Robot, RobotConfig
from acsar_gym.errors import ConfigError, LinkError
from acsar_gym.protocol import WHEELS
from acsar_gym.tools.commission.wiring import parse_seen
from acsar_gym.worlds import Pose

SLOW_BOARD = {
    "motor": {"time_constant": 0.3, "deadband": 0.9, "acceleration": 10.0},
    "encoder": {"counts_per_revolution": 360, "window": 0.1},
}
"""As slow and as coarse as boards get."""
SWAPPED = ["b", "a", "d", "c"]
MIRRORED = ("swapped-motors", "swapped-encoders")
TIMEOUT = "stops when commands stop"


def booted(link: Sibling) -> Sibling:
    """A board that has started."""
    link.advance(2.0)
    return link


def test_a_board_as_documented_has_nothing_to_fix(tmp_path: Path) -> None:
    found, rows = examined(board())
    assert {row.status for row in rows.values()} == {"ok"}
    assert "--saw" in rows["wiring"].fix
    assert found.changes == {}
    assert found.save(tmp_path / "robot.yaml").found.endswith("nothing differs")


@pytest.mark.parametrize(
    ("make", "configured", "status", "needed"),
    [
        (lambda: board("at-comma"), True, "ok", None),
        (lambda: board("at-comma"), False, "warn", True),
        (lambda: booted(NoTrailingComma()), True, "warn", False),
        (lambda: board("no-comma", "dead-wheel=a"), True, "warn", False),
    ],
    ids=["known", "needed", "in the way", "with a dead wheel"],
)
def test_whether_a_board_needs_a_trailing_comma(
    make: Callable[[], Link], configured: bool, status: str, needed: bool | None
) -> None:
    found, rows = examined(make(), config=RobotConfig(trailing_comma=configured))
    assert rows["line end"].status == status
    assert rows["rear_right"].status == "ok"
    assert found.changes.get("trailing_comma") == needed


def test_an_encoder_that_is_reversed_within_the_boards_loop(tmp_path: Path) -> None:
    """No sign in a robot's file helps: the wheel would run away forward."""
    found, rows = examined(board("runaway=b"))
    assert rows["front_left"].status == "fail"
    assert "measured/commanded -5." in rows["front_left"].found
    assert rows["front_left"].fix.startswith("set ENCODER_REVERSED")
    assert rows[TIMEOUT].status == "skip"
    assert {rows[name].status for name in WHEELS if name != "front_left"} == {"ok"}
    assert found.changes == {}
    assert found.save(tmp_path / "robot.yaml").status == "skip"


@pytest.mark.parametrize(
    ("factor", "unit"),
    [
        ("9.55", "rpm (x 9.55)"),
        ("0.159", "rev/s (x 0.159)"),
        ("0.05", "m/s (x 0.05)"),
        ("0.5", "in the board's program, or the motor is too weak"),
    ],
)
def test_units_of_feedback_are_named(factor: str, unit: str) -> None:
    found, rows = examined(board(f"feedback-factor={factor}"))
    assert {rows[name].status for name in WHEELS} == {"fail"}
    assert {unit in rows[name].fix for name in WHEELS} == {True}
    assert found.times is None


def test_swapped_sides_need_eyes_and_are_compared_with_the_robots_file() -> None:
    assert {row.status for row in examined(board(*MIRRORED))[1].values()} == {"ok"}
    row = examined(board(*MIRRORED), SWAPPED)[1]["wiring"]
    assert "left and right motors and encoders are swapped" in row.found
    found, rows = examined(board("swapped-motors"), SWAPPED)
    assert "left and right motors are swapped" in rows["wiring"].found
    assert "--out" in rows["wiring"].fix
    known = RobotConfig(**found.changes)
    again = examined(board("swapped-motors"), SWAPPED, known)[1]["wiring"]
    assert (again.status, "as the robot's file says" in again.found) == ("ok", True)
    repaired = examined(board(), "abcd", known)[1]["wiring"]
    assert (repaired.status, repaired.found) == ("warn", "as seen, unlike in the robot's file")


@pytest.mark.parametrize(
    ("quirk", "saw", "reason"),
    [
        ("dead-wheel=c", None, "can't tell"),
        ("dead-encoder=c", None, "can't tell"),
        ("dead-wheel=c", ("a", "b", "none", "d"), "its motor is dead"),
        ("dead-encoder=c", "abcd", "its encoder is dead"),
    ],
)
def test_a_dead_wheel_or_encoder_is_named(
    quirk: str, saw: Sequence[str] | None, reason: str
) -> None:
    rows = examined(board(quirk), saw)[1]
    failed = {name: row.found for name, row in rows.items() if row.status == "fail"}
    assert set(failed) == {"rear_left"}
    assert reason in failed["rear_left"]


def test_a_board_that_is_reset_is_not_measured() -> None:
    found, rows = examined(board("resets=4"))
    assert "silent for 1.5 s" in rows["resets"].found
    assert (rows["line quality"].status, rows["resets"].status) == ("ok", "fail")
    assert not found.is_usable


def test_wheels_that_never_stop_are_an_error() -> None:
    quick = board("no-timeout", robot=RobotConfig(motor={"time_constant": 50.0}))
    quick.write(b"ap09.00,bp09.00,cp09.00,dp09.00,\r\n")
    for _ in range(2000):
        quick.advance(0.005)
    with pytest.raises(LinkError, match="still turn"):
        examined(quick)


@pytest.mark.parametrize("time_out", [0.2, 1.3])
@pytest.mark.parametrize(
    ("quirk", "robot"),
    [((), {}), (("feedback-rate=20",), SLOW_BOARD)],
    ids=["usual", "slow"],
)
def test_the_time_out_itself(time_out: float, quirk: tuple[str], robot: dict[str, Any]) -> None:
    unlike = RobotConfig(firmware={"command_timeout": 0.9})
    link = board(*quirk, f"command-timeout={time_out}", robot=RobotConfig(**robot))
    found, rows = examined(link, config=unlike)
    assert found.changes["firmware"]["command_timeout"] == pytest.approx(time_out, abs=0.03)
    assert rows[TIMEOUT].status == "ok"


def test_no_time_out() -> None:
    found, rows = examined(board("no-timeout"))
    assert (rows[TIMEOUT].status, rows[TIMEOUT].found) == ("fail", "the wheels keep turning")
    assert found.changes == {"firmware": {"command_timeout": None}}


@pytest.mark.parametrize("rate", [10, 200])
def test_the_feedback_rate(rate: int) -> None:
    assert examined(board(f"feedback-rate={rate}"))[0].changes["firmware"] == {
        "feedback_rate": rate
    }


@pytest.mark.parametrize(
    ("quirk", "name", "finding"),
    [
        ("echo", "echo", "this board echoes"),
        ("echo=0.3", "echo", "this board echoes"),
        ("set-points", "measured speeds", "feedback is what was commanded"),
        ("upper-case-commands", "command letters", "upper-case letters only"),
    ],
)
def test_a_board_whose_feedback_tells_nothing_gets_no_file(
    quirk: str, name: str, finding: str, tmp_path: Path
) -> None:
    found, rows = examined(board(quirk))
    assert list(rows)[-1] == name
    assert (rows[name].status, finding in rows[name].found) == ("fail", True)
    assert found.save(tmp_path / "robot.yaml").status == "skip"


@pytest.mark.parametrize("robot", [{}, SLOW_BOARD], ids=["usual", "slow"])
@pytest.mark.parametrize("quirk", ["stale=2.3", "stale=4"])
def test_old_lines_make_no_wrong_time_out(quirk: str, robot: dict[str, Any]) -> None:
    found = examined(board(quirk, robot=RobotConfig(**robot)))[0]
    assert found.changes.get("firmware", {}).get("command_timeout", 0.5) == pytest.approx(
        0.5, abs=0.06
    )


def driven(config: RobotConfig, *names: str) -> tuple[Pose, Pose]:
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
        (("unpadded", "feedback-rate=50"), None),
        (("reversed-motor=c",), ("a", "b", "cn", "d")),
        (("swapped-encoders", "reversed-encoder=c"), None),
        (MIRRORED, SWAPPED),
        (("swapped-motors", "reversed-encoder=a", "at-comma", "padded-space"), SWAPPED),
    ],
    ids=lambda value: " ".join(value) if value else "",
)
def test_the_robot_file_drives_right_and_is_right_the_next_time(
    quirks: tuple[str, ...], saw: Sequence[str] | None, tmp_path: Path
) -> None:
    guess = RobotConfig(trailing_comma="at-comma" not in quirks)
    found = examined(board(*quirks), saw, guess)[0]
    file = tmp_path / "robot.yaml"
    assumed = saw is None and any("encoder" in quirk for quirk in quirks)
    assert found.save(file).status == ("warn" if assumed else "ok")
    assert ("# An assumption: " in file.read_text()) == assumed
    for right, pose in zip(
        driven(RobotConfig()), driven(RobotConfig.load(file), *quirks), strict=True
    ):
        assert math.dist(right[:2], pose[:2]) < 0.02
        assert abs(right[2] - pose[2]) < 0.03

    again, rows = examined(board(*quirks), None, RobotConfig.load(file))
    assert again.changes == {}
    assert {rows[name].status for name in (*WHEELS, "wiring")} == {"ok"}


@pytest.mark.parametrize(
    "saw",
    [("e", "a", "b", "c"), ("a", "a", "c", "d"), ("ax", "b", "c", "d"), ("b", "a"), tuple("badcx")],
)
def test_what_cannot_have_been_seen(saw: tuple[str, ...]) -> None:
    with pytest.raises(ConfigError):
        parse_seen(saw)


def test_a_file_that_would_not_be_valid_or_can_not_be_written_is_a_failed_check(
    tmp_path: Path,
) -> None:
    found = examined(board())[0]
    assert found.save(tmp_path / "missing" / "robot.yaml").status == "fail"
    found.changes = {"firmware": {"feedback_rate": 1000.0}}
    assert found.save(tmp_path / "robot.yaml").status == "fail"
    assert not (tmp_path / "robot.yaml").exists()


def test_a_board_that_nobody_here_wrote() -> None:
    found, rows = examined(booted(Sibling()), config=RobotConfig(trailing_comma=False))
    warned = {name for name, row in rows.items() if row.status != "ok"}
    assert warned == {"feedback rate", "line end"}
    assert found.changes == {"trailing_comma": True, "firmware": {"feedback_rate": 50.0}}
    assert found.times is not None
    assert found.times.command_timeout == pytest.approx(0.5, abs=0.03)
