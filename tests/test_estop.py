"""An emergency stop from another terminal, over a real pty with the emulator in another process."""

from __future__ import annotations

import os
import socket
import stat
from pathlib import Path

import pytest
from serial_tools import TIMEOUT, Emulated, RobotFile, cli, no_leak, program, wait_until

from acsar_gym import Robot, RobotConfig, estop
from acsar_gym.errors import LinkError
from acsar_gym.links import open_link
from acsar_gym.protocol import ZERO
from acsar_gym.safety import Reason

DRIVING = """
import sys
from acsar_gym.cli import main
sys.argv = ["acsar-gym", *sys.argv[1:]]
main()
"""


@pytest.fixture(autouse=True)
def own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Sockets of this test alone; paths of sockets must be short."""
    place = Path("/tmp") / f"acsar-test-{os.getpid()}"  # noqa: S108
    place.mkdir(exist_ok=True)
    monkeypatch.setenv("ACSAR_GYM_RUNTIME_DIR", str(place))
    return place


def test_the_command_stops_a_robot_that_another_process_drives(
    emulator: Emulated, robot_file: RobotFile
) -> None:
    options = ("--link", emulator.device, "--linear", "0.2", "--robot", str(robot_file()))
    with program(DRIVING, "drive", *options) as process:
        wait_until(emulator.is_driven, "a command that turns the wheels")
        done = cli("estop")
        assert (done.returncode, done.stderr) == (0, "")
        assert done.stdout == f"process {process.pid}: stopped\n"
        wait_until(emulator.is_stopped, "zero as the newest command")
        emulator.forget()
        wait_until(lambda: len(emulator.commands()) > 50, "more commands")
        assert set(emulator.commands()) == {ZERO}
        assert process.poll() is None  # it goes on, latched
        process.terminate()
        process.wait(TIMEOUT)


def test_a_run_ends_with_one_line(emulator: Emulated, robot_file: RobotFile) -> None:
    options = ("--link", emulator.device, "--robot", str(robot_file()))
    with program(DRIVING, "run", "3", "0", *options) as process:
        wait_until(emulator.is_driven, "a command that turns the wheels")
        assert [each.answered for each in estop.stop_all()] == [True]
        _, error = process.communicate(timeout=TIMEOUT)
    assert process.returncode == 3
    assert error.strip() == "acsar-gym: emergency stop: look after the robot, then start again"


def test_without_a_robot_the_command_says_so() -> None:
    done = cli("estop")
    assert done.returncode == 1
    assert "no robot is being driven" in done.stdout


def test_sockets_belong_to_their_owner_alone(config: RobotConfig, shared_device: str) -> None:
    with no_leak():
        robot = Robot(open_link(shared_device, config), config)
        robot.activate()
        (path,) = estop.folder().iterdir()
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
        assert stat.S_IMODE(path.parent.stat().st_mode) == 0o700
        robot.deactivate()
        assert not list(estop.folder().iterdir())


def test_the_socket_of_a_dead_process_is_forgotten() -> None:
    left = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    path = estop.folder() / "99999999-1"
    left.bind(str(path))
    left.close()
    assert estop.stop_all() == []
    assert not path.exists()


def test_a_process_that_hangs_does_not_answer() -> None:
    ears = estop.Ears()
    assert estop.stop_all() == [estop.Stopped(os.getpid(), answered=False)]
    assert ears.heard()
    ears.close()
    ears.close()


def test_a_folder_of_somebody_else_is_refused(own_folder: Path) -> None:
    place = estop.folder()
    place.chmod(0o755)
    with pytest.raises(LinkError, match="yours alone"):
        estop.folder()
    ears = estop.Ears()  # deaf, but no error
    assert not ears.heard()
    ears.close()
    place.rmdir()


def test_other_messages_are_ignored(config: RobotConfig, shared_device: str) -> None:
    with Robot(open_link(shared_device, config), config) as robot:
        (path,) = estop.folder().iterdir()
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as other:
            other.sendto(b"go on", str(path))
        robot.drive(0.0, 0.0)
        assert robot.safety.reason is Reason.NONE


def test_simulated_robots_have_no_socket(config: RobotConfig) -> None:
    with Robot(open_link("planar", config), config):
        assert not list(estop.folder().iterdir())


def test_the_folder_is_the_same_in_every_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    place = estop.folder()
    monkeypatch.setenv("XDG_RUNTIME_DIR", "/elsewhere")
    monkeypatch.setenv("TMPDIR", "/elsewhere")
    assert estop.folder() == place


def test_a_folder_that_cannot_be_made_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ACSAR_GYM_RUNTIME_DIR", "/acsar-missing")
    with pytest.raises(LinkError, match=r"^/acsar-missing/acsar_gym-\d+: can't be made a folder"):
        estop.folder()


def test_the_doctor_heeds_it(emulator: Emulated, robot_file: RobotFile) -> None:
    options = ("--spin", "--robot", str(robot_file()))
    with program(DRIVING, "doctor", emulator.device, *options) as process:
        wait_until(emulator.is_driven, "a command that turns the wheels")
        assert estop.stop_all() == [estop.Stopped(process.pid, answered=True)]
        output, _ = process.communicate(timeout=TIMEOUT)
    assert process.returncode == 1
    assert "emergency stop" in output
    assert emulator.is_stopped()
