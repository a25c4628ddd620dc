"""The RPLIDAR's twin: every byte as published. tests/lidar/serial reads it by another library."""

from __future__ import annotations

import contextlib
import os
import tty
from typing import Any

import numpy as np
import pytest
from lidar_tools import nothing, room

from acsar_gym.tools.emulation.lidar import LidarEmulator, Look, RplidarTwin

SCAN = b"\xa5\x20"
SCAN_DESCRIPTOR = bytes.fromhex("a5 5a 05 00 00 40 81")
STOP = b"\xa5\x25"
START_MOTOR = bytes.fromhex("a5 f0 02 94 02 c1")


def scanning(look: Look, **options: Any) -> RplidarTwin:
    twin = RplidarTwin(look, **options)
    assert twin.receive(SCAN) == SCAN_DESCRIPTOR
    return twin


@pytest.mark.parametrize(
    ("request_", "answer"),
    [
        ("a5 50", "a5 5a 14 00 00 00 04 18 10 01 07 " + bytes(range(16)).hex()),
        ("a5 82 05 00 00 00 00 00 22", ""),
        ("00 5a a5 52", "a5 5a 03 00 00 00 06 00 00 00"),
    ],
)
def test_receive_answers_as_published(request_: str, answer: str) -> None:
    data = bytes.fromhex(request_)
    assert RplidarTwin(nothing).receive(data) == bytes.fromhex(answer)
    twin = RplidarTwin(nothing)
    assert b"".join(twin.receive(bytes([byte])) for byte in data) == bytes.fromhex(answer)


def test_encode_makes_five_bytes_as_published() -> None:
    twin = scanning(lambda bearings, ages: np.ones(len(bearings)), rate=1.0, samples=4)
    assert twin.advance(1.0) == bytes.fromhex(
        "3e 01 2d a0 0f"  # 90 deg * 64 = 0x1680, and the check bit. 1000 mm * 4 = 0x0fa0
        "3e 01 5a a0 0f"  # quality 15, and no start: 0b111110
        "3e 01 87 a0 0f"
        "3d 01 00 a0 0f"  # 0 deg starts a turn: 0b111101
    )


@pytest.mark.parametrize(
    ("request_", "goes_on"), [(STOP, False), (b"\xa5\x50", False), (START_MOTOR, True)]
)
def test_receive_ends_a_scan_except_for_the_motor(request_: bytes, goes_on: bool) -> None:
    twin = scanning(room)
    twin.receive(request_)
    assert bool(twin.advance(0.1)) is goes_on


def test_lidar_emulator_serves_a_client_and_drops_unread_data() -> None:
    twin = RplidarTwin(room, rate=10.0, samples=360)
    with contextlib.closing(LidarEmulator(twin)) as emulator:
        port = os.open(emulator.device, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        tty.setraw(port)
        os.write(port, SCAN)
        emulator.serve_once(0.1)
        data = os.read(port, 4096)
        assert data.startswith(SCAN_DESCRIPTOR)
        assert len(data) == 7 + 5 * 360

        # Data that nobody reads fills no buffer.
        for _ in range(1000):
            emulator.serve_once(0.05)
        os.write(port, STOP)
        emulator.serve_once(0.05)
        assert not emulator.twin.scanning
        os.close(port)
