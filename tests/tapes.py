"""Recordings to play back."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import tty
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import serial

from acsar_gym import Link, RobotConfig, open_link
from acsar_gym.protocol import ZERO, encode
from acsar_gym.recording import Recorder, read
from acsar_gym.recording.recorder import RecordedLink
from acsar_gym.recording.replay import ReplayLink
from acsar_gym.worlds import Scene

PERIOD = 0.01
TICKS = 310
"""Periods of a tape: 10 at rest, then the wheels turn."""
TURNING = encode((3.0, 3.0, 3.0, 3.0))


def taped(path: Path, config: RobotConfig) -> Path:
    """The planar robot, recorded: it stands, then its wheels turn."""
    with recorded(open_link("planar", config), path, config) as link:
        link.open()
        link.reset(Scene())
        for tick in range(TICKS):
            link.write(encode(ZERO) if tick < 10 else TURNING)
            link.advance(PERIOD)
        link.close()
    return path


@contextlib.contextmanager
def recorded(link: Link, path: Path, config: RobotConfig | None = None) -> Iterator[RecordedLink]:
    """A link that is recorded inside the block."""
    with Recorder(path) as recorder:
        yield RecordedLink(link, recorder, RobotConfig.of(config))


def play(tape: Path, master: int, heard: Any) -> None:
    """A tape player at the far end of the tty: one period's feedback for each command heard."""
    wrong = 0
    for episode in read(tape).episodes:
        writes = iter(episode.wire.sent)
        pieces = iter(episode.wire.got)
        for period in episode.exchanges:
            sent = b"".join(islice(writes, period["writes"]))
            wrong += _heard(master, len(sent)) != sent
            os.write(master, b"".join(islice(pieces, period["pieces"])))
        last = b"".join(writes)  # the stop at the end
        wrong += _heard(master, len(last)) != last
    heard.put(wrong)


def _heard(master: int, size: int) -> bytes:
    """So many bytes from the other end of the tty."""
    heard = b""
    while len(heard) < size:
        heard += os.read(master, size - len(heard))
    return heard


class TtyReplayLink(ReplayLink):
    """Reads the feedback of each period from a port, at which another program plays the tape."""

    def __init__(self, path: Path, port: serial.Serial) -> None:
        super().__init__(path)
        self._port = port

    def write(self, data: bytes) -> None:
        super().write(data)
        self._port.write(data)

    def advance(self, period: float) -> bytes:
        recorded = super().advance(period)
        arrived: bytes = self._port.read(len(recorded))
        assert len(arrived) == len(recorded)
        return arrived


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
