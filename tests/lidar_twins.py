"""LiDARs of other makers than SLAMTEC, as their manuals describe them, without code of lds2d."""

from __future__ import annotations

import functools
import math
import operator
import struct
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from acsar_gym.tools.emulation.lidar import (
    MULTIPLE,
    SINGLE,
    Floats,
    LidarTwin,
    RplidarTwin,
    encode_descriptor,
)

WAVE = 2.0 * math.pi / 10.0
"""A wobbling head gets faster and slower once in ten turns [rad/turn]."""


class PacketTwin(LidarTwin):
    """Sends measurements when a packet is full.

    Or a turn begins, if it `splits`. An `aligned` LiDAR has its first packet at zero degrees.
    """

    size = 1
    splits = aligned = False
    wobble = 0.0

    @property
    def speed(self) -> float:
        """Turns per second [Hz]."""
        return self._rate * (1.0 + self.wobble * math.cos(self._now * self._rate * WAVE))

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self._waiting: list[tuple[float, float, bool]] = []

    def encode(self, degrees: Floats, ranges: Floats, starts: NDArray[np.bool_]) -> bytes:
        sent = b""
        new = zip(degrees.tolist(), ranges.tolist(), starts.tolist(), strict=True)
        for number, (degree, distance, start) in enumerate(new):
            if self.aligned and not self._waiting and round(degree) % self.size:
                continue
            if self.splits and start and self._waiting:
                sent += self._flush()
            self._waiting.append((degree, distance, start))
            if len(self._waiting) == self.size or (self.splits and start):
                remaining = len(degrees) - 1 - number
                sent += self._flush(remaining / (self._rate * self._samples))
        return sent

    def _flush(self, age: float = 0.0) -> bytes:
        full = self._waiting
        self._waiting = []
        return self.pack([d for d, _, _ in full], [r for _, r, _ in full], full[0][2], age)

    def pack(self, degrees: list[float], ranges: list[float], starts: bool, age: float) -> bytes:
        raise NotImplementedError


def crc8(data: bytes) -> int:
    """With polynomial 0x4D."""
    value = 0
    for byte in data:
        value ^= byte
        for _ in range(8):
            value = (value << 1 ^ 0x4D if value & 0x80 else value << 1) & 0xFF
    return value


class LdrobotTwin(PacketTwin):
    """An LD06 measures as long as it has power. An LD14P takes commands."""

    size = 12

    def __init__(self, *args: Any, takes_commands: bool = False, **options: Any) -> None:
        super().__init__(*args, **options)
        self._takes_commands = takes_commands

    def receive(self, data: bytes) -> bytes:
        for command, running in ((0xA0, True), (0xA1, False)):
            body = bytes((0x54, command, 4, 0, 0, 0, 0))
            if self._takes_commands and body + bytes([crc8(body)]) in data:
                self.running = self.scanning = running
        return b""

    def pack(self, degrees: list[float], ranges: list[float], starts: bool, age: float) -> bytes:
        first, last = (round(degree * 100.0) % 36000 for degree in (degrees[0], degrees[-1]))
        body = struct.pack("<BBHH", 0x54, 0x2C, round(self.speed * 360.0), first)
        for distance in ranges:
            body += struct.pack("<HB", round(distance * 1000.0), 200 if distance else 0)
        body += struct.pack("<HH", last, round((self._now - age) * 1000.0) % 30000)
        return body + bytes([crc8(body)])


class TminiProTwin(PacketTwin):
    """A T-mini Pro: its beam goes where the head points. An intensity precedes each distance."""

    size = 40
    splits = True
    word_bits = ~3
    has_intensity = True

    def pack(self, degrees: list[float], ranges: list[float], starts: bool, age: float) -> bytes:
        first, last = (round(degree * 64.0) << 1 | 1 for degree in (degrees[0], degrees[-1]))
        kind = min(round(self.speed * 10.0), 127) << 1 | 1 if starts else 0
        check = 0x55AA ^ (kind | len(ranges) << 8) ^ first ^ last
        samples = b""
        for number, distance in enumerate(ranges):
            word = round(distance * 4000.0) & self.word_bits
            intensity = bytes([number * 37 & 0xFF] * self.has_intensity)
            check ^= word ^ int.from_bytes(intensity)
            samples += intensity + struct.pack("<H", word)
        fields = (0x55AA, kind, len(ranges), first, last, check)
        return struct.pack("<HBBHHH", *fields) + samples


class YdlidarTwin(TminiProTwin):
    """An X4, which looks past its laser's lens: the beam deviates from the head's angle."""

    word_bits = -1
    has_intensity = False

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self.running = self.scanning = False

    def receive(self, data: bytes) -> bytes:
        answer = b""
        for command in data.split(b"\xa5")[1:]:
            if command[:1] in (b"\x65", b"\x00"):
                self.running = self.scanning = False
            elif command[:1] == b"\x60":
                self.running = self.scanning = True
                answer = bytes.fromhex("a5 5a 05 00 00 40 81")
        return answer

    def measure(self, degrees: Floats, ages: Floats) -> Floats:
        beams = degrees
        for _ in range(8):
            ranges = super().measure(beams, ages)
            millimetres = np.maximum(np.rint(ranges * 4000.0) / 4.0, 1e-3)
            off = np.degrees(np.arctan(21.8 * (155.3 - millimetres) / (155.3 * millimetres)))
            beams = degrees + np.where(ranges > 0.0, off, 0.0)
        return ranges


class DenseRplidarTwin(RplidarTwin):
    """An RPLIDAR S2: its typical mode, of number 1, sends dense capsules."""

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self._is_dense = False
        self._words: list[int] = []

    def _answer(self, request: bytes) -> bytes:
        command = request[1]
        payload = request[3:-1]
        is_whole = functools.reduce(operator.xor, request) == 0
        if command == 0xA8 and is_whole:
            self.running = struct.unpack("<H", payload)[0] > 0
        elif command == 0x84 and is_whole:
            answer = {0x7C: b"\x01\x00", 0x75: b"\x85"}[payload[0]]
            return encode_descriptor(4 + len(answer), SINGLE, 0x20) + payload[:4] + answer
        elif command == 0x82 and is_whole and payload[0] == 1:
            self.scanning = self._is_dense = self._is_first = True
            self._words = []
            return encode_descriptor(84, MULTIPLE, 0x85)
        return super()._answer(request) if command < 0x80 else b""

    def encode(self, degrees: Floats, ranges: Floats, starts: NDArray[np.bool_]) -> bytes:
        if not self._is_dense:
            return super().encode(degrees, ranges, starts)
        sent = b""
        for degree, distance in zip(degrees.tolist(), ranges.tolist(), strict=True):
            if not self._words:
                self._words = [round(degree * 64.0) % (360 * 64) | self._is_first << 15]
            self._words.append(round(distance * 1000.0))
            if len(self._words) == 41:
                body = struct.pack("<41H", *self._words)
                check = functools.reduce(operator.xor, body)
                sent += bytes((0xA0 | check & 15, 0x50 | check >> 4)) + body
                self._words = []
                self._is_first = False
        return sent


class NeatoTwin(PacketTwin):
    """An XV-11 measures once a degree, counter-clockwise."""

    size = 4
    aligned = True

    def advance(self, dt: float) -> bytes:
        self.pace = self.speed * self._samples
        return super().advance(dt)

    def measure(self, degrees: Floats, ages: Floats) -> Floats:
        return super().measure(-degrees, ages)

    def pack(self, degrees: list[float], ranges: list[float], starts: bool, age: float) -> bytes:
        speed = min(round(self.speed * 3840.0), 0xFFFF)  # rpm * 64
        body = struct.pack("<BBH", 0xFA, 0xA0 + round(degrees[0]) // 4, speed)
        for distance in ranges:
            body += struct.pack("<HH", round(distance * 1000.0) or 0x8035, 300)
        total = 0
        for (word,) in struct.iter_unpack("<H", body):
            total = (total << 1) + word
        return body + struct.pack("<H", ((total & 0x7FFF) + (total >> 15)) & 0x7FFF)


def let_wobble(twin: LidarTwin, share: float) -> None:
    """Let a head get faster and slower by this share."""

    def turn(numbers: NDArray[np.int64]) -> Floats:
        turns = numbers / twin._samples
        return turns + share / WAVE * np.sin(turns * WAVE)

    twin.wobble = share  # type: ignore[attr-defined]
    if not isinstance(twin, NeatoTwin):
        twin.turn = turn  # type: ignore[method-assign]


class Maker(NamedTuple):
    """How the LiDAR of a maker is emulated."""

    twin: Callable[..., LidarTwin]
    baud: int
    options: Mapping[str, Any] = {}
    stops: bool = True
    """Whether it can be told to stop."""
    scan: bytes = b""
    """What makes it measure."""


MAKERS = {
    "rplidar": Maker(RplidarTwin, 115200, {"samples": 360}, scan=b"\xa5\x20"),
    "rplidar_a3": Maker(RplidarTwin, 256000, {"samples": 400}, scan=b"\xa5\x20"),
    "rplidar_s2": Maker(
        DenseRplidarTwin,
        1_000_000,
        {"samples": 3200},
        scan=bytes.fromhex("a5 82 05 01 00 00 00 00 23"),
    ),
    "ld06": Maker(LdrobotTwin, 230400, {"samples": 450}, stops=False),
    "ld14p": Maker(LdrobotTwin, 230400, {"samples": 384, "takes_commands": True}),
    "ydlidar_x4": Maker(YdlidarTwin, 128000, {"samples": 500}, scan=b"\xa5\x60"),
    "ydlidar_tmini_pro": Maker(TminiProTwin, 230400, {"samples": 660}, stops=False),
    "neato": Maker(NeatoTwin, 115200, {"samples": 360}, stops=False),
}
"""By the model's name in a URL."""
