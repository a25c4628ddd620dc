"""Forks, recordings and second signals while a program ends."""

from __future__ import annotations

import signal
from pathlib import Path

import numpy as np
import pytest
from nursery import ended, first_line, program
from serial_tools import BRIDGE, DRIVER, Emulated, wait_until
from shutdown_tools import FOREVER, IN_BLOCK, assert_stopped, drives

from acsar_gym.protocol import ZERO
from acsar_gym.recording import read

pytestmark = [
    pytest.mark.usefixtures("deadline", "nursery"),
    pytest.mark.xdist_group("serial"),
]

UNWATCHED = "robot = Robot(open_link(sys.argv[1], config.with_(watchdog_timeout=None)), config)"

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


@pytest.mark.parametrize(
    "end",
    [
        "os._exit(0)",
        "sys.exit()",
    ],
)
def test_a_forked_child_leaves_the_socket_of_its_parent_alone(end: str, shared_device: str) -> None:
    with program(BRIDGE, shared_device) as bridge:
        url = f"socket://127.0.0.1:{first_line(bridge)}"
        with program(DRIVER + FORK.format(end=end), url) as process:
            assert ended(process) == (0, "")


def test_a_recording_is_complete_when_a_signal_ends_the_program(
    emulator: Emulated, tmp_path: Path
) -> None:
    tape = tmp_path / "tape.mcap"
    recorder = """
from acsar_gym.recording import Recorder
robot = Robot(robot.link, config, recorder=Recorder(sys.argv[2]))
"""
    code = DRIVER + recorder + IN_BLOCK.format(ticks=FOREVER, end="pass")
    with program(code, emulator.device, str(tape)) as process:
        drives(emulator)
        process.terminate()
        assert ended(process) == (-signal.SIGTERM, "")
    assert_stopped(emulator)
    recording = read(tape)
    assert not recording.cut
    driven = sum(command != ZERO for command in emulator.commands())
    _, sent = recording.episodes[0].wire.commands(recording.config)
    assert driven - 1 <= np.count_nonzero(sent.any(axis=1)) <= driven


def test_without_a_watchdog_the_boards_own_timeout_is_left(emulator: Emulated) -> None:
    """SIGKILL leaves no time for a zero command; it shows that the tests above can fail."""
    code = DRIVER + UNWATCHED + IN_BLOCK.format(ticks=FOREVER, end="pass")
    with program(code, emulator.device) as process:
        drives(emulator)
        process.kill()
        assert ended(process)[0] == -signal.SIGKILL
    wait_until(emulator.stands, "a robot that stands")
    assert emulator.is_driven()


TWO_SIGNALS = """
import contextlib, os, resource, signal, sys, time
from acsar_gym.links import shutdown

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
        link = Link()
        for number in (signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, signal.SIG_DFL)
        shutdown.close_at_exit(link)
        sys.settrace(interrupt_at(line))
        signal.raise_signal(signal.SIGTERM)
        os._exit(0)
    children.append(child)
ended, deadline = set(), time.monotonic() + 10.0
while len(ended) < len(children) and time.monotonic() < deadline:
    for child in set(children) - ended:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            assert os.WIFSIGNALED(status)
            ended.add(child)
    time.sleep(0.01)
for child in set(children) - ended:
    os.kill(child, signal.SIGKILL)
print(f"{len(ended)} of {len(children)} ended", flush=True)
"""


def test_a_second_signal_in_the_handler_of_the_first_one_ends_the_program_too() -> None:
    with program(TWO_SIGNALS) as process:
        assert first_line(process) == "16 of 16 ended"
