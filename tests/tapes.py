"""Recordings to play back."""

from __future__ import annotations

import contextlib
import json
import multiprocessing
import os
import tty
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import serial

from acsar_gym import RobotConfig, open_link
from acsar_gym.links import recording
from acsar_gym.protocol import ZERO, encode
from acsar_gym.worlds import Scene

PERIOD = 0.01
TICKS = 310
"""Periods of a tape: 10 at rest, then the wheels turn."""
TURNING = encode((3.0, 3.0, 3.0, 3.0))


def taped(path: Path, config: RobotConfig) -> Path:
    """The planar robot, recorded: it stands, then its wheels turn."""
    link = open_link("planar", config)
    link.open()
    link.reset(Scene())
    events: list[dict[str, object]] = [{"reset": link.now()}]
    for tick in range(TICKS):
        command = encode(ZERO) if tick < 10 else TURNING
        link.write(command)
        got = link.advance(PERIOD)
        events.append({"sent": command.decode(), "got": got.decode(), "t": link.now()})
    link.close()
    path.write_text("".join(json.dumps(event) + "\n" for event in events), encoding="ascii")
    return path


def play(tape: Path, master: int, heard: Any) -> None:
    """A tape player at the far end of the tty: one period's feedback for each command heard."""
    wrong = 0
    for episode in recording.read(tape):
        for period in episode.periods:
            command = b""
            while len(command) < len(period.sent):
                command += os.read(master, len(period.sent) - len(command))
            wrong += command != period.sent
            os.write(master, period.got)
    heard.put(wrong)


@contextlib.contextmanager
def playing(tape: Path) -> Iterator[tuple[serial.Serial, Any]]:
    """A port at which a process plays the tape, and a queue that says how many commands differ."""
    master, slave = os.openpty()
    tty.setraw(slave)
    fork = multiprocessing.get_context("fork")
    heard = fork.Queue()
    player = fork.Process(target=play, args=(tape, master, heard), daemon=True)
    player.start()
    port = serial.Serial(os.ttyname(slave), 115200, timeout=5.0, exclusive=True)
    yield port, heard
    port.close()
    player.terminate()
    player.join()
    os.close(master)
    os.close(slave)
