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
import time
import warnings
from collections.abc import Callable, Iterator
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
from acsar_gym.guard.estop import Answer, StopListener
from acsar_gym.links import open_link
from acsar_gym.protocol import ZERO, Decoder
from acsar_gym.safety.rules import Reason
from acsar_gym.tools.commission import checks
from acsar_gym.worlds import Scene

ACSAR = RobotConfig.preset("acsar")
pytestmark = pytest.mark.usefixtures("deadline", "folder")

COMMAND = """
import sys
from acsar_gym.tools.cli import main
sys.argv = ["acsar-gym", *sys.argv[1:]]
main()
"""
Estop = Callable[..., tuple[object, str, str]]


@pytest.fixture(autouse=True)
def folder(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The folder of this test's sockets, and time to answer; paths of sockets must be short."""
    monkeypatch.setattr(estop, "ANSWER_TIMEOUT", TIMEOUT)
    with tempfile.TemporaryDirectory(prefix="acsar-", dir="/tmp") as base:
        monkeypatch.setenv("ACSAR_GYM_RUNTIME_DIR", base)
        yield Path(base, f"acsar_gym-{os.getuid()}")


@pytest.fixture
def run_estop(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Estop:
    """`run_estop(*arguments)` runs `acsar-gym estop`: exit code, output, errors."""

    def run(*arguments: str) -> tuple[object, str, str]:
        monkeypatch.setattr(sys, "argv", ["acsar-gym", "estop", *arguments])
        with pytest.raises(SystemExit) as caught:
            main()
        return caught.value.code, *capsys.readouterr()

    return run


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
    command: tuple[str, ...], emulator: Emulated, robot_file: RobotFile, run_estop: Estop
) -> None:
    for _ in range(3):  # if the machine stalls, a check of doctor fails before it drives
        with program(COMMAND, *command, emulator.device, "--robot", str(robot_file())) as process:

            def is_driven_or_over(process: subprocess.Popen[str] = process) -> bool:
                return emulator.is_driven() or process.poll() is not None

            wait_until(is_driven_or_over, "a command that turns the wheels")
            if process.poll() is None:
                assert run_estop() == (0, f"process {process.pid}: stopped\n", "")
                output = process.communicate(timeout=TIMEOUT)
                break
    assert process.returncode == 3
    assert "emergency stop" in "".join(output)
    wait_until(emulator.is_stopped, "zero as the newest command")


def test_without_a_robot_the_command_reports_that(run_estop: Estop) -> None:
    for arguments in ((), ("--release",)):
        code, output, error = run_estop(*arguments)
        assert (code, error) == (1, "")
        assert output.startswith("no robot of yours is being driven from this computer")


def test_an_unknown_option_is_refused(run_estop: Estop) -> None:
    assert run_estop("--list")[0] == 2


def test_the_robots_of_a_process_share_a_socket_that_only_its_owner_can_use(
    folder: Path, config: RobotConfig, shared_device: str
) -> None:
    """Simulated robots have no socket."""
    with Robot(open_link("planar", config), config):
        assert not folder.exists()
    Robot(open_link(shared_device, config), config).close()  # opens what stays open
    with no_leak():
        robots = [Robot(LikeABoard(open_link("planar", ACSAR)), ACSAR) for _ in range(2)]
        with robots[0], robots[1]:
            (path,) = folder.iterdir()
            assert path.is_socket()
            assert stat.S_IMODE(folder.stat().st_mode) == 0o700
        assert folder.exists()
        assert not list(folder.iterdir())


def test_the_socket_of_a_dead_process_is_removed(folder: Path) -> None:
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


def test_all_processes_are_stopped() -> None:
    with program(LISTENING) as first, program(LISTENING) as second:
        assert first_line(first) == first_line(second) == "listens"
        processes = sorted([first.pid, second.pid])
        assert estop.stop_all() == [Answer(process, b"stopped") for process in processes]


def test_a_process_that_does_not_read_the_request_is_reported(
    run_estop: Estop, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(estop, "ANSWER_TIMEOUT", 0.05)
    listener = StopListener()
    code, output, _ = run_estop()
    assert code == 1
    assert f"process {os.getpid()}: no reply: " in output
    with pytest.raises(EmergencyStopError):
        estop.check_released()
    listener.close()


def test_robots_that_threads_start_at_the_same_time_all_stop(folder: Path) -> None:
    barrier = threading.Barrier(5, timeout=TIMEOUT)
    over = threading.Event()
    robots = [Robot(LikeABoard(open_link("planar", ACSAR)), ACSAR) for _ in range(4)]

    def drive(robot: Robot) -> None:
        with robot:
            barrier.wait()
            while not over.is_set():
                robot.drive(0.2, 0.0)

    with ThreadPoolExecutor(len(robots)) as pool:
        drives = [pool.submit(drive, robot) for robot in robots]
        barrier.wait()
        assert estop.stop_all() == [Answer(os.getpid(), b"stopped")]
        assert all(robot.safety.stopped for robot in robots)
        over.set()
        for future in drives:
            future.result(TIMEOUT)
    estop.release_process()
    assert not list(folder.iterdir())


@pytest.fixture
def asker(folder: Path) -> Iterator[socket.socket]:
    """A socket that sends requests, one at a time, and receives the answers."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as asker:
        asker.bind(str(estop.make_folder() / "asker"))
        asker.setblocking(False)
        yield asker


def send(asker: socket.socket, request: bytes, folder: Path) -> None:
    (path,) = [path for path in folder.iterdir() if path.name != "asker"]
    asker.sendto(request, str(path))


def test_the_answer_waits_for_every_connected_robot(asker: socket.socket, folder: Path) -> None:
    first = StopListener()
    second = StopListener()
    idle = StopListener()
    first.connect()
    second.connect()
    send(asker, b"stop", folder)
    assert first.is_requested()
    first.confirm()
    assert not first.is_requested()
    assert second.is_requested()
    assert not idle.is_requested()
    with pytest.raises(BlockingIOError):
        asker.recv(64)
    second.confirm()
    assert asker.recv(64) == b"stopped"
    for listener in (first, second, idle):
        listener.close()


def test_a_robot_whose_connection_fails_does_not_count_as_stopped(
    asker: socket.socket, folder: Path
) -> None:
    listener = StopListener()
    listener.connect()
    send(asker, b"stop", folder)
    assert listener.is_requested()
    listener.disconnect()
    assert asker.recv(64) == b"held"
    listener.connect()
    assert listener.is_requested(), "the process is still held"
    listener.close()


def test_a_forked_child_is_held_and_leaves_the_socket_alone(folder: Path) -> None:
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


INSISTING = f"""
{DRIVER}
from acsar_gym.errors import LinkError

print("starts", flush=True)
while True:
    try:
        robot.activate()
        drive(1)
    except LinkError as error:
        robot.deactivate()
        print(type(error).__name__, flush=True)
"""
"""Drives on after every error."""
LEARNING = f"""
{DRIVER}
import gymnasium
from acsar_gym.errors import EmergencyStopError

def make():
    return gymnasium.make(
        "acsar_gym/PointGoal-v0", link=sys.argv[1], robot=config, max_episode_steps=3
    )

env = make()
print("starts", flush=True)
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
"""A training loop that starts episodes for ever, with a new env after each error."""


def count_drives(data: bytes) -> int:
    """Count the commands that turn wheels."""
    return sum(reading.speeds != ZERO for reading in Decoder().feed(data))


def test_a_stop_while_the_cable_is_out_holds_when_it_is_in_again(
    start_emulator: StartEmulator, tmp_path: Path
) -> None:
    device = str(tmp_path / "robot")
    emulator = start_emulator("--name", device)
    with program(INSISTING, device) as process:
        wait_until(emulator.is_driven, "a command that turns the wheels")
        assert first_line(process) == "starts"
        emulator.pull()
        assert first_line(process) == "LinkLostError"
        assert estop.stop_all() == [Answer(process.pid, b"held")]
        assert first_line(process) == "EmergencyStopError"
        emulator.plug()
        for _ in range(20):
            assert first_line(process) == "EmergencyStopError"
        assert count_drives(emulator.since_plugged()) == 0
        assert estop.release_all() == [Answer(process.pid, b"released")]
        wait_until(emulator.is_driven, "a command that turns the wheels")


@pytest.mark.parametrize("code", [INSISTING, LEARNING], ids=["robot", "env"])
def test_no_reset_undoes_a_stop_and_a_release_does(
    code: str, start_emulator: StartEmulator, tmp_path: Path
) -> None:
    device = str(tmp_path / "robot")
    emulator = start_emulator("--name", device)
    with program(code, device) as process:
        assert first_line(process) == "starts"
        wait_until(emulator.is_driven, "a command that turns the wheels")
        assert estop.stop_all() == [Answer(process.pid, b"stopped")]
        wait_until(emulator.is_stopped, "zero as the newest command")
        drives = count_drives(emulator.received())
        emulator.pull()
        for _ in range(5):
            assert "Error" in first_line(process)
        emulator.plug()
        for _ in range(20):
            assert first_line(process) == "EmergencyStopError"
        assert count_drives(emulator.received()) == drives
        assert estop.release_all() == [Answer(process.pid, b"released")]
        wait_until(emulator.is_driven, "a command that turns the wheels")


def test_a_stop_that_was_not_read_holds_after_the_robot_is_closed(
    asker: socket.socket, folder: Path, run_estop: Estop
) -> None:
    robot = Robot(LikeABoard(open_link("planar", ACSAR)), ACSAR)
    robot.activate()
    send(asker, b"stop", folder)
    robot.close()
    with pytest.raises(EmergencyStopError):
        robot.activate()

    over = threading.Event()

    def insist() -> None:
        while not over.is_set():
            with contextlib.suppress(EmergencyStopError):
                estop.check_released()
            time.sleep(0.001)

    thread = threading.Thread(target=insist)
    thread.start()
    report = f"process {os.getpid()}: released: it drives after its next reset\n"
    assert run_estop("--release") == (0, report, "")
    over.set()
    thread.join()
    with robot:
        robot.drive(0.0, 0.0)


def test_a_stop_by_the_program_itself_is_released_by_a_call(
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
def test_a_folder_that_cannot_be_trusted_is_reported(
    kind: str, folder: Path, config: RobotConfig, shared_device: str, run_estop: Estop
) -> None:
    """By a warning at activation, by the doctor, and by the command."""
    BAD_FOLDERS[kind](folder)
    robot = Robot(open_link(shared_device, config), config)
    with no_leak():
        with pytest.warns(SafetyWarning, match=f"can't stop this robot: {folder}") as caught:
            robot.activate()
        assert len(caught) == 1
        robot.drive(0.0, 0.0)
        robot.close()
    check = checks.check_estop()
    assert check.status == "warn"
    assert str(folder) in check.found
    assert check.fix
    code, output, error = run_estop()
    assert (code, output) == (3, "")
    assert re.fullmatch(f"acsar-gym: {folder}: .*\n", error)
