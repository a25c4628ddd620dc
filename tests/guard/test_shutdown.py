"""Whatever ends a program, its robot is stopped first."""

from __future__ import annotations

import random
import signal
import time

import pytest
from processes import HASTY, ended, first_line, program
from serial_tools import DRIVER, Emulated, wait_until

from acsar_gym.protocol import ZERO

pytestmark = pytest.mark.usefixtures("deadline")

DRIVE = "robot.activate(); drive({ticks}); {end}"
FOREVER = 10**9


def assert_stopped(emulator: Emulated) -> None:
    """Wheels turned, then a zero command came. The process is gone, so nothing follows it."""
    wait_until(emulator.is_stopped, "zero as the last command")


@pytest.mark.parametrize(
    ("end", "status", "message"),
    [
        ("raise RuntimeError('oops')", 1, "RuntimeError: oops"),
        ("raise KeyboardInterrupt", -signal.SIGINT, "KeyboardInterrupt"),
        ("sys.exit(7)", 7, ""),
    ],
)
def test_shutdown_at_the_end_of_a_program(
    end: str, status: int, message: str, emulator: Emulated
) -> None:
    with program(DRIVER + DRIVE.format(ticks=30, end=end), emulator.device) as process:
        returned, error = ended(process)
    assert returned == status, error
    assert error.endswith(f"{message}\n") if message else not error
    assert_stopped(emulator)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT])
def test_signals_keep_their_effect(number: signal.Signals, emulator: Emulated) -> None:
    code = DRIVER + DRIVE.format(ticks=FOREVER, end="")
    with program(code, emulator.device) as process:
        wait_until(emulator.is_driven, "a command that turns the wheels")
        process.send_signal(number)
        returned, error = ended(process)
    assert returned == -number, error
    assert_stopped(emulator)


def test_handlers_of_the_program_are_left_alone(emulator: Emulated) -> None:
    handler = "signal.signal(signal.SIGINT, lambda *_: sys.exit(9)); "
    code = handler + DRIVE.format(ticks=30, end="signal.raise_signal(signal.SIGINT)")
    with program(DRIVER + code, emulator.device) as process:
        assert ended(process) == (9, "")
    assert_stopped(emulator)


SWALLOWING = """
from acsar_gym.worlds import Scene

class Interrupted:
    def __del__(self):
        signal.raise_signal(signal.SIGINT)

robot.activate()
drive(30)
Interrupted()
{next_call}
drive(10**9)
"""


@pytest.mark.parametrize("next_call", ["drive(1)", "robot.reset(Scene())"])
def test_ctrl_c_ends_a_program_that_swallows_the_exception(
    next_call: str, emulator: Emulated
) -> None:
    """Python ignores exceptions in finalizers, such as that of rclpy's futures."""
    with program(DRIVER + SWALLOWING.format(next_call=next_call), emulator.device) as process:
        returned, error = ended(process)
    assert returned == -signal.SIGINT
    assert "Exception ignored in: <function Interrupted.__del__" in error
    assert_stopped(emulator)


INTERRUPTED_OFTEN = """
import time
from acsar_gym.protocol import encode
from acsar_gym.worlds import Scene

class Slow:
    def __del__(self):
        end = time.monotonic() + 0.001
        while time.monotonic() < end:
            pass

link = robot.link
link.open()
link.reset(Scene())
while True:
    try:
        print("drives", flush=True)
        while True:
            link.write(encode((3.0, 3.0, 3.0, 3.0)))
            link.advance(0.001)
            Slow()
    except KeyboardInterrupt:
        link.reset(Scene())
        print("stopped", flush=True)
"""
"""Is in a finalizer for half of its time."""


@pytest.mark.parametrize("trials", [30, pytest.param(2000, marks=pytest.mark.slow)])
def test_ctrl_c_is_never_lost(trials: int, emulator: Emulated) -> None:
    with program(DRIVER + INTERRUPTED_OFTEN, emulator.device) as process:
        for _ in range(trials):
            assert first_line(process) == "drives"
            time.sleep(random.uniform(0.0, 0.01))
            process.send_signal(signal.SIGINT)
            assert first_line(process) == "stopped"
        assert "KeyboardInterrupt" in process.errors, "at least once it was swallowed"
        process.kill()
    assert_stopped(emulator)


STARTING_AGAIN = """
robot.activate()
try:
    signal.raise_signal(signal.SIGINT)
except KeyboardInterrupt:
    pass
try:
    robot.reset(Scene())
except KeyboardInterrupt:
    print("once more", flush=True)
robot.reset(Scene())
drive(30)
"""


def test_ctrl_c_and_the_main_thread_drives_again(emulator: Emulated) -> None:
    """As no link was closed, the exception may have been swallowed: it is raised once more."""
    code = "from acsar_gym.worlds import Scene" + STARTING_AGAIN
    with program(DRIVER + code, emulator.device) as process:
        assert process.communicate() == ("once more\n", "")
    assert_stopped(emulator)


def test_ctrl_z_stops_the_robot_until_it_is_reset(emulator: Emulated) -> None:
    """`fg` doesn't make it drive on."""
    driver = DRIVER.replace("watchdog_timeout=2.0", f"watchdog_timeout={HASTY}")
    with program(driver + DRIVE.format(ticks=FOREVER, end=""), emulator.device) as process:
        wait_until(emulator.is_driven, "a command that turns the wheels")
        process.send_signal(signal.SIGTSTP)
        assert_stopped(emulator)
        count = len(emulator.commands())
        wait_until(lambda: len(emulator.commands()) > count + 5, "zeros of the watchdog")
        process.send_signal(signal.SIGCONT)
        _, error = ended(process)
    assert "the watchdog stopped the robot: nothing was commanded for" in error
    assert_stopped(emulator)
    driving = [command != ZERO for command in emulator.commands()]
    assert not any(driving[driving.index(False, driving.index(True)) :])


THREAD = """
import threading, time

def start(work):
    errors = []

    def run():
        try:
            work()
        except Exception as error:
            errors.append(f"{type(error).__name__}: {error}")

    thread = threading.Thread(target=run)
    thread.start()
    return thread, errors

robot.activate()
thread, errors = start(lambda: drive(10**9))
while robot.odometry.pose[0] < 0.02:
    time.sleep(0.01)
"""


def test_ctrl_c_refuses_a_thread_until_the_main_thread_resets(emulator: Emulated) -> None:
    code = """
try:
    signal.raise_signal(signal.SIGINT)
except KeyboardInterrupt:
    thread.join()
    thread, activation_errors = start(robot.activate)
    thread.join()
    robot.activate()
    thread, no_errors = start(lambda: drive(30))
    thread.join()
print(errors, activation_errors, no_errors, sep="|", flush=True)
"""
    with program(DRIVER + THREAD + code, emulator.device) as process:
        output = first_line(process).split("|")
        assert ended(process) == (0, "")

    refusal = (
        "['LinkError: SIGINT asked the program to end, and a thread drove on: "
        "to go on, call activate() or env.reset() in the main thread']"
    )
    assert output == [refusal, refusal, "[]"]
    assert_stopped(emulator)


@pytest.mark.parametrize(
    ("end", "status"),
    [
        ("raise RuntimeError", 1),
        ("os.kill(os.getpid(), signal.SIGTERM)", -signal.SIGTERM),
        ("import asyncio\nasyncio.run(asyncio.to_thread(thread.join))", -signal.SIGINT),
        ("from concurrent.futures import *\nThreadPoolExecutor().submit(thread.join)\n1 / 0", 1),
    ],
    ids=["exception", "SIGTERM", "Ctrl-C in asyncio", "exception with an executor"],
)
def test_shutdown_of_the_main_thread_stops_another_thread(
    end: str, status: int, emulator: Emulated
) -> None:
    with program(DRIVER + THREAD + end, emulator.device) as process:
        wait_until(emulator.is_driven, "a command that turns the wheels")
        if status == -signal.SIGINT:
            time.sleep(0.1)
            process.send_signal(signal.SIGINT)
        assert ended(process)[0] == status
    assert_stopped(emulator)


FORK = """
robot.activate()
drive(30)
child = os.fork()
if child == 0:
    {end}
drive(30)
while os.waitpid(child, os.WNOHANG) == (0, 0):
    drive(1)
drive(30)
"""


@pytest.mark.parametrize(
    "end", ["sys.exit()", "os._exit(0)", "os.kill(os.getpid(), signal.SIGTERM)"]
)
def test_forked_child_sends_nothing(end: str, emulator: Emulated) -> None:
    with program(DRIVER + FORK.format(end=end), emulator.device) as process:
        assert ended(process) == (0, "")
    assert_stopped(emulator)
    driving = [command != ZERO for command in emulator.commands()]
    start = driving.index(True)
    assert all(driving[start : start + 90])
