"""Commissioning: each quirk of a board is found and named, and its robot file drives right."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
from board_tools import NoTrailingComma, Sibling, board, commissioned

from acsar_gym import Robot, RobotConfig
from acsar_gym.errors import ConfigError, LinkError
from acsar_gym.protocol import WHEELS
from acsar_gym.tools.commission.wiring import (
    Commission,
    parse_all_seen,
)
from acsar_gym.worlds import Pose

SLOW_BOARD = {
    "motor": {"time_constant": 0.3, "deadband": 0.9, "acceleration": 10.0},
    "encoder": {"counts_per_revolution": 360, "window": 0.1},
}
"""As slow and as coarse as boards get."""
SWAPPED = ["b", "a", "d", "c"]
MIRRORED = ("swapped-motors", "swapped-encoders")


def looking(saw: Sequence[str] | None) -> Commission:
    """A commission of somebody who saw which wheels turned, or of nobody."""
    return Commission(eyes=None if saw is None else parse_all_seen(saw))


def findings(*names: str, saw: Sequence[str] | None = None, **robot: Any) -> dict[str, str]:
    """What the doctor finds that isn't ok."""
    checks = commissioned(board(*names, robot=RobotConfig(**robot)), looking(saw))
    return {name: check.found for name, check in checks.items() if check.status != "ok"}


def test_a_board_as_documented_has_nothing_to_mend() -> None:
    commission = Commission()
    checks = commissioned(board(), commission)
    assert {check.status for check in checks.values()} == {"ok"}
    assert "--saw" in checks["wiring"].fix
    assert (commission.changes, commission.finished) == ({}, True)


def misses_the_value_before_a_trailing_comma() -> NoTrailingComma:
    link = NoTrailingComma()
    link.advance(2.0)
    return link


@pytest.mark.parametrize(
    ("make", "assumed", "status", "needed"),
    [
        (lambda: board("at-comma"), True, "ok", True),
        (lambda: board("at-comma"), False, "warn", True),
        (misses_the_value_before_a_trailing_comma, True, "warn", False),
    ],
    ids=["known", "needed", "in the way"],
)
def test_whether_a_board_needs_a_trailing_comma(
    make: Callable[[], Any], assumed: bool, status: str, needed: bool
) -> None:
    commission = Commission()
    checks = commissioned(make(), commission, RobotConfig(trailing_comma=assumed))
    assert checks["line end"].status == status
    assert checks["rear_right"].status == "ok"
    assert commission.changes.get("trailing_comma") == (None if status == "ok" else needed)


def test_an_encoder_that_is_reversed_within_the_boards_loop() -> None:
    """No sign in a robot's file mends it: the wheel would run away forward."""
    commission = Commission()
    checks = commissioned(board("runaway=b"), commission)
    assert checks["front_left"].status == "fail"
    assert "measured/commanded -5." in checks["front_left"].found
    assert checks["front_left"].fix.startswith("set ENCODER_REVERSED")
    assert (commission.finished, commission.changes) == (False, {})
    assert checks["stops when commands stop"].status == "skip"
    assert {checks[name].status for name in WHEELS if name != "front_left"} == {"ok"}


@pytest.mark.parametrize(
    ("factor", "said"),
    [
        ("9.55", "rpm (x 9.55)"),
        ("0.159", "rev/s (x 0.159)"),
        ("57.3", "deg/s or counts"),
        ("0.05", "m/s (x 0.05)"),
        ("0.5", "gear ratio in the board's program, or a motor that is too weak"),
    ],
)
def test_units_of_feedback_are_named(factor: str, said: str) -> None:
    commission = Commission()
    checks = commissioned(board(f"feedback-factor={factor}"), commission)
    assert {checks[name].status for name in WHEELS} == {"fail"}
    assert {said in checks[name].fix for name in WHEELS} == {True}
    assert not commission.finished


def test_swapped_sides_need_eyes_and_are_compared_with_the_robots_file() -> None:
    assert findings(*MIRRORED) == {}
    said = findings(*MIRRORED, saw=SWAPPED)["wiring"]
    assert "left and right motors and encoders are swapped" in said
    commission = looking(SWAPPED)
    wiring = commissioned(board("swapped-motors"), commission)["wiring"]
    assert "left and right motors are swapped" in wiring.found
    assert "--out" in wiring.fix
    known = RobotConfig(**commission.changes)
    again = commissioned(board("swapped-motors"), looking(SWAPPED), known)["wiring"]
    assert (again.status, "as the robot's file says" in again.found) == ("ok", True)
    mended = commissioned(board(), looking("abcd"), known)["wiring"]
    assert (mended.status, mended.found) == ("warn", "as seen, unlike in the robot's file")


@pytest.mark.parametrize(
    ("quirk", "saw", "said"),
    [
        ("dead-wheel=c", None, "can't tell"),
        ("dead-encoder=c", None, "can't tell"),
        ("dead-wheel=c", ("a", "b", "none", "d"), "its motor is dead"),
        ("dead-encoder=c", "abcd", "its encoder is dead"),
    ],
)
def test_a_dead_wheel_or_encoder_is_named(quirk: str, saw: Sequence[str] | None, said: str) -> None:
    found = findings(quirk, saw=saw)
    assert "no encoder answers to motor c" in found["rear_left"]
    assert said in found["rear_left"]
    assert saw or set(found) == {"rear_left"}


def test_a_board_that_is_reset_is_not_measured() -> None:
    commission = Commission()
    checks = commissioned(board("resets=4"), commission)
    assert "silent for 1.5 s" in checks["resets"].found
    assert (checks["line quality"].status, checks["resets"].status) == ("ok", "fail")
    assert not commission.finished


def test_wheels_that_never_stop_are_an_error() -> None:
    quick = board("no-timeout", robot=RobotConfig(motor={"time_constant": 50.0}))
    quick.write(b"ap09.00,bp09.00,cp09.00,dp09.00,\r\n")
    for _ in range(2000):
        quick.advance(0.005)
    with pytest.raises(LinkError, match="still turn"):
        commissioned(quick, Commission())


@pytest.mark.parametrize("time_out", [0.2, 1.3])
@pytest.mark.parametrize(
    ("quirk", "robot"),
    [((), {}), (("feedback-rate=20",), SLOW_BOARD)],
    ids=["usual", "slow"],
)
def test_the_time_out_itself(time_out: float, quirk: tuple[str], robot: dict[str, Any]) -> None:
    commission = Commission()
    unlike = RobotConfig(firmware={"command_timeout": 0.9})
    link = board(*quirk, f"command-timeout={time_out}", robot=RobotConfig(**robot))
    checks = commissioned(link, commission, unlike)
    assert commission.changes["firmware"]["command_timeout"] == pytest.approx(time_out, abs=0.03)
    assert checks["stops when commands stop"].status == "ok"
    assert "the wheels stand after" in checks["stops when commands stop"].found


def test_no_time_out() -> None:
    commission = Commission()
    check = commissioned(board("no-timeout"), commission)["stops when commands stop"]
    assert (check.status, check.found) == ("fail", "the wheels keep turning")
    assert commission.changes == {"firmware": {"command_timeout": None}}


@pytest.mark.parametrize("rate", [10, 200])
def test_the_feedback_rate(rate: int) -> None:
    commission = Commission()
    commissioned(board(f"feedback-rate={rate}"), commission)
    assert commission.changes["firmware"] == {"feedback_rate": rate}


@pytest.mark.parametrize("quirk", ["echo", "echo=0.3"])
def test_an_echo_ends_the_checks(quirk: str) -> None:
    commission = Commission()
    checks = commissioned(board(quirk), commission)
    assert list(checks) == ["echo"]
    assert (checks["echo"].status, commission.finished) == ("fail", False)
    assert "this board echoes" in checks["echo"].found
    assert "delete the echo from the board's program" in checks["echo"].fix


@pytest.mark.parametrize(
    ("quirks", "name", "said"),
    [
        (("set-points",), "measured speeds", "feedback is what was commanded"),
        (("upper-case-commands",), "command letters", "upper-case letters only"),
        (("stale",), "stale feedback", "the board repeats old lines"),
        (("stale=2", "feedback-rate=50"), "stale feedback", "the board repeats old lines"),
    ],
    ids=" ".join,
)
def test_a_board_whose_feedback_tells_nothing_gets_no_file(
    quirks: tuple[str, ...], name: str, said: str
) -> None:
    commission = Commission()
    check = commissioned(board(*quirks), commission)[name]
    assert (check.status, said in check.found) == ("fail", True)
    assert not commission.finished


@pytest.mark.parametrize("robot", [{}, SLOW_BOARD], ids=["usual", "slow"])
@pytest.mark.parametrize("quirk", ["stale=2.3", "stale=4"])
def test_old_lines_make_no_wrong_time_out(quirk: str, robot: dict[str, Any]) -> None:
    commission = Commission()
    commissioned(board(quirk, robot=RobotConfig(**robot)), commission)
    found = commission.changes.get("firmware", {}).get("command_timeout", 0.5)
    assert not commission.finished or found == pytest.approx(0.5, abs=0.06)


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
        (("swapped-encoders",), None),
        (MIRRORED, SWAPPED),
        (("swapped-motors", "reversed-encoder=a", "at-comma", "padded-space"), SWAPPED),
    ],
    ids=lambda value: " ".join(value) if value else "",
)
def test_the_robot_file_drives_right(
    quirks: tuple[str, ...], saw: Sequence[str] | None, tmp_path: Path
) -> None:
    commission = looking(saw)
    guess = RobotConfig(trailing_comma="at-comma" not in quirks)
    commissioned(board(*quirks), commission, guess)
    assert commission.finished
    file = tmp_path / "robot.yaml"
    assumed = saw is None and any("encoder" in quirk for quirk in quirks)
    assert commission.save(guess, file).status == ("warn" if assumed else "ok")
    assert ("# An assumption: " in file.read_text()) == assumed
    for right, pose in zip(
        driven(RobotConfig()), driven(RobotConfig.load(file), *quirks), strict=True
    ):
        assert math.dist(right[:2], pose[:2]) < 0.02
        assert abs(right[2] - pose[2]) < 0.03


@pytest.mark.parametrize(
    ("quirks", "saw"),
    [
        (("swapped-motors", "reversed-motor=b"), ("b", "an", "d", "c")),
        (("swapped-encoders", "reversed-encoder=c", "feedback-rate=50"), None),
    ],
    ids=["reversed", "unseen"],
)
def test_a_robot_file_is_right_the_next_time_and_where_nobody_looks(
    quirks: tuple[str, ...], saw: Sequence[str] | None, tmp_path: Path
) -> None:
    first, file = looking(saw), tmp_path / "robot.yaml"
    commissioned(board(*quirks), first)
    first.save(RobotConfig(), file)
    again = Commission()
    checks = commissioned(board(*quirks), again, RobotConfig.load(file))
    assert (again.changes, again.assumed) == ({}, False)
    assert {checks[name].status for name in WHEELS} == {"ok"}
    assert (checks["wiring"].status, checks["wiring"].found) == ("ok", "as the robot's file says")


def test_asking_takes_answers_until_they_make_sense() -> None:
    answers = iter(["what?", "b", "a", "", "c"])
    asked: list[str] = []

    def ask(question: str) -> str:
        asked.append(question)
        return next(answers)

    with pytest.raises(ConfigError, match="one wheel turned for two letters"):
        commissioned(board(), Commission(ask=ask))
    assert len(asked) == 5
    assert "a was commanded forward" in asked[0] == asked[1]


@pytest.mark.parametrize(
    "said",
    [("e", "a", "b", "c"), ("a", "a", "c", "d"), ("ax", "b", "c", "d"), ("b", "a"), tuple("badcx")],
)
def test_what_cannot_have_been_seen(said: tuple[str, ...]) -> None:
    with pytest.raises(ConfigError):
        parse_all_seen(said)


def test_a_file_that_would_not_be_valid_or_can_not_be_written_is_a_failed_check(
    tmp_path: Path,
) -> None:
    commission = Commission(changes={"firmware": {"feedback_rate": 1000.0}})
    assert commission.save(RobotConfig(), tmp_path / "robot.yaml").status == "fail"
    assert not (tmp_path / "robot.yaml").exists()
    check = Commission().save(RobotConfig(), tmp_path / "missing" / "robot.yaml")
    assert (check.status, check.fix) == ("fail", "give another file with --out")


def test_a_board_that_nobody_here_wrote() -> None:
    commission = Commission()
    sibling: Any = Sibling()
    sibling.advance(2.0)
    checks = commissioned(sibling, commission, RobotConfig(trailing_comma=False))
    assert {name for name, check in checks.items() if check.status != "ok"} == {
        "feedback rate",
        "line end",
    }
    assert commission.changes == {"trailing_comma": True, "firmware": {"feedback_rate": 50.0}}
    after, *_ = checks["stops when commands stop"].found.split()
    assert float(after) == pytest.approx(0.5, abs=0.03)
