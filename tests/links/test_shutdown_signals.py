"""Signals that threads learn of before Python has run their handlers."""

from __future__ import annotations

import signal

import pytest
from nursery import ended, first_line, program
from serial_tools import DRIVER, Emulated
from shutdown_tools import assert_stopped, drives

pytestmark = [
    pytest.mark.usefixtures("deadline", "nursery"),
    pytest.mark.xdist_group("serial"),
]

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


@pytest.mark.parametrize("number", [signal.SIGINT, None], ids=["Ctrl-C", "exception"])
def test_a_robot_that_only_a_thread_of_asyncio_knows_is_stopped(
    number: signal.Signals | None, emulator: Emulated
) -> None:
    """The main thread doesn't end: it waits for the thread."""
    code = """
import asyncio

def work():
    exec(sys.argv[2], globals())
    robot.activate()
    try:
        drive(10**9)
    finally:
        print("thread ends", flush=True)

async def main():
    thread = asyncio.create_task(asyncio.to_thread(work))
    if sys.argv[3] == "None":
        while "robot" not in globals() or robot.odometry.pose[0] < 0.02:
            await asyncio.sleep(0.01)
        raise RuntimeError
    await thread

asyncio.run(main())
"""
    start, robot = DRIVER.split("config = ", 1)
    with program(start + code, emulator.device, f"config = {robot}", str(number)) as process:
        drives(emulator)
        if number is not None:
            process.send_signal(number)
        assert first_line(process) == "thread ends"
        status, error = ended(process)
    assert status == (1 if number is None else -signal.SIGINT)
    assert ("RuntimeError" if number is None else "KeyboardInterrupt") in error
    assert_stopped(emulator)


def test_an_executor_s_thread_is_stopped_when_its_block_fails(emulator: Emulated) -> None:
    """Not while the main thread waits at the block's end as planned."""
    code = """
import time
from concurrent.futures import ThreadPoolExecutor

robot.activate()
with ThreadPoolExecutor() as pool:
    planned = pool.submit(drive, 30)
planned.result()
with ThreadPoolExecutor() as pool:
    pool.submit(drive, 10**9)
    time.sleep(0.1)
    raise RuntimeError
"""
    with program(DRIVER + code, emulator.device) as process:
        status, error = ended(process)
    assert status == 1
    assert error.endswith("RuntimeError\n")
    assert_stopped(emulator)


def test_the_main_thread_drives_on_after_a_handler_of_its_own(emulator: Emulated) -> None:
    code = """
signal.signal(signal.SIGTERM, lambda *_: None)
robot.activate()
drive(10)
signal.raise_signal(signal.SIGTERM)
drive(30)
"""
    with program(DRIVER + THREAD + code, emulator.device) as process:
        assert ended(process) == (0, "")
    assert_stopped(emulator)


def test_other_signals_do_not_matter(emulator: Emulated) -> None:
    """SIGHUP is one of them where the program handles it: servers read their settings again."""
    code = """
numbers = signal.SIGUSR1, signal.SIGCHLD, signal.SIGWINCH, signal.SIGHUP
robot.activate()
for number in numbers:
    signal.signal(number, lambda *_: None)
    signal.raise_signal(number)
    thread, errors = in_a_thread(lambda: drive(20))
    thread.join()
    assert not errors, errors
"""
    with program(DRIVER + THREAD + code, emulator.device) as process:
        assert ended(process) == (0, "")
    assert_stopped(emulator)


def test_signals_of_a_forked_child_are_its_own(emulator: Emulated) -> None:
    code = """
robot.activate()
thread, errors = in_a_thread(lambda: drive(60))
child = os.fork()
if child == 0:
    signal.signal(signal.SIGTERM, lambda *_: None)
    signal.raise_signal(signal.SIGTERM)
    os._exit(0)
thread.join()
assert os.waitpid(child, 0)[1] == 0
assert not errors, errors
"""
    with program(DRIVER + THREAD + code, emulator.device) as process:
        assert ended(process) == (0, "")
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


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_thread_that_ends_in_time_is_not_refused(
    number: signal.Signals, emulator: Emulated
) -> None:
    """A program that ends in good order isn't disturbed."""
    code = f"""
done = threading.Event()
signal.signal(signal.{number.name}, lambda *_: done.set())

def drive_until_done():
    while not done.is_set():
        drive(1)
    robot.deactivate()

robot.activate()
thread, errors = in_a_thread(drive_until_done)
thread.join()
assert not errors, errors
"""
    with program(DRIVER + THREAD + code, emulator.device) as process:
        drives(emulator)
        process.send_signal(number)
        assert ended(process) == (0, "")
    assert_stopped(emulator)
