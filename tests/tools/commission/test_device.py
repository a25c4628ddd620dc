"""The doctor at the command line and in process, over the emulator."""

from __future__ import annotations

import json
import signal
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path

import pytest
from processes import program
from serial_tools import TIMEOUT, StartEmulator, cli, no_leak, wait_until

from acsar_gym import RobotConfig
from acsar_gym.errors import EmergencyStopError
from acsar_gym.guard.estop import StopListener
from acsar_gym.protocol import ZERO, encode
from acsar_gym.tools.commission.board_checks import BoardExamination
from acsar_gym.tools.commission.checks import Check
from acsar_gym.tools.commission.device import at_baud_rate, examine_device
from acsar_gym.tools.sysid import board

pytestmark = pytest.mark.usefixtures("deadline")

MISSING = "/dev/acsar-missing"


@pytest.fixture(autouse=True)
def hurry(monkeypatch: pytest.MonkeyPatch) -> None:
    """Listen shorter than at the command line."""
    monkeypatch.setattr(board, "LISTEN_TIME", 0.2)


def examine(device: str, config: RobotConfig) -> Iterator[Check]:
    return examine_device(device, config, BoardExamination(config).run)


SPINS = """
import os, signal, sys
from acsar_gym import RobotConfig
from acsar_gym.tools.commission.device import StoppableLink
from acsar_gym.protocol import encode
link = StoppableLink(sys.argv[1], RobotConfig().with_(watchdog_timeout=5.0))
link.open()
for tick in range(100):
    link.write(encode((0.0, 0.0, 0.0, 6.0), trailing_comma=False))
    link.advance(0.01)
os.kill(os.getpid(), int(sys.argv[2]))
"""
"""A check that ends while it turns the last wheel, by lines without a trailing comma."""


@pytest.mark.parametrize(
    ("quirk", "end"), [("no-comma", signal.SIGKILL), ("at-comma", signal.SIGTERM)]
)
def test_stoppable_link_stops_a_board_whichever_zeros_it_takes(
    quirk: str, end: signal.Signals, start_emulator: StartEmulator
) -> None:
    emulator = start_emulator("--quirk", quirk, "no-timeout")
    with program(SPINS, emulator.device, str(end.value)) as spinning_program:
        assert spinning_program.wait(TIMEOUT) == -end
    sent = b"".join(encode(ZERO, trailing_comma=comma) for comma in (False, True))
    wait_until(lambda: emulator.received().endswith(sent), "both zeros as the last command")
    wait_until(emulator.stands, "a robot that stands")


def test_examine_device_finds_the_baud_rate(shared_device: str, config: RobotConfig) -> None:
    wrong = config.with_(baud_rate=57600, connect_timeout=1.0)
    with no_leak():
        checks = {check.name: check for check in examine(shared_device, wrong)}
    assert [check.status for check in checks.values()] == ["fail", "warn"]
    assert "57600" in checks["first valid line"].found
    assert checks["baud rate"].found == "valid lines at 115200 baud"
    assert "--baud-rate 115200" in checks["baud rate"].fix


@pytest.mark.parametrize("is_stopped", [False, True], ids=["lost", "emergency stop"])
def test_examine_device_ends_with_the_connection(
    config: RobotConfig,
    start_emulator: StartEmulator,
    monkeypatch: pytest.MonkeyPatch,
    *,
    is_stopped: bool,
) -> None:
    emulator = start_emulator()
    requests: list[bool] = []
    monkeypatch.setattr(StopListener, "is_requested", lambda _: bool(requests))

    checks = []
    caught = pytest.raises(EmergencyStopError) if is_stopped else nullcontext()
    with no_leak(), caught:
        for check in examine(emulator.device, config):
            checks.append(check)
            if check.name == "first valid line":
                if is_stopped:
                    requests.append(True)
                else:
                    emulator.kill()
    assert (checks[-1].name, checks[-1].status) == ("connection", "fail")
    assert is_stopped or emulator.device in checks[-1].found


@pytest.mark.parametrize(
    ("arguments", "status", "names"),
    [((), 0, set()), ((MISSING,), 1, {"open"})],
    ids=["no device", "missing"],
)
def test_doctor_examines_the_computer_without_a_device(
    arguments: tuple[str, ...], status: int, names: set[str], tmp_path: Path
) -> None:
    report = tmp_path / "doctor.json"
    done = cli("doctor", *arguments, "--json", report)
    assert (done.returncode, done.stderr) == (status, "")
    rows = json.loads(report.read_text(encoding="utf-8"))["checks"]
    assert all(set(row) == {"name", "status", "found", "fix"} for row in rows)
    checks = {row["name"]: row for row in rows}
    assert set(checks) == {"serial ports", "emergency stop"} | names
    assert all(MISSING in checks[name]["found"] for name in names)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--baud-rate", "12345"), "must be one of 9600"),
        (("--saw", "a", "b", "c", "d"), "--out and --saw need --spin"),
        ((MISSING, "--spin", "--yes", "--out", "/missing/robot.yaml"), "can't be written"),
    ],
)
def test_doctor_refuses_bad_options(arguments: tuple[str, ...], message: str) -> None:
    done = cli("doctor", *arguments)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert message in done.stderr


@pytest.mark.parametrize(("baud", "rate"), [(9600, 20.0), (38400, 100.0)])
def test_at_baud_rate_lowers_the_control_rate_on_a_slow_line(baud: int, rate: float) -> None:
    robot = at_baud_rate(RobotConfig.preset("acsar"), baud)
    assert (robot.baud_rate, robot.control_rate) == (baud, rate)
