"""An emergency stop from another terminal, over a real pty with the emulator in another process."""

from __future__ import annotations

import contextlib
import os
import re
import socket
import stat
import subprocess
import sys
import tempfile
import threading
import warnings
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from boards import LikeABoard
from processes import first_line, program
from serial_tools import (
    CLI,
    DRIVER,
    TIMEOUT,
    Emulated,
    RobotFile,
    StartEmulator,
    no_leak,
    wait_until,
)

from acsar_gym import Robot, RobotConfig
from acsar_gym.__main__ import main
from acsar_gym.errors import EmergencyStopError, SafetyWarning
from acsar_gym.guard import estop
from acsar_gym.guard.estop import Answer, StopListener
from acsar_gym.links import open_link
from acsar_gym.protocol import ZERO, Decoder
from acsar_gym.tools.commission import checks

ACSAR = RobotConfig.preset("acsar")
pytestmark = pytest.mark.usefixtures("deadline")


@pytest.fixture(autouse=True)
def folder(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The folder of this test's sockets, with a short path, and time to answer."""
    monkeypatch.setattr(estop, "ANSWER_TIMEOUT", TIMEOUT)
    with tempfile.TemporaryDirectory(prefix="acsar-", dir="/tmp") as base:
        monkeypatch.setenv("ACSAR_GYM_RUNTIME_DIR", base)
        yield Path(base, f"acsar_gym-{os.getuid()}")


def run(*words: str) -> subprocess.CompletedProcess[str]:
    """Run `acsar-gym WORDS`."""
    return subprocess.run([*CLI, *words], capture_output=True, text=True, check=False)


@pytest.mark.parametrize("command", ["drive --linear 0.2 --link", "run 3 0 --yes --link"])
def test_estop_stops_a_robot_of_another_process(
    command: str, emulator: Emulated, robot_file: RobotFile
) -> None:
    words = (*command.split(), emulator.device, "--robot", str(robot_file()))
    with ThreadPoolExecutor(1) as pool:
        drive = pool.submit(run, *words)
        wait_until(emulator.is_driven, "a command that turns the wheels")
        stop = run("estop")
        assert re.fullmatch(r"process \d+: stopped\n", stop.stdout)
        assert stop.returncode == 0
        assert drive.result().returncode == 3
    assert "emergency stop" in drive.result().stderr
    wait_until(emulator.is_stopped, "zero as the newest command")


def test_estop_without_a_robot() -> None:
    result = run("estop")
    assert result.returncode == 1
    assert result.stdout.startswith("no robot of yours is being driven")
    assert run("estop", "--list").returncode == 2


def test_estop_reports_a_folder_whose_path_is_too_long(monkeypatch: pytest.MonkeyPatch) -> None:
    base = os.environ["ACSAR_GYM_RUNTIME_DIR"]
    monkeypatch.setenv("ACSAR_GYM_RUNTIME_DIR", f"{base}/{'x' * 120}")
    result = run("estop")
    assert result.returncode == 3
    assert "path too long: set ACSAR_GYM_RUNTIME_DIR" in result.stderr


def test_socket_is_shared_and_only_its_owner_can_use_it(folder: Path) -> None:
    """Simulated robots have no socket."""
    with Robot(open_link("planar", ACSAR), ACSAR):
        assert not folder.exists()
    with no_leak():
        robots = [Robot(LikeABoard(open_link("planar", ACSAR)), ACSAR) for _ in range(2)]
        with robots[0], robots[1]:
            (path,) = folder.iterdir()
            assert path.is_socket()
            assert stat.S_IMODE(folder.stat().st_mode) == 0o700
        assert not list(folder.iterdir())


def test_socket_is_closed_if_the_robot_is_dropped(folder: Path) -> None:
    """No loop reads it any more, and `acsar-gym estop` would wait for an answer."""
    listener = StopListener()
    assert len(list(folder.iterdir())) == 1
    del listener
    assert not list(folder.iterdir())
    assert estop.stop_all() == []


def test_stop_that_was_not_read_holds_after_the_robot_was_dropped(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(estop, "ANSWER_TIMEOUT", 0.05)
    listener = StopListener()
    estop.stop_all()
    del listener
    assert estop.is_held()
    assert len(list(folder.iterdir())) == 1, "the release must reach the process"


def test_estop_with_a_wrong_word_stops_the_robots(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(estop, "ANSWER_TIMEOUT", 0.05)
    monkeypatch.setattr(sys, "argv", ["acsar-gym", "estop", "/dev/ttyUSB0"])
    with contextlib.closing(StopListener()) as listener:
        with pytest.raises(SystemExit) as ended:
            main()
        assert ended.value.code == 2
        assert "/dev/ttyUSB0" in capsys.readouterr().err
        listener.is_requested()  # reads what has arrived
        assert estop.is_held()


def test_socket_of_a_dead_process_is_removed() -> None:
    path = estop.make_folder() / "99999999-a1"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as dead:
        dead.bind(str(path))
    assert estop.stop_all() == []
    assert path.exists(), "it may be about to listen"
    os.utime(path, (0.0, 0.0))
    assert estop.stop_all() == []
    assert not path.exists()


LISTENING = """
from acsar_gym.guard.estop import StopListener
listener = StopListener()
listener.connect()
print("listens", flush=True)
while not listener.is_requested():
    pass
listener.confirm()
"""


def test_estop_stops_all_processes() -> None:
    with program(LISTENING) as first, program(LISTENING) as second:
        assert first_line(first) == first_line(second) == "listens"
        processes = sorted([first.pid, second.pid])
        assert estop.stop_all() == [Answer(process, b"stopped") for process in processes]


def test_estop_answer_waits_for_space_in_a_full_queue(folder: Path) -> None:
    """It has space for ten answers, and more robots may answer at once."""
    listener = StopListener()
    (path,) = folder.iterdir()
    with contextlib.closing(estop._bind_socket("estop")) as asker:
        asker.sendto(estop.STOP, str(path))
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as other:
            other.setblocking(False)
            with contextlib.suppress(BlockingIOError):
                while True:
                    other.sendto(b"of another robot", asker.getsockname())

        # The queue is full, so that the answer is sent later.
        listener.is_requested()
        answers = set()
        with contextlib.suppress(BlockingIOError):
            while True:
                answers.add(asker.recv(estop.MAX_REQUEST_BYTES))
        assert answers == {b"of another robot"}
        listener.is_requested()
        assert asker.recv(estop.MAX_REQUEST_BYTES) == estop.HELD
    listener.close()


def test_estop_reports_a_process_that_does_not_read_the_request(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(estop, "ANSWER_TIMEOUT", 0.05)
    listener = StopListener()
    assert estop.run_command() == 1
    assert f"process {os.getpid()}: no reply: " in capsys.readouterr().out
    with pytest.raises(EmergencyStopError):
        estop.check_released()
    listener.close()


def test_estop_stops_robots_of_threads(folder: Path) -> None:
    over = threading.Event()
    robots = [Robot(LikeABoard(open_link("planar", ACSAR)), ACSAR) for _ in range(4)]

    def drive(robot: Robot) -> None:
        with robot:
            while not over.is_set():
                robot.drive(0.2, 0.0)

    with ThreadPoolExecutor(len(robots)) as pool, contextlib.ExitStack() as stack:
        stack.callback(over.set)
        drives = pool.map(drive, robots)
        wait_until(lambda: all(robot.odometry.pose[0] for robot in robots), "robots that drive")
        assert estop.stop_all() == [Answer(os.getpid(), b"stopped")]
        assert all(robot.safety.stopped for robot in robots)
    list(drives)
    estop.release_process()
    assert not list(folder.iterdir())


def test_estop_answer_waits_for_every_connected_robot() -> None:
    first = StopListener()
    second = StopListener()
    first.connect()
    second.connect()

    with ThreadPoolExecutor(1) as pool:
        answers = pool.submit(estop.stop_all)
        wait_until(first.is_requested, "a request")
        first.confirm()
        assert not first.is_requested()
        assert second.is_requested()
        assert not answers.done()
        second.confirm()
        assert answers.result() == [Answer(os.getpid(), b"stopped")]
    first.close()
    second.close()


def test_estop_that_was_not_read_holds_after_the_robot_is_closed(folder: Path) -> None:
    listener = StopListener()
    (path,) = folder.iterdir()
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as asker:
        asker.sendto(b"stop", str(path))
    listener.close()
    with pytest.raises(EmergencyStopError):
        estop.check_released()
    listener = StopListener()
    listener.connect()
    assert listener.is_requested(), "if it connects all the same"
    listener.close()


def test_estop_holds_a_forked_child(folder: Path) -> None:
    listener = StopListener()
    estop.hold_process()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # threads of libraries don't matter
        child = os.fork()
    if child == 0:
        listener.close()
        os._exit(estop.is_held())
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 1
    assert len(list(folder.iterdir())) == 1
    estop.release_process()
    listener.close()


def test_estop_stops_a_robot_that_a_forked_child_connects_again(folder: Path) -> None:
    """The child has a copy of a robot that listened in its parent."""
    listener = StopListener()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        child = os.fork()
    if child == 0:
        with contextlib.suppress(BaseException):
            listener.connect()
            wait_until(listener.is_requested, "a stop")
            listener.confirm()
        os._exit(0)

    listener.close()
    wait_until(lambda: any(folder.iterdir()), "the child's socket")
    assert estop.stop_all() == [Answer(child, b"stopped")]
    os.waitpid(child, 0)


INSISTING = f"""
{DRIVER}
from acsar_gym.errors import EmergencyStopError, LinkError

while True:
    try:
        robot.activate()
        drive(1)
    except LinkError as error:
        print(type(error).__name__, flush=True)
        if isinstance(error, EmergencyStopError):
            robot.close()
            robot = Robot(open_link(sys.argv[1], config), config)
"""
"""Drives on after every error, and after a stop with a new robot."""


def count_drives(data: bytes) -> int:
    """Count the commands that turn wheels."""
    return sum(reading.speeds != ZERO for reading in Decoder().feed(data))


@pytest.mark.parametrize("is_plugged", [True, False])
def test_estop_holds_until_a_person_releases_it(
    is_plugged: bool, start_emulator: StartEmulator, tmp_path: Path
) -> None:
    """Also a stop that comes while the cable is out, when it is in again."""
    device = str(tmp_path / "robot")
    emulator = start_emulator("--name", device)
    with program(INSISTING, device) as process:
        wait_until(emulator.is_driven, "a command that turns the wheels")
        if is_plugged:
            assert estop.stop_all() == [Answer(process.pid, b"stopped")]
            emulator.pull()
        else:
            emulator.pull()
            assert first_line(process) == "LinkLostError"
            assert estop.stop_all() == [Answer(process.pid, b"held")]

        drives = count_drives(emulator.received())
        emulator.plug()
        while first_line(process) != "EmergencyStopError":
            pass
        for _ in range(20):
            assert first_line(process) == "EmergencyStopError"
        assert count_drives(emulator.received()) == drives
        assert estop.release_all() == [Answer(process.pid, b"released")]
        wait_until(emulator.is_driven, "a command that turns the wheels")


@pytest.mark.parametrize("is_public", [True, False])
def test_folder_that_cannot_be_trusted_is_reported(
    is_public: bool, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """By a warning at activation, by the doctor, and by the command."""
    if is_public:
        folder.mkdir(mode=0o755)
    else:
        folder.symlink_to("/tmp")  # noqa: S108
    with (
        pytest.warns(SafetyWarning, match=f"can't stop this robot: {folder}"),
        Robot(LikeABoard(open_link("planar", ACSAR)), ACSAR) as robot,
    ):
        robot.drive(0.0, 0.0)

    check = checks.check_estop()
    assert check.status == "warn"
    assert str(folder) in check.found
    assert estop.run_command() == 3
    assert re.fullmatch(f"acsar-gym: {folder}: .*\n", capsys.readouterr().err)
