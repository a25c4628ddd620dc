"""The folders of the emergency stop's sockets: which are trusted, and what is said."""

from __future__ import annotations

import os
import re
import warnings
from pathlib import Path

import pytest
from estop_tools import DRIVING, answering, estop_command
from serial_tools import TIMEOUT, Emulated, RobotFile, no_leak, program

from acsar_gym import Robot, RobotConfig
from acsar_gym.errors import LinkError, SafetyWarning
from acsar_gym.links import open_link
from acsar_gym.safety import estop
from acsar_gym.tools.doctor import checks as doctor

pytestmark = [pytest.mark.xdist_group("serial"), pytest.mark.usefixtures("deadline", "place")]


BAD = {
    "too open": lambda path: path.mkdir(mode=0o755),
    "a link": lambda path: path.symlink_to("/tmp"),  # noqa: S108
    "a file": lambda path: path.write_text(""),
}


@pytest.mark.parametrize("kind", BAD)
def test_a_folder_that_cannot_be_trusted_is_told_of(
    kind: str,
    place: Path,
    config: RobotConfig,
    shared_device: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """By a warning at activation, by the doctor, and by the command."""
    (path,) = estop.list_candidates()
    BAD[kind](path)
    robot = Robot(open_link(shared_device, config), config)
    with no_leak():
        with pytest.warns(SafetyWarning, match=f"can't stop this robot: {path}") as told:
            robot.activate()
        assert len(told) == 1
        robot.drive(0.0, 0.0)
        robot.deactivate()
    check = doctor.check_estop()
    assert check.status == "warn"
    assert str(path) in check.found
    assert check.fix
    code, output, error = estop_command(capsys, monkeypatch)
    assert (code, output) == (3, "")
    assert re.fullmatch(f"acsar-gym: {path}: .*\n", error)


def test_a_folder_of_somebody_else_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    mine = os.getuid()
    monkeypatch.setattr(os, "getuid", lambda: mine + 1)
    with pytest.raises(LinkError, match="yours alone"):
        estop.stop_all()
    assert "yours alone" in estop.StopListener().unavailable


def test_a_warning_that_is_an_error_leaves_nothing_open(
    place: Path, config: RobotConfig, shared_device: str
) -> None:
    estop.list_candidates()[0].write_text("")
    robot = Robot(open_link(shared_device, config), config)
    with no_leak(), warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(SafetyWarning):
            robot.activate()
        assert not robot.active


def test_the_command_line_warns_in_one_line(
    place: Path, emulator: Emulated, robot_file: RobotFile
) -> None:
    estop.list_candidates()[0].write_text("")
    options = ("--link", emulator.device, "--linear", "0.2", "--duration", "0.05")
    with program(DRIVING, "drive", *options, "--robot", str(robot_file())) as process:
        _, error = process.communicate(timeout=TIMEOUT)
    assert process.returncode == 0
    assert re.fullmatch("acsar-gym: 'acsar-gym estop' can't stop this robot: .*\n", error)


@pytest.mark.parametrize(
    ("base", "said"),
    [("/acsar-missing", "can't be made a folder"), ("/tmp/" + "long" * 30, "too long")],  # noqa: S108
)
def test_a_folder_that_cannot_be_is_one_line(
    base: str,
    said: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("ACSAR_GYM_RUNTIME_DIR", base)
    code, output, error = estop_command(capsys, monkeypatch)
    assert (code, output, error.count("\n")) == (3, "", 1)
    assert error.startswith(f"acsar-gym: {base}/acsar_gym-{os.getuid()}: {said}")
    assert said in estop.StopListener().unavailable


@pytest.fixture
def usual(place: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, Path]:
    """The folder of the user's sessions, and the one that all share."""
    monkeypatch.delenv("ACSAR_GYM_RUNTIME_DIR")
    monkeypatch.setattr(estop, "SESSION_FOLDERS", place / "user")
    monkeypatch.setattr(estop, "SHARED_FOLDER", place / "tmp")
    session = place / "user" / str(os.getuid())
    session.mkdir(0o700, parents=True)
    (place / "tmp").mkdir()
    return session, place / "tmp"


def test_a_process_of_two_folders_is_one(usual: tuple[Path, Path]) -> None:
    listener = estop.StopListener()
    assert {path.parent.parent for path in listener.paths} == set(usual)
    thread = answering(listener)
    assert estop.stop_all() == [estop.StopResult(os.getpid(), answered=True)]
    thread.join()
    assert doctor.check_estop().status == "ok"
    listener.close()


@pytest.mark.parametrize("missing", [0, 1], ids=["before the login", "somebody else's"])
def test_one_of_the_folders_is_enough(missing: int, usual: tuple[Path, Path]) -> None:
    name = f"acsar_gym-{os.getuid()}"
    (usual[missing] / name).write_text("")  # a driver that can't use it
    listener = estop.StopListener()
    assert not listener.unavailable
    (usual[missing] / name).unlink()
    thread = answering(listener)
    assert estop.stop_all() == [estop.StopResult(os.getpid(), answered=True)]
    thread.join()
    listener.close()


def test_a_session_that_others_can_write_to_is_not_used(usual: tuple[Path, Path]) -> None:
    session, shared = usual
    session.chmod(0o777)
    assert [path.parent for path in estop.list_candidates()] == [shared]


def test_the_folders_are_the_same_in_every_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    places = estop.list_candidates()
    monkeypatch.setenv("XDG_RUNTIME_DIR", "/elsewhere")
    monkeypatch.setenv("TMPDIR", "/elsewhere")
    assert estop.list_candidates() == places
