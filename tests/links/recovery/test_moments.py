"""A cable that is pulled at any moment of a link's life: one error each."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from nursery import first_line, program
from recovery_tools import drives, name, spoken
from serial_tools import (
    DRIVER,
    TIMEOUT,
    Emulated,
    StartEmulator,
    no_leak,
    wait_until,
)

from acsar_gym import RobotConfig
from acsar_gym.errors import (
    BoardSilentError,
    LinkLostError,
)
from acsar_gym.links.serial import SerialLink
from acsar_gym.protocol import ZERO, encode
from acsar_gym.worlds import Scene

pytestmark = [
    pytest.mark.usefixtures("deadline", "nursery"),
    pytest.mark.xdist_group("serial"),
]

FORWARD = encode((3.0, 3.0, 3.0, 3.0))


def test_pulled_before_the_first_line(start_emulator: StartEmulator, config: RobotConfig) -> None:
    """The port opens, and is gone before the board has said anything."""
    silent = start_emulator("--silent")
    code = f"""
import json, os, signal, time
while "rx" not in open({str(silent.log)!r}).read():
    time.sleep(0.01)
os.kill({silent.process.pid}, signal.SIGUSR1)
"""
    link = SerialLink(silent.device, config)
    with program(code) as helper, no_leak():
        with pytest.raises(LinkLostError) as caught:
            link.open()
        helper.wait(TIMEOUT)
    assert silent.device in caught.value.found
    assert not link.watchdog.is_alive
    link.close()


USES: dict[str, Callable[[SerialLink], object]] = {
    "write": lambda link: link.write(FORWARD),
    "advance": lambda link: link.advance(0.01),
    "read": lambda link: link.read_now(),
    "reset_input": lambda link: link.reset_input(),
    "reset": lambda link: link.reset(Scene()),
}


@pytest.mark.parametrize("use", USES)
def test_pulled_before_any_use_there_is_one_error(
    use: str, link: SerialLink, plugged: Emulated
) -> None:
    link.write(FORWARD)
    link.advance(0.01)
    plugged.pull()
    with pytest.raises(LinkLostError) as caught:
        USES[use](link)
    assert caught.value.fix
    link.stop()
    link.close()
    assert not link.watchdog.is_alive


@pytest.mark.parametrize("use", ["close", "stop"])
def test_pulled_before_the_end_there_is_none(use: str, link: SerialLink, plugged: Emulated) -> None:
    link.write(FORWARD)
    plugged.pull()
    getattr(link, use)()


def test_a_board_that_takes_no_bytes_holds_nobody_up(link: SerialLink, plugged: Emulated) -> None:
    plugged.pause()
    with pytest.raises(LinkLostError, match="takes no more bytes"):
        while True:
            link.write(encode(ZERO) * 200)
    link.close()
    plugged.resume()


def test_a_program_held_up_in_a_write_has_not_lost_its_port(
    link: SerialLink, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As on a busy machine: the bytes are all gone when it goes on."""
    write = os.write

    def held_up(descriptor: int, data: bytes) -> int:
        written = write(descriptor, data)
        time.sleep(3.0 * RobotConfig.preset("acsar").period)
        return written

    with monkeypatch.context() as busy:
        busy.setattr(os, "write", held_up)
        link.write(encode(ZERO))
    link.advance(0.01)


def test_a_board_frozen_while_the_port_opens_is_silent(
    plugged: Emulated, config: RobotConfig
) -> None:
    plugged.pause()
    frozen = SerialLink(name(plugged), config.with_(connect_timeout=0.4))
    link = SerialLink(name(plugged), config)
    with no_leak():
        with pytest.raises(BoardSilentError, match="no byte"):
            frozen.open()
        plugged.resume()
        link.open()
        link.close()


def test_a_signal_ends_a_program_that_waits_for_its_cable(emulator: Emulated) -> None:
    """It neither hangs until the time is up nor leaves the search undone."""
    code = """
import time
robot.activate()
try:
    drive(10**9)
except Exception:
    print('lost', flush=True)
robot.activate()
"""
    with program(DRIVER + code, name(emulator)) as process:
        drives(emulator)
        emulator.pull()
        assert first_line(process) == "lost"
        time.sleep(0.1)
        process.send_signal(signal.SIGINT)
        _, error = process.communicate(timeout=TIMEOUT)
    assert "KeyboardInterrupt" in error
    emulator.plug()
    wait_until(lambda: bool(spoken(emulator)), "a command")
    assert spoken(emulator) == {ZERO}


def test_a_few_of_a_thousand_pulls_leave_nothing_behind() -> None:
    replug = Path(__file__).parents[2] / "fuzz" / "replug.py"
    done = subprocess.run(
        [sys.executable, str(replug), "--cycles", "5", "--seed", "1", "--reconnect", "3"],
        check=False,
        capture_output=True,
        text=True,
        timeout=2 * TIMEOUT,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.startswith("5 cycles in ")
    assert ": 4 recovered, 1 reported, 0 neither; " in done.stdout
    assert done.stdout.endswith("child processes left: 0\n")
