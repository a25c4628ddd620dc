"""Commissioning: each quirk of a board is found and named, and its robot file drives right."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
import quirks
from board_tools import NoTrailingComma, Sibling, board, commissioned
from quirks import QuirkyLink

from acsar_gym import Robot, RobotConfig
from acsar_gym.errors import BoardSilentError, ConfigError, LinkError
from acsar_gym.protocol import WHEELS, encode
from acsar_gym.tools.commission.wiring import (
    SWAPPED_FIX,
    Commission,
    parse_all_seen,
    report_delays,
)
from acsar_gym.tools.sysid.board import leave_out_early
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


@pytest.mark.parametrize(
    ("quirk", "shown"), [("unpadded", "'ap0.00,bp0.00"), ("padded-space", "'ap 0.00,bp 0.00")]
)
def test_numbers_of_its_own_are_shown_and_nothing_to_mend(quirk: str, shown: str) -> None:
    checks = commissioned(board(quirk), Commission())
    assert shown in checks["line format"].found
    assert checks["line quality"].status == checks["line format"].status == "ok"
    assert checks["line quality"].found.startswith("0 bad parts")


@pytest.mark.parametrize("saw", [None, "abcd"])
def test_an_encoder_that_is_reversed_within_the_boards_loop(saw: Sequence[str] | None) -> None:
    """No sign in a robot's file mends it: the wheel would run away forward."""
    commission = looking(saw)
    checks = commissioned(board("runaway=b"), commission)
    assert checks["front_left"].status == "fail"
    assert "measured/commanded -5." in checks["front_left"].found
    assert checks["front_left"].fix.startswith("set ENCODER_REVERSED")
    assert (commission.finished, commission.changes) == (False, {})
    assert checks["stops when commands stop"].status == "skip"
    assert {checks[name].status for name in WHEELS if name != "front_left"} == {"ok"}
    swapped = commissioned(board("runaway=b", "swapped-encoders"), commission)["front_left"]
    assert (swapped.status, swapped.fix) == ("fail", SWAPPED_FIX)
    assert not commission.finished


class Cutting(QuirkyLink):
    """A board that stops a wheel soon which turns the other way than its motor."""

    begun: float | None = None

    def take_line(self, line: bytes) -> bytes:
        line = super().take_line(line)
        if not line.startswith((b"ap", b"an")) or line.startswith((b"ap00.00", b"an00.00")):
            self.begun = None
        elif self.begun is None:
            self.begun = self.now()
        elif self.now() > self.begun + 0.2:
            return encode((0.0, 0.0, 0.0, 0.0)).rstrip()
        return line


def test_a_wheel_that_the_board_stops_as_it_turns_backward() -> None:
    found = quirks.parse_quirks(["runaway=a"])
    commission = Commission()
    check = commissioned(Cutting(board().link, RobotConfig(), found), commission)["front_right"]
    assert check.status == "fail"
    assert "turned backward, and stood again" in check.found
    assert check.fix.startswith("set ENCODER_REVERSED")
    assert not commission.finished


@pytest.mark.parametrize(
    ("factor", "said"),
    [
        ("9.55", "rpm (x 9.55)"),
        ("0.159", "rev/s (x 0.159)"),
        ("57.3", "deg/s or counts"),
        ("20", "counts per turn or gear ratio"),
        ("0.05", "m/s (x 0.05)"),
        ("1.5", "counts per turn or gear ratio"),
        ("0.5", "gear ratio in the board's program, or a motor that is too weak"),
    ],
)
def test_units_of_feedback_are_named(factor: str, said: str) -> None:
    commission = Commission()
    checks = commissioned(board(f"feedback-factor={factor}"), commission)
    assert {checks[name].status for name in WHEELS} == {"fail"}
    assert {said in checks[name].fix for name in WHEELS} == {True}
    assert not commission.finished


def test_a_reversed_encoder_in_another_unit_is_no_runaway() -> None:
    checks = commissioned(board("feedback-factor=9.55", "reversed-encoder=b"), Commission())
    assert "measured/commanded -9.5" in checks["front_left"].found
    assert "rpm" in checks["front_left"].fix


@pytest.mark.parametrize("factor", [0.75, 1.35])
@pytest.mark.parametrize("robot", [{}, SLOW_BOARD], ids=["usual", "slow"])
def test_a_wheel_may_be_somewhat_slower_or_faster(factor: float, robot: dict[str, Any]) -> None:
    link = board(f"feedback-factor={factor}", robot=RobotConfig(**robot))
    checks = commissioned(link, Commission())
    assert {checks[name].status for name in WHEELS} == {"ok"}
    said = checks["front_left"].found.partition("measured/commanded ")[2]
    assert float(said) == pytest.approx(factor, abs=0.06)


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


def test_nothing_turns() -> None:
    found = findings(motor={"deadband": 20.0})
    assert found["command to feedback"] == "no wheel turns"
    assert set(WHEELS) < set(found)


def test_a_board_that_is_reset_is_not_measured() -> None:
    commission = Commission()
    checks = commissioned(board("resets=4"), commission)
    assert "silent for 1.5 s" in checks["resets"].found
    assert (checks["line quality"].status, checks["resets"].status) == ("ok", "fail")
    assert not commission.finished


def test_a_frozen_board_is_silent() -> None:
    with pytest.raises(BoardSilentError, match=r"in mid-line after 'ap00\.00,bp00\.00,c") as caught:
        commissioned(board("frozen=1"), Commission())
    assert type(caught.value) is BoardSilentError


def test_wheels_that_never_stop_are_an_error() -> None:
    quick = board("no-timeout", robot=RobotConfig(motor={"time_constant": 50.0}))
    quick.write(b"ap09.00,bp09.00,cp09.00,dp09.00,\r\n")
    for _ in range(2000):
        quick.advance(0.005)
    with pytest.raises(LinkError, match="still turn"):
        commissioned(quick, Commission())


@pytest.mark.parametrize("time_out", [0.2, 0.5, 1.3])
@pytest.mark.parametrize(
    ("quirk", "robot"),
    [((), {}), (("feedback-rate=50",), SLOW_BOARD), (("feedback-rate=20",), SLOW_BOARD)],
    ids=["usual", "slow", "slowest"],
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


@pytest.mark.parametrize("rate", [10, 20, 50, 200])
def test_the_feedback_rate(rate: int) -> None:
    commission = Commission()
    commissioned(board(f"feedback-rate={rate}"), commission)
    assert commission.changes["firmware"] == {"feedback_rate": rate}


def test_the_delay_leaves_out_the_wait_for_the_next_line() -> None:
    """Its length hardly depends on how often lines come."""
    shortest = []
    for rate in (200, 50):
        found = commissioned(board(f"feedback-rate={rate}"), Commission())["command to feedback"]
        shortest.append(float(found.found.split(" ")[0]))
    assert 5.0 < shortest[0] < 40.0
    assert abs(shortest[1] - shortest[0]) < 15.0


@pytest.mark.parametrize(
    ("delays", "said", "status"),
    [
        ([0.04] * 9, "40 ms from a command's last byte .* median of 9; 95 % within 40 ms$", "ok"),
        (
            [*[0.04] * 7, 0.005, 0.01],
            "40 ms .* median of 7; 95 % within 40 ms; 2 of 9 left out: wheels still crept$",
            "ok",
        ),
        ([*[0.04] * 7, 0.12, 0.3], "40 ms .* median of 9; 95 % within 300 ms$", "ok"),
        ([*[0.095] * 4, *[0.115] * 5], "115 ms .* median of 9; 95 % within 115 ms$", "warn"),
    ],
    ids=["alike", "early", "late", "slow"],
)
def test_early_delays_are_left_out_and_late_ones_count(
    delays: list[float], said: str, status: str
) -> None:
    check = report_delays(leave_out_early(delays, 0.02))
    assert re.match(said, check.found)
    assert check.status == status


@pytest.mark.parametrize("quirk", ["echo", "echo=0.3", "echo-newest"])
@pytest.mark.parametrize(
    ("fault", "wheel", "said"),
    [
        ((), "", ""),
        (("dead-wheel=c",), "rear_left", "dead: no encoder answers to motor c"),
        (("runaway=b",), "front_left", "measured/commanded -5."),
        (("reversed-encoder=d", "feedback-rate=50"), "rear_right", "its encoder is reversed"),
        (("swapped-encoders",), "front_right", "its encoder is swapped with that of front_left"),
    ],
    ids=["sound", "dead", "runaway", "reversed", "swapped"],
)
def test_an_echo_is_named_and_hides_nothing(
    quirk: str, fault: tuple[str, ...], wheel: str, said: str
) -> None:
    commission = Commission()
    checks = commissioned(board(quirk, *fault), commission)
    assert (checks["echo"].status, "this board echoes" in checks["echo"].found) == ("warn", True)
    assert said in (checks[wheel].found if wheel else "")
    rate = 50.0 if "feedback-rate=50" in fault else 100.0
    assert checks["feedback rate"].found.startswith(f"{rate} lines/s")
    assert checks["line format"].found.endswith("'ap00.00,bp00.00,cp00.00,dp00.00,'")
    if fault != ("runaway=b",):
        assert commission.changes.pop("echo") is True
        assert commission.changes.get("firmware", {}) == (
            {} if rate == 100.0 else {"feedback_rate": 50.0}
        )


@pytest.mark.parametrize(
    ("quirks", "name", "said"),
    [
        (("set-points",), "measured speeds", "feedback is what was commanded"),
        (
            ("set-points", "dead-wheel=a"),
            "measured speeds",
            "feedback is what was commanded",
        ),
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


def test_set_points_beside_an_echo_are_no_feedback() -> None:
    commission = Commission()
    with pytest.raises(BoardSilentError, match="this board's echo of the commands, or what equals"):
        commissioned(board("set-points", "echo", "dead-wheel=a"), commission)
    assert not commission.finished


@pytest.mark.parametrize("robot", [{}, SLOW_BOARD], ids=["usual", "slow"])
@pytest.mark.parametrize("quirk", ["stale=2.3", "stale=3.1", "stale=4"])
def test_old_lines_make_no_wrong_time_out(quirk: str, robot: dict[str, Any]) -> None:
    commission = Commission()
    commissioned(board(quirk, robot=RobotConfig(**robot)), commission)
    found = commission.changes.get("firmware", {}).get("command_timeout", 0.5)
    assert not commission.finished or found == pytest.approx(0.5, abs=0.06)


class Busy(QuirkyLink):
    """A board that sends 100 lines per second, and half of them while it gets many commands."""

    before = -1.0
    lines = 0

    def advance(self, period: float) -> bytes:
        said = super().advance(period)
        self.lines += bool(said)
        return b"" if self.now() < self.before + 0.03 and self.lines % 2 else said

    def take_line(self, line: bytes) -> bytes:
        self.before, self.newest = getattr(self, "newest", -1.0), self.now()
        self.before = self.before if self.newest - self.before < 0.03 else -1.0
        return super().take_line(line)


def test_the_feedback_rate_is_one_number() -> None:
    """That of a drive, in which commands come at the control rate, in the row and in the file."""
    commission = Commission()
    checks = commissioned(Busy(board().link, RobotConfig(), {"at-comma": ""}), commission)
    row = float(checks["feedback rate"].found.split()[0])
    assert row == pytest.approx(50.0, rel=0.1)
    assert commission.changes["firmware"]["feedback_rate"] == row


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
        (("at-comma",), None),
        (("unpadded", "feedback-rate=50"), None),
        (("reversed-encoder=b",), None),
        (("reversed-motor=c",), ("a", "b", "cn", "d")),
        (("swapped-encoders",), None),
        (("swapped-motors",), SWAPPED),
        (MIRRORED, SWAPPED),
        (("swapped-motors", "reversed-encoder=a", "at-comma", "padded-space"), SWAPPED),
        (("command-timeout=0.5",), None),
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
        (("swapped-motors",), SWAPPED),
        (("swapped-motors", "reversed-motor=b"), ("b", "an", "d", "c")),
        (MIRRORED, SWAPPED),
        (("swapped-encoders", "reversed-encoder=c", "feedback-rate=50"), None),
    ],
    ids=["motors", "reversed", "both", "unseen"],
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


def test_nobody_needs_to_look_where_the_robots_file_is_right() -> None:
    letters = zip("abcd", SWAPPED, strict=True)
    config = RobotConfig(wheels={letter: {"motor": own} for letter, own in letters})
    checks = commissioned(board("swapped-motors", "dead-encoder=c"), Commission(), config)
    assert {name for name in WHEELS if checks[name].status != "ok"} == {"rear_left"}
    enters = Commission(ask=lambda _: "")
    commissioned(board("swapped-motors"), enters, config)
    assert enters.changes == {}


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
