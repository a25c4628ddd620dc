"""Whatever ends a program, its robot is stopped first."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import psutil
import pytest
from nursery import ended, first_line, program
from serial_tools import DRIVER, Emulated, wait_until
from shutdown_tools import FOREVER, IN_BLOCK, assert_stopped, drives
from watchdog_tools import HASTY

from acsar_gym.protocol import ZERO

pytestmark = [
    pytest.mark.usefixtures("deadline", "nursery"),
    pytest.mark.xdist_group("serial"),
]

WITHOUT_BLOCK = """
robot.activate()
drive({ticks})
{end}
"""

BLOCKS = pytest.mark.parametrize("block", [IN_BLOCK, WITHOUT_BLOCK], ids=["with", "without"])


def hears_more(emulator: Emulated) -> None:
    heard = len(emulator.commands())
    wait_until(lambda: len(emulator.commands()) > heard + 5, "more commands")


def assert_drove_once(emulator: Emulated) -> None:
    """Nothing turned wheels any more after the first zero command."""
    assert_stopped(emulator)
    driving = [command != ZERO for command in emulator.commands()]
    assert not any(driving[driving.index(False, driving.index(True)) :])


@BLOCKS
@pytest.mark.parametrize(
    ("end", "status", "said"),
    [
        ("raise RuntimeError('oops')", 1, "RuntimeError: oops"),
        ("raise KeyboardInterrupt", -signal.SIGINT, "KeyboardInterrupt"),
        ("sys.exit(7)", 7, ""),
        ("pass", 0, ""),
    ],
    ids=["exception", "interrupt", "sys.exit", "end of program"],
)
def test_ends_of_a_program(
    block: str, end: str, status: int, said: str, emulator: Emulated
) -> None:
    with program(DRIVER + block.format(ticks=30, end=end), emulator.device) as process:
        returned, error = ended(process)
    assert returned == status, error
    assert error.endswith(f"{said}\n") if said else not error
    assert_stopped(emulator)


@BLOCKS
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT])
def test_signals_keep_their_effect(block: str, number: signal.Signals, emulator: Emulated) -> None:
    code = DRIVER + block.format(ticks=FOREVER, end="pass")
    with program(code, emulator.device) as process:
        drives(emulator)
        process.send_signal(number)
        returned, error = ended(process)
    assert returned == -number, error
    assert_stopped(emulator)


def test_a_handler_of_the_program_itself_is_left_alone(emulator: Emulated) -> None:
    own = "signal.signal(signal.SIGTERM, lambda *_: sys.exit(9))"
    code = DRIVER + own + WITHOUT_BLOCK.format(ticks=FOREVER, end="pass")
    with program(code, emulator.device) as process:
        drives(emulator)
        process.terminate()
        assert ended(process) == (9, "")
    assert_stopped(emulator)


def test_an_ignored_signal_stays_ignored(emulator: Emulated) -> None:
    """As under nohup: the robot drives on after the terminal is closed."""
    own = "signal.signal(signal.SIGHUP, signal.SIG_IGN)"
    code = DRIVER + own + WITHOUT_BLOCK.format(ticks=FOREVER, end="pass")
    with program(code, emulator.device) as process:
        drives(emulator)
        process.send_signal(signal.SIGHUP)
        hears_more(emulator)
        assert emulator.is_driven()
        process.terminate()
        assert ended(process) == (-signal.SIGTERM, "")
    assert_stopped(emulator)


HASTILY = f"""
config = config.with_(watchdog_timeout={HASTY})
robot = Robot(open_link(sys.argv[1], config), config)
"""


def test_ctrl_z_stops_the_robot_until_it_is_reset(emulator: Emulated) -> None:
    """`fg` alone doesn't make it drive on."""
    code = DRIVER + HASTILY + IN_BLOCK.format(ticks=FOREVER, end="pass")
    with program(code, emulator.device) as process:
        drives(emulator)
        process.send_signal(signal.SIGTSTP)
        assert_stopped(emulator)
        state = psutil.Process(process.pid).status
        wait_until(lambda: state() == psutil.STATUS_STOPPED, "a stopped process")
        hears_more(emulator)  # the wire may have swallowed the first zero
        assert emulator.is_stopped()
        process.send_signal(signal.SIGCONT)
        status, error = ended(process)
    assert status == 1
    assert "the watchdog stopped the robot: nothing was commanded for" in error
    assert_drove_once(emulator)


CONTAINED = f"""
import sys
sys.path.insert(0, {str(Path(__file__).parents[1])!r})
import stopping

print(stopping.no_namespace() or "can be had", flush=True)
stopping.become_pid_1(1)
"""
"""What follows is PID 1 of a namespace, as in a container without an init."""

INSIST = """
def insist():
    while True:
        try:
            robot.activate()
            drive(10**9)
        except Exception:
            pass
"""
"""As an evaluation does: an error ends an episode, and a reset begins the next one."""


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_pid_1_ends_too(number: signal.Signals, emulator: Emulated) -> None:
    """Although the kernel ignores the signals that it sends itself."""
    with program(CONTAINED + DRIVER + INSIST + "insist()", emulator.device) as process:
        if (reason := first_line(process)) != "can be had":
            pytest.skip(reason)
        inner = first_line(process)
        drives(emulator)
        os.kill(int(inner), number)
        status, error = ended(process)
    assert status == 128 + number, error
    assert_drove_once(emulator)


THREAD = """
import atexit, threading, time
from acsar_gym.links import shutdown

# The end of the program takes a while when the ports are closed.
kill = os.kill
os.kill = lambda *arguments: (time.sleep(0.7), kill(*arguments))
atexit.unregister(shutdown.close_all)
atexit.register(time.sleep, 0.7)
atexit.register(shutdown.close_all)
thread = threading.Thread(target=insist, daemon=True)
thread.start()
"""


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_thread_that_drives_is_stopped_by_signals(
    number: signal.Signals, emulator: Emulated
) -> None:
    code = DRIVER + INSIST + THREAD + "thread.join()"
    with program(code, emulator.device) as process:
        drives(emulator)
        process.send_signal(number)
        assert ended(process) == (-number, "")
    assert_drove_once(emulator)


def test_a_thread_that_drives_is_stopped_when_the_main_thread_returns(emulator: Emulated) -> None:
    wait = "while robot.odometry.pose[0] < 0.02:\n    time.sleep(0.01)"
    with program(DRIVER + INSIST + THREAD + wait, emulator.device) as process:
        assert ended(process) == (0, "")
    assert_drove_once(emulator)
