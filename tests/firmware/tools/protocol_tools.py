"""assets/firmware/acsar/protocol.c, compiled for this computer."""

from __future__ import annotations

import ctypes
import subprocess
from collections.abc import Sequence
from pathlib import Path

from acsar_gym.resources import ASSETS

SOURCE = ASSETS / "firmware" / "acsar" / "protocol.c"
STRICT = ("-Wall", "-Wextra", "-Werror", "-fsanitize=undefined", "-fno-sanitize-recover=all")
Four = ctypes.c_int16 * 4
UNTOLD = -32768


class State(ctypes.Structure):
    """struct parser."""

    _fields_ = (
        ("speeds", Four),
        ("named", ctypes.c_uint8),
        ("place", ctypes.c_uint8),
        ("motor", ctypes.c_uint8),
        ("backward", ctypes.c_uint8),
        ("value", ctypes.c_int16),
        ("length", ctypes.c_uint16),
    )


class Program:
    """Its parser, with the state of one stream, and its printer."""

    def __init__(self, library: Path) -> None:
        self._code = ctypes.CDLL(str(library))
        self._state = State()

    def take(self, data: bytes) -> list[dict[int, int]]:
        """The motors that each line names, with their speeds [0.01 rad/s]."""
        lines = []
        for byte in data:
            speeds = Four(*[UNTOLD] * 4)
            named = self._code.protocol_take(ctypes.byref(self._state), byte, speeds)
            commanded = {motor: speeds[motor] for motor in range(4) if speeds[motor] != UNTOLD}
            assert named == sum(1 << motor for motor in commanded)
            lines += [commanded] if commanded else []
        return lines

    def line(self, speeds: Sequence[int], *, comma: bool) -> bytes:
        """What it prints."""
        text = ctypes.create_string_buffer(34)
        length = self._code.protocol_line(Four(*speeds), comma, text)
        return text.raw[:length]


def compiled(folder: Path) -> Path:
    """Build it as a library that ctypes can load."""
    path = folder / "protocol.so"
    subprocess.run(["cc", "-shared", "-fPIC", "-O1", *STRICT, SOURCE, "-o", path], check=True)
    return path
