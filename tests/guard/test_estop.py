"""An emergency stop from another terminal, over a real pty with the emulator in another process."""

from __future__ import annotations

import contextlib
import errno
import os
import re
import socket
import stat
import subprocess
import sys
import tempfile
import threading
import time
import warnings
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from board_like import LikeABoard
from serial_tools import (
    DRIVER,
    TIMEOUT,
    Emulated,
    RobotFile,
    StartEmulator,
    first_line,
    no_leak,
    program,
    wait_until,
)

from acsar_gym import Robot, RobotConfig
from acsar_gym.__main__ import main
from acsar_gym.errors import EmergencyStopError, SafetyWarning
from acsar_gym.guard import estop
from acsar_gym.links import open_link
from acsar_gym.protocol import ZERO, Decoder
from acsar_gym.safety.rules import Reason
from acsar_gym.tools.commission import checks as doctor
from acsar_gym.worlds import Scene

ACSAR = RobotConfig.preset("acsar")
pytestmark = pytest.mark.usefixtures("deadline", "place")


DRIVING = """
import sys
from acsar_gym.tools.cli import main
sys.argv = ["acsar-gym", *sys.argv[1:]]
main()
"""


@contextlib.contextmanager
def answering_all(listeners: list[estop.StopListener]) -> Iterator[None]:
    """A control loop that heeds the stops of all of them."""
    ended = threading.Event()

    def loop() -> None:
        while not ended.is_set():
            for listener in listeners:
                if listener.is_requested():
                    listener.confirm()
            time.sleep(0.001)

    thread = threading.Thread(target=loop, daemon=True)
    thread.start()
    yield
    ended.set()
    thread.join()


def estop_command(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, *arguments: str
) -> tuple[object, str, str]:
    """`acsar-gym estop ARGUMENTS`: exit code, output, errors."""
    monkeypatch.setattr(sys, "argv", ["acsar-gym", "estop", *arguments])
    with pytest.raises(SystemExit) as ended:
        main()
    return ended.value.code, *capsys.readouterr()


@pytest.fixture
def place(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder of this test alone, with time to answer; paths of sockets must be short."""
    monkeypatch.setattr(estop, "ANSWER_TIMEOUT", TIMEOUT)
    with tempfile.TemporaryDirectory(prefix="acsar-", dir="/tmp") as base:
        monkeypatch.setenv("ACSAR_GYM_RUNTIME_DIR", base)
        yield Path(base)


def folder() -> Path:
    """Where the sockets of this test are."""
    (usable,), wrong = estop.find_folders()
    assert not wrong
    return usable


@pytest.mark.parametrize(
    "command",
    [
        ("drive", "--linear", "0.2", "--link"),
        ("run", "3", "0", "--yes", "--link"),
        ("doctor", "--spin", "--yes"),
    ],
    ids=lambda command: command[0],
)
def test_the_command_stops_a_robot_that_another_process_drives(
    command: tuple[str, ...],
    emulator: Emulated,
    robot_file: RobotFile,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for _ in range(3):  # where the machine stalls, a check of doctor fails before it drives
        with program(DRIVING, *command, emulator.device, "--robot", str(robot_file())) as process:

            def is_driven_or_over(process: subprocess.Popen[str] = process) -> bool:
                return emulator.is_driven() or process.poll() is not None

            wait_until(is_driven_or_over, "a command that turns the wheels")
            if process.poll() is None:
                done = estop_command(capsys, monkeypatch)
                assert done == (0, f"process {process.pid}: stopped\n", "")
                said = process.communicate(timeout=TIMEOUT)
                break
    assert process.returncode == 3
    assert "emergency stop" in "".join(said)
    wait_until(emulator.is_stopped, "zero as the newest command")


def test_without_a_robot_the_command_says_so(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ((), ("rob",)):
        code, output, error = estop_command(capsys, monkeypatch, *name)
        assert (code, error) == (1, "")
        assert output == (
            "you drive no robot from this computer; "
            "'sudo -u USER acsar-gym estop' stops what another user drives\n"
        )


def test_sockets_belong_to_their_owner_alone(config: RobotConfig, shared_device: str) -> None:
    """And simulated robots have none."""
    with Robot(open_link("planar", config), config):
        assert not list(folder().iterdir())
    Robot(open_link(shared_device, config), config).close()  # what a first one opens stays open
    with no_leak():
        robot = Robot(open_link(shared_device, config), config)
        robot.activate()
        (path,) = folder().iterdir()
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
        assert stat.S_IMODE(path.parent.stat().st_mode) == 0o700
        robot.close()
        assert not list(folder().iterdir())


def socket_at(name: str) -> socket.socket:
    """The socket of a process that drives, or has driven."""
    heard = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    heard.bind(str(folder() / name))
    return heard


def test_the_socket_of_a_dead_process_is_forgotten() -> None:
    socket_at("99999999-1").close()
    assert estop.stop_all() == []
    assert not (folder() / "99999999-1").exists()


ROBOTS = 4


def look_for_dead_ones() -> None:
    """Remove the sockets of dead processes, as each stop does, without stopping anybody."""
    for path in estop._find_sockets(folder()):
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as asker:
            asker.setblocking(False)
            estop._send_request(asker, path, b"go on", {})


def test_robots_made_at_one_moment_all_hear_a_stop() -> None:
    """In two rounds of three, others stop robots meanwhile, and remove what dead ones have left."""
    for number in range(9):
        barrier, ended = threading.Barrier(ROBOTS + 1, timeout=TIMEOUT), threading.Event()
        robots: list[Robot] = []

        def drive(barrier: threading.Barrier, ended: threading.Event, robots: list[Robot]) -> None:
            robot = Robot(LikeABoard(open_link("planar", ACSAR)), ACSAR)
            barrier.wait()
            with robot:
                robots.append(robot)
                barrier.wait()
                while not ended.is_set():
                    robot.drive(0.2, 0.0)

        with ThreadPoolExecutor(ROBOTS) as pool, contextlib.ExitStack() as at_end:
            at_end.callback(ended.set)
            drives = [pool.submit(drive, barrier, ended, robots) for _ in range(ROBOTS)]
            barrier.wait()
            for _ in range(number % 3):
                look_for_dead_ones()
            barrier.wait()
            assert len(list(folder().iterdir())) == ROBOTS
            assert estop.stop_all() == [estop.StopResult(os.getpid(), answered=True)] * ROBOTS
            assert all(robot.safety.stopped for robot in robots)
            ended.set()
            for one in drives:
                one.result(TIMEOUT)
        estop.release_process()
        assert not list(folder().iterdir())


def test_where_no_socket_can_be_opened_a_robot_drives_without(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def fail(path: Path) -> socket.socket:
        raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))

    monkeypatch.setattr(estop, "_bind_socket", fail)
    listener = estop.StopListener()
    assert f"{folder()}/{os.getpid()}-" in listener.unavailable
    assert "Too many open files: close robots" in listener.unavailable
    assert not listener.is_requested()
    listener.close()


@pytest.fixture
def two(place: Path) -> Iterator[list[estop.StopListener]]:
    """The listeners of two robots, with a control loop that answers for both."""
    listeners = [estop.StopListener("/dev/ttyUSB7", "rover"), estop.StopListener("usb:A50285BI")]
    with answering_all(listeners):
        yield listeners
    for listener in listeners:
        listener.close()


@pytest.mark.parametrize(
    ("name", "count"),
    [
        ("/dev/ttyUSB7", 1),
        ("ttyUSB7", 1),
        ("rover", 1),
        ("usb:A50285BI", 1),
        pytest.param(str(os.getpid()), 2, id="pid"),
        ("", 2),
        ("/dev/ttyUSB8", 0),
        ("stop", 0),
    ],
)
def test_one_robot_can_be_named(name: str, count: int, two: list[estop.StopListener]) -> None:
    assert estop.stop_all(name) == [estop.StopResult(os.getpid(), answered=True)] * count


def test_a_name_that_nobody_has_lists_those_that_there_are(
    two: list[estop.StopListener],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    code, output, error = estop_command(capsys, monkeypatch, "rob\x1b9")
    assert (code, error) == (1, "")
    assert "no robot rob\\x1b9 is being driven" in output
    assert f"/dev/ttyUSB7 (rover): process {os.getpid()}, since 2" in output
    assert f"usb:A50285BI: process {os.getpid()}, since 2" in output


def test_listeners_are_listed_and_not_stopped(
    two: list[estop.StopListener],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    code, output, _ = estop_command(capsys, monkeypatch, "--list")
    assert (code, len(output.splitlines())) == (0, 2)
    first, second = estop.list_drivers()
    assert {first.device, second.device} == {"/dev/ttyUSB7", "usb:A50285BI"}
    assert abs(first.since - time.time()) < TIMEOUT


INSISTING = f"""
{DRIVER}
from acsar_gym.errors import LinkError

print("begins", flush=True)
while True:
    try:
        robot.activate()
        drive(1)
    except LinkError as error:
        robot.deactivate()
        print(type(error).__name__, flush=True)
"""
"""Drives on after whatever went wrong."""
LEARNING = f"""
{DRIVER}
import gymnasium
from acsar_gym.errors import EmergencyStopError, LinkError, SafetyWarning

def make():
    return gymnasium.make(
        "acsar_gym/PointGoal-v0", link=sys.argv[1], robot=config, max_episode_steps=3
    )

env = make()
print("begins", flush=True)
while True:
    try:
        env.reset()
        done = False
        while not done:
            *_, terminated, truncated, _ = env.step((0.3, 0.0))
            done = terminated or truncated
    except EmergencyStopError as error:
        print(type(error).__name__, flush=True)
        env.close()
        env = make()
"""
"""A training loop that begins episodes for ever, with a new env after each error."""


def turning(data: bytes) -> list[object]:
    """The commands that turn wheels."""
    return [reading for reading in Decoder().feed(data) if reading.speeds != ZERO]


def test_a_stop_while_the_cable_is_out_holds_when_it_is_in_again(
    start_emulator: StartEmulator, place: Path
) -> None:
    emulator = start_emulator("--name", str(place / "robot"))
    with program(INSISTING, str(place / "robot")) as process:
        wait_until(emulator.is_driven, "a command that turns the wheels")
        assert first_line(process) == "begins"
        emulator.pull()
        assert first_line(process) == "LinkLostError"
        assert estop.stop_all() == [
            estop.StopResult(process.pid, answered=True, connected=False)
        ]  # by the program that waits for the device to come back
        assert first_line(process) == "EmergencyStopError"
        emulator.plug()
        for _ in range(20):
            assert first_line(process) == "EmergencyStopError"
        assert turning(emulator.since_plugged()) == []
        released = estop.ReleaseResult(process.pid, answered=True, was_stopped=True)
        assert estop.release_all() == [released]
        wait_until(emulator.is_driven, "a command that turns the wheels")


@pytest.mark.parametrize("code", [INSISTING, LEARNING], ids=["robot", "env"])
def test_no_reset_undoes_a_stop_and_a_release_does(
    code: str, start_emulator: StartEmulator, place: Path
) -> None:
    device = str(place / "robot")
    emulator = start_emulator("--name", device)
    with program(code, device) as process:
        assert first_line(process) == "begins"
        wait_until(emulator.is_driven, "a command that turns the wheels")
        assert estop.stop_all() == [estop.StopResult(process.pid, answered=True)]
        wait_until(emulator.is_stopped, "zero as the newest command")
        before = len(turning(emulator.received()))
        if code == LEARNING:
            for _ in range(5):
                assert first_line(process) == "EmergencyStopError"
        emulator.pull()
        for _ in range(5):
            assert "Error" in first_line(process)
        emulator.plug()
        for _ in range(20):
            assert first_line(process) == "EmergencyStopError"
        assert len(turning(emulator.received())) == before
        (released,) = estop.release_all("robot")
        assert released == estop.ReleaseResult(process.pid, answered=True, was_stopped=True)
        wait_until(emulator.is_driven, "a command that turns the wheels")


def test_the_command_releases(
    two: list[estop.StopListener],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert estop.stop_all("rover")[0].answered
    one = f"process {os.getpid()}"
    for arguments, said in (
        (("--release", "usb:A50285BI"), f"{one}: wasn't stopped\n"),
        (("--release", "rover"), f"{one}: released: it drives after its next reset\n"),
        (("rover", "--release"), f"{one}: wasn't stopped\n"),
    ):
        assert estop_command(capsys, monkeypatch, *arguments) == (0, said, "")
    code, output, _ = estop_command(capsys, monkeypatch, "--release", "rob9")
    assert (code, output.splitlines()[0]) == (
        1,
        "no robot rob9 is being driven from this computer; these are:",
    )


def test_a_stop_of_one_robot_holds_its_process_until_that_one_is_released(
    two: list[estop.StopListener],
) -> None:
    estop.check_released()
    assert estop.stop_all("rover")[0].answered
    with pytest.raises(EmergencyStopError):
        estop.check_released()
    estop.release_all("usb:A50285BI")
    with pytest.raises(EmergencyStopError):
        estop.check_released()
    estop.release_all("rover")
    estop.check_released()


def test_a_stop_that_was_not_read_holds_after_the_robot_is_closed(
    config: RobotConfig, shared_device: str
) -> None:
    with no_leak():
        robot = Robot(open_link(shared_device, config), config)
        robot.activate()
        (path,) = folder().iterdir()
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as other:
            other.sendto(b"stop", str(path))
        robot.close()
        another = Robot(open_link(shared_device, config), config)
        with pytest.raises(EmergencyStopError):
            another.activate()
        another.close()
        with ThreadPoolExecutor(1) as person:
            found = person.submit(estop.release_all)
            while not found.done():
                with contextlib.suppress(EmergencyStopError):
                    estop.check_released()
            assert [each.was_stopped for each in found.result()] == [True]
        with another:
            another.drive(0.0, 0.0)
        assert not list(folder().iterdir())


def test_a_stop_by_the_program_itself_is_released_by_name(
    config: RobotConfig, shared_device: str
) -> None:
    robot = Robot(open_link(shared_device, config), config)
    robot.estop()
    with pytest.raises(EmergencyStopError):
        robot.activate()
    robot.release_estop()
    robot.activate()
    robot.estop()
    robot.release_estop()
    robot.drive(0.3, 0.0)
    assert robot.safety.reason is Reason.EMERGENCY_STOP  # nothing turns before a reset
    robot.reset(Scene())
    robot.drive(0.3, 0.0)
    assert robot.safety.reason is not Reason.EMERGENCY_STOP
    robot.close()


BAD_FOLDERS = {
    "too open": lambda path: path.mkdir(mode=0o755),
    "a link": lambda path: path.symlink_to("/tmp"),  # noqa: S108
    "a file": lambda path: path.write_text(""),
}


@pytest.mark.parametrize("kind", BAD_FOLDERS)
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
    BAD_FOLDERS[kind](path)
    robot = Robot(open_link(shared_device, config), config)
    with no_leak():
        with pytest.warns(SafetyWarning, match=f"can't stop this robot: {path}") as told:
            robot.activate()
        assert len(told) == 1
        robot.drive(0.0, 0.0)
        robot.deactivate()
        other = Robot(open_link(shared_device, config), config)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            with pytest.raises(SafetyWarning):
                other.activate()
        assert not other.active
    check = doctor.check_estop()
    assert check.status == "warn"
    assert str(path) in check.found
    assert check.fix
    code, output, error = estop_command(capsys, monkeypatch)
    assert (code, output) == (3, "")
    assert re.fullmatch(f"acsar-gym: {path}: .*\n", error)


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
    with answering_all([listener]):
        assert estop.stop_all() == [estop.StopResult(os.getpid(), answered=True)]
    assert doctor.check_estop().status == "ok"
    listener.close()


def test_a_session_that_others_can_write_to_is_not_used(usual: tuple[Path, Path]) -> None:
    session, shared = usual
    session.chmod(0o777)
    assert [path.parent for path in estop.list_candidates()] == [shared]
