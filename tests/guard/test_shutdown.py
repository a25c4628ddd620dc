"""Whatever ends a program, its robot is stopped first."""

from __future__ import annotations

import signal

import psutil
import pytest
from nursery import ended, first_line, program
from serial_tools import DRIVER, Emulated, wait_until
from watchdog_tools import HASTY

from acsar_gym.protocol import ZERO

pytestmark = pytest.mark.usefixtures("deadline", "nursery")


IN_BLOCK = """
with robot:
    drive({ticks})
    {end}
"""
WITHOUT_BLOCK = """
robot.activate()
drive({ticks})
{end}
"""
BLOCKS = pytest.mark.parametrize("block", [IN_BLOCK, WITHOUT_BLOCK], ids=["with", "without"])
FOREVER = 10**9


def assert_stopped(emulator: Emulated) -> None:
    """Wheels turned, then a zero command came; the process is gone, so nothing follows it."""
    wait_until(emulator.is_stopped, "zero as the last command")


def hears_more(emulator: Emulated) -> None:
    heard = len(emulator.commands())
    wait_until(lambda: len(emulator.commands()) > heard + 5, "more commands")


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
        wait_until(emulator.is_driven, "a command that turns the wheels")
        process.send_signal(number)
        returned, error = ended(process)
    assert returned == -number, error
    assert_stopped(emulator)


def test_a_handler_of_the_program_itself_is_left_alone(emulator: Emulated) -> None:
    own = "signal.signal(signal.SIGTERM, lambda *_: sys.exit(9))"
    code = DRIVER + own + WITHOUT_BLOCK.format(ticks=FOREVER, end="pass")
    with program(code, emulator.device) as process:
        wait_until(emulator.is_driven, "a command that turns the wheels")
        process.terminate()
        assert ended(process) == (9, "")
    assert_stopped(emulator)


def test_ctrl_z_stops_the_robot_until_it_is_reset(emulator: Emulated) -> None:
    """`fg` alone doesn't make it drive on."""
    hastily = f"""
config = config.with_(watchdog_timeout={HASTY})
robot = Robot(open_link(sys.argv[1], config), config)
"""
    code = DRIVER + hastily + IN_BLOCK.format(ticks=FOREVER, end="pass")
    with program(code, emulator.device) as process:
        wait_until(emulator.is_driven, "a command that turns the wheels")
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
    assert_stopped(emulator)
    driving = [command != ZERO for command in emulator.commands()]
    assert not any(driving[driving.index(False, driving.index(True)) :])


THREAD = """
import threading, time

def in_a_thread(work):
    errors = []

    def run():
        try:
            work()
        except Exception as error:
            errors.append(f"{type(error).__name__}: {error}")
    thread = threading.Thread(target=run)
    thread.start()
    return thread, errors
"""


def test_a_thread_is_refused_until_the_main_thread_resets(emulator: Emulated) -> None:
    """Whatever the program's own handler does: it had its time to end the thread."""
    code = """
signal.signal(signal.SIGINT, lambda *_: None)
robot.activate()
thread, errors = in_a_thread(lambda: drive(10**9))
while robot.odometry.pose[0] < 0.02:
    time.sleep(0.01)
signal.raise_signal(signal.SIGINT)
thread.join()
again, too = in_a_thread(robot.activate)
again.join()
robot.activate()
last, none = in_a_thread(lambda: drive(30))
last.join()
print(errors, too, none, sep="|", flush=True)
"""
    with program(DRIVER + THREAD + code, emulator.device) as process:
        said = first_line(process).split("|")
        assert ended(process) == (0, "")
    refused = (
        "['LinkError: SIGINT asked the program to end, and a thread drove on: "
        "to go on, call activate() or env.reset() in the main thread']"
    )
    assert said == [refused, refused, "[]"]
    assert_stopped(emulator)


LOOP = """
import asyncio, signal
loop = asyncio.new_event_loop()
loop.add_signal_handler(signal.SIGTERM, loop.stop)
"""


@pytest.mark.parametrize("order", ["loop first", "link first"])
def test_event_loops_get_their_signals(order: str, emulator: Emulated) -> None:
    """Both want the one descriptor of `signal.set_wakeup_fd`."""
    parts = [LOOP, DRIVER.replace("signal.SIGTERM, ", "")]
    code = "".join(parts if order == "loop first" else parts[::-1])
    code += """
robot.activate()
drive(30)
robot.deactivate()
print("stands", flush=True)
loop.run_forever()
loop.close()
print("told", flush=True)
"""
    with program(code, emulator.device) as process:
        assert first_line(process) == "stands"
        process.terminate()
        assert first_line(process) == "told"
        assert ended(process) == (0, "")
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
def test_a_forked_child_ends_without_a_word(end: str, emulator: Emulated) -> None:
    with program(DRIVER + FORK.format(end=end), emulator.device) as process:
        assert ended(process) == (0, "")
    assert_stopped(emulator)
    driving = [command != ZERO for command in emulator.commands()]
    first = driving.index(True)
    assert all(driving[first : first + 90])


TWO_SIGNALS = """
import contextlib, os, resource, signal, sys
from acsar_gym.guard import shutdown

resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


class Link:
    def held(self):
        return contextlib.nullcontext()

    def close(self):
        pass

    def abandon(self):
        pass


def interrupt_at(line):
    lines = 0

    def trace(frame, event, _):
        nonlocal lines
        if event == "line" and frame.f_code.co_filename.endswith(("shutdown.py", "threading.py")):
            lines += 1
            if lines == line:
                sys.settrace(None)
                signal.raise_signal(signal.SIGHUP)
        return trace

    return trace


children = []
for line in range(1, 17):
    child = os.fork()
    if child == 0:
        signal.alarm(10)
        link = Link()
        for number in (signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, signal.SIG_DFL)
        shutdown.close_at_exit(link)
        sys.settrace(interrupt_at(line))
        signal.raise_signal(signal.SIGTERM)
        os._exit(0)
    children.append(child)
ends = [os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) for child in children]
print({-end for end in ends} <= {signal.SIGTERM, signal.SIGHUP}, len(ends), ends, flush=True)
"""


def test_a_second_signal_in_the_handler_of_the_first_one_ends_the_program_too() -> None:
    with program(TWO_SIGNALS) as process:
        assert first_line(process).startswith("True 16 ")
