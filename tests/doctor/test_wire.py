"""The doctor at the command line and in process, over the emulator."""

from __future__ import annotations

import json
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from serial_tools import (
    TIMEOUT,
    RobotFile,
    StartEmulator,
    cli,
    first_line,
    no_leak,
    program,
    wait_until,
)

from acsar_gym import RobotConfig
from acsar_gym.errors import EmergencyStopError
from acsar_gym.protocol import ZERO, encode
from acsar_gym.safety.estop import StopListener
from acsar_gym.tools.cli import main
from acsar_gym.tools.doctor import board, wire
from acsar_gym.tools.doctor.checks import Check
from acsar_gym.tools.doctor.commission import Commission

pytestmark = pytest.mark.usefixtures("deadline")

MISSING = "/dev/acsar-missing"
TIMED = {"feedback rate", "command to feedback"}
"""A busy machine may turn these to `warn`."""


BOARD = """
import os, pty, sys, time, tty
from acsar_gym.protocol import Decoder, encode
master, slave = pty.openpty()
tty.setraw(slave)
os.set_blocking(master, False)
print(os.ttyname(slave), flush=True)
decoder, speeds, heard = Decoder(), (0.0,) * 4, 0.0
while True:
    try:
        for reading in decoder.feed(os.read(master, 4096)):
            speeds, heard = reading.speeds, time.monotonic()
    except BlockingIOError:
        pass
    if time.monotonic() - heard > 0.3:
        speeds = (0.0,) * 4
    line = encode((*speeds[:3], 0.0 if sys.argv[1] == "dead" else speeds[3]))
    for half in (line[:20], line[20:]):
        try:
            os.write(master, half)
        except BlockingIOError:
            pass
        time.sleep(0.005)
"""
"""A board that writes its lines in two halves, with or without a dead wheel d."""


SPINS = """
import os, signal, sys
from acsar_gym import RobotConfig
from acsar_gym.tools.doctor import wire
from acsar_gym.protocol import encode
link = wire._Stoppable(sys.argv[1], RobotConfig())
link.open()
for tick in range(100):
    link.write(encode((0.0, 0.0, 0.0, 6.0), trailing_comma=False))
    link.advance(0.01)
os.kill(os.getpid(), int(sys.argv[2]))
"""
"""A check that ends while it turns the last wheel, by lines without a trailing comma."""


@pytest.fixture(autouse=True)
def hurry(monkeypatch: pytest.MonkeyPatch) -> None:
    """Listen shorter than at the command line, and wait for what comes on a busy machine, too."""
    monkeypatch.setattr(board, "LISTEN_TIME", 0.2)
    monkeypatch.setattr(board, "RESPONSE_TRIALS", 2)
    for module in (board,):
        monkeypatch.setattr(module, "PATIENCE", TIMEOUT)


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is waited for never comes."""
    for module in (board,):
        monkeypatch.setattr(module, "PATIENCE", 1.0)


def examined(device: str, config: RobotConfig, *, spin: bool = False) -> dict[str, Check]:
    with no_leak():
        commission = Commission() if spin else None
        return {check.name: check for check in wire.examine_device(device, config, commission)}


def only(checks: dict[str, Check]) -> Check:
    (check,) = checks.values()
    return check


def reported(path: Path) -> dict[str, dict[str, str]]:
    """The checks of a JSON report, by name."""
    checks = json.loads(path.read_text(encoding="utf-8"))["checks"]
    assert all(set(check) == {"name", "status", "found", "fix"} for check in checks)
    return {check["name"]: check for check in checks}


def number(text: str) -> float:
    """The first number of a finding."""
    return float(text.removeprefix("after ").split(" ")[0])


def test_a_standing_robot(config: RobotConfig, shared_device: str) -> None:
    checks = examined(shared_device, config)
    assert [checks[name].status for name in ("open", "first valid line", "line quality")] == (
        ["ok"] * 3
    )
    assert shared_device in checks["open"].found
    assert number(checks["feedback rate"].found) > 0.0
    assert number(checks["line quality"].found) == 0
    assert checks["command to feedback"].status == "skip"
    assert checks["stops when commands stop"].status == "skip"
    assert "--spin" in checks["stops when commands stop"].fix


def test_spin_measures_round_trip_and_stop(
    shared_device: str,
    robot_file: RobotFile,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    report = tmp_path / "doctor.json"
    given, out_file = robot_file(), tmp_path / "found.yaml"
    robot = RobotConfig.load(given)
    files = ("--robot", str(given), "--json", str(report), "--out", str(out_file))
    monkeypatch.setattr(
        sys, "argv", ["acsar-gym", "doctor", shared_device, "--spin", "--yes", *files]
    )
    with pytest.raises(SystemExit, match="0"):
        main()
    out, error = capsys.readouterr()
    assert not error
    checks = reported(report)
    assert {name for name, c in checks.items() if c["status"] == "warn"} <= TIMED | {"serial ports"}
    assert checks["stops when commands stop"]["status"] == "ok"
    assert number(checks["command to feedback"]["found"]) > 0.0
    assert number(checks["stops when commands stop"]["found"]) == pytest.approx(0.5, abs=0.06)
    assert "stops when commands stop" in out
    written = RobotConfig.load(out_file)
    assert written.with_(firmware=robot.firmware.model_dump()) == robot


@pytest.mark.slow  # as in simulated time, test_commission.py
def test_spin_finds_a_board_that_never_stops(
    config: RobotConfig, start_emulator: StartEmulator, robot_file: RobotFile, impatient: None
) -> None:
    emulator = start_emulator("--robot", str(robot_file(firmware={"command_timeout": None})))
    stops = examined(emulator.device, config, spin=True)["stops when commands stop"]
    assert stops.status == "fail"
    assert "time-out" in stops.fix
    wait_until(emulator.is_stopped, "zero as the last command")


@pytest.mark.slow  # as in simulated time, test_commission.py
def test_spin_finds_wheels_that_do_not_turn(
    config: RobotConfig, start_emulator: StartEmulator, robot_file: RobotFile, impatient: None
) -> None:
    emulator = start_emulator("--robot", str(robot_file(motor={"deadband": 20.0})))
    checks = examined(emulator.device, config, spin=True)
    assert checks["command to feedback"].status == "fail"
    assert "motors" in checks["command to feedback"].fix
    assert "stops when commands stop" not in checks


@pytest.mark.parametrize("end", [signal.SIGKILL, signal.SIGTERM], ids=["kill", "term"])
@pytest.mark.parametrize("quirk", ["no-comma", "at-comma"])
def test_a_board_is_stopped_whichever_zeros_it_takes(
    quirk: str, end: signal.Signals, start_emulator: StartEmulator
) -> None:
    emulator = start_emulator("--quirk", quirk, "no-timeout")
    with program(SPINS, emulator.device, str(end.value)) as spinning_program:
        assert spinning_program.wait(TIMEOUT) == -end
    sent = b"".join(encode(ZERO, trailing_comma=comma) for comma in (False, True))
    wait_until(lambda: emulator.received().endswith(sent), "both zeros as the last command")
    wait_until(emulator.stands, "a robot that stands")


def test_a_check_that_fails_to_open_listens_no_more(
    config: RobotConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[wire._Stoppable] = []  # so that no finalizer closes anything

    class Kept(wire._Stoppable):
        def __init__(self, device: str, config: RobotConfig) -> None:
            super().__init__(device, config)
            made.append(self)

    monkeypatch.setattr(wire, "_Stoppable", Kept)
    (check,) = wire.examine_device(MISSING, config)
    assert (check.name, check.status) == ("open", "fail")
    assert made[0]._listener.paths == []


def test_slow_feedback_is_a_warning(
    config: RobotConfig, start_emulator: StartEmulator, robot_file: RobotFile
) -> None:
    robot = robot_file(firmware={"feedback_rate": 20.0})
    emulator = start_emulator("--robot", str(robot))
    rate = examined(emulator.device, config)["feedback rate"]
    assert rate.status == "warn"
    assert "100 expected" in rate.found
    assert "feedback_rate" in rate.fix


def test_a_wrong_baud_rate_and_the_right_one(shared_device: str, config: RobotConfig) -> None:
    wrong = config.with_(baud_rate=57600, connect_timeout=1.0)
    checks = examined(shared_device, wrong)
    assert [check.status for check in checks.values()] == ["fail", "warn"]
    assert "57600" in checks["first valid line"].found
    assert checks["first valid line"].fix == "see the next row"
    assert checks["baud rate"].found == "valid lines at 115200 baud"
    assert "--baud-rate 115200" in checks["baud rate"].fix


def test_a_silent_board(config: RobotConfig, start_emulator: StartEmulator) -> None:
    silent = start_emulator("--silent")
    check = only(examined(silent.device, config.with_(connect_timeout=0.3)))
    assert (check.name, check.status) == ("first valid line", "fail")
    assert "power" in check.fix


@pytest.mark.anywhere
def test_a_missing_device(tmp_path: Path) -> None:
    report = tmp_path / "doctor.json"
    done = cli("doctor", MISSING, "--json", report)
    assert (done.returncode, done.stderr) == (1, "")
    failed = reported(report)["open"]
    assert failed["status"] == "fail"
    assert MISSING in failed["found"]


def test_a_device_lost_during_the_examination(
    config: RobotConfig, start_emulator: StartEmulator
) -> None:
    emulator = start_emulator()
    checks = []
    with no_leak():
        for check in wire.examine_device(emulator.device, config):
            checks.append(check)
            if check.name == "first valid line":
                emulator.kill()
    assert (checks[-1].name, checks[-1].status) == ("connection", "fail")
    assert emulator.device in checks[-1].found


def test_an_emergency_stop_ends_with_its_exit_code(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def examine(*_: object) -> Iterator[Check]:
        yield Check("connection", "fail", "emergency stop")
        raise EmergencyStopError

    monkeypatch.setattr(wire, "examine_device", examine)
    report = tmp_path / "doctor.json"
    monkeypatch.setattr("sys.argv", ["acsar-gym", "doctor", "/dev/ttyUSB7", "--json", str(report)])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 3
    assert reported(report)["connection"]["found"] == "emergency stop"


def test_an_emergency_stop_is_the_last_check(
    config: RobotConfig, shared_device: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    requested: list[bool] = []
    monkeypatch.setattr(StopListener, "is_requested", lambda _: bool(requested))
    checks = []
    with no_leak(), pytest.raises(EmergencyStopError):
        for check in wire.examine_device(shared_device, config):
            checks.append(check)
            if check.name == "first valid line":
                requested.append(True)
    assert (checks[-1].name, checks[-1].status) == ("connection", "fail")


@pytest.mark.anywhere
def test_without_a_device_only_the_computer_is_examined(tmp_path: Path) -> None:
    report = tmp_path / "doctor.json"
    done = cli("doctor", "--json", report)
    assert (done.returncode, done.stderr) == (0, "")
    assert set(reported(report)) == {"serial ports", "emergency stop"}


@pytest.mark.anywhere
@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--baud-rate", "12345"), "must be one of 9600"),
        (("--robot", "acsr"), "did you mean 'acsar'"),
        (("--json", "/missing/doctor.json"), "can't be written"),
        (("--out", "robot.yaml"), "--out and --saw need --spin"),
        (("--saw", "a", "b", "c", "d"), "--out and --saw need --spin"),
        (("--spin", "--yes"), "--spin needs a device"),
        ((MISSING, "--spin", "--yes", "--saw", "a", "b", "c", "x"), "'x': write the wheel"),
        ((MISSING, "--spin", "--yes", "--out", "/missing/robot.yaml"), "can't be written"),
    ],
)
def test_bad_options(arguments: tuple[str, ...], said: str) -> None:
    done = cli("doctor", *arguments)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert said in done.stderr


@pytest.mark.slow  # as in simulated time, test_commission.py
@pytest.mark.parametrize("wheel", ["dead", "sound"])
def test_one_dead_wheel_is_found(
    config: RobotConfig, wheel: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if wheel == "dead":
        monkeypatch.setattr(board, "START_TIMEOUT", 1.0)
    with program(BOARD, wheel) as started:
        checks = examined(first_line(started), config, spin=True)
    assert (checks["rear_right"].status == "fail") == (wheel == "dead")
    assert checks["rear_left"].status == "ok"
    assert checks["line quality"].status == "ok"
