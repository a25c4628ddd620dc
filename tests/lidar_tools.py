"""A LiDAR in a room of known size, in a process of its own."""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from lidar_twins import MAKERS, let_wobble
from numpy.typing import NDArray
from processes import Program, first_line
from serial_tools import Emulated

from acsar_gym.config import RobotConfig
from acsar_gym.lidar.contract import Lidar
from acsar_gym.lidar.drivers import find_drivers
from acsar_gym.lidar.scan import Revolution
from acsar_gym.lidar.serial import SerialLidar
from acsar_gym.testing import wait_until
from acsar_gym.tools.emulation.lidar import LidarEmulator, LidarTwin
from acsar_gym.worlds import Scene

Floats = NDArray[np.float64]

AHEAD = 2.7
LEFT = 2.1
BEHIND = 1.3
RIGHT = 0.9
"""Distances of the walls of a room of 4 m x 3 m: no two directions are alike [m]."""
OTHER_DEVICE = b"$GPGGA,120000.00,5230.0,N,01322.0,E,1,08,0.9,34.0,M,,M,,*47\r\n"
"""Output of a GPS receiver."""
PERIOD = 0.005
LATE = 0.1
"""After a pause this long the emulator goes on from now [s]."""


def room(bearings: Floats, ages: Floats | None = None) -> Floats:
    """Ranges [m] at bearings [rad], counter-clockwise from the sensor's zero."""
    cos = np.cos(bearings)
    sin = np.sin(bearings)
    with np.errstate(divide="ignore"):
        along_x = np.where(cos > 0.0, AHEAD, -BEHIND) / cos
        along_y = np.where(sin > 0.0, LEFT, -RIGHT) / sin
    return np.minimum(np.abs(along_x), np.abs(along_y))


def nothing(bearings: Floats, ages: Floats | None = None) -> Floats:
    """An empty plain."""
    return np.full(len(bearings), np.inf)


def start_lidar(log: Path, *arguments: str) -> Emulated:
    """A sensor that serves. `log` gets a line each time it starts a turn or changes its state."""
    process = Program("import lidar_tools; lidar_tools.main()", "--log", str(log), *arguments)
    emulated = Emulated(process, first_line(process), log)
    if not emulated.device.startswith("/dev/"):
        emulated.end()
        raise AssertionError(f"no device from {arguments}")
    return emulated


def state(emulated: Emulated) -> tuple[bool, bool]:
    """Whether it scans, and whether its motor runs."""
    newest = [event for event in emulated.events() if "running" in event][-1]
    return bool(newest["scanning"]), bool(newest["running"])


def turns(emulated: Emulated) -> list[float]:
    """When it began its turns, on the monotonic clock [s]."""
    return [event["t"] for event in emulated.events() if "turn" in event]


def main() -> None:
    """Print the device, and serve until killed."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--log", type=Path, required=True)
    parser.add_argument("--model", default="rplidar")
    parser.add_argument("--rate", type=float, default=20.0)
    parser.add_argument("--wobble", type=float, default=0.0)
    parser.add_argument("--baud", type=int)
    parser.add_argument("--fault", choices=["silent", "garbage", "stuck", "broken"])
    options = parser.parse_args()
    maker = MAKERS[options.model]
    twin = maker.twin(room, **{"rate": options.rate, **maker.options})
    let_wobble(twin, options.wobble)
    with options.log.open("w", encoding="ascii", buffering=1) as log:

        def note(**event: object) -> None:
            log.write(json.dumps({"t": time.monotonic(), **event}) + "\n")

        baud = options.baud or maker.baud
        spoil(twin, options.fault)
        with contextlib.closing(LidarEmulator(twin, baud=baud)) as emulator:
            print(emulator.device, flush=True)
            serve(emulator, note)


HEALTHY = bytes.fromhex("a5 5a 03 00 00 00 06 00 00 00")
BROKEN = bytes.fromhex("a5 5a 03 00 00 00 06 02 01 80")
"""Answers of an RPLIDAR about its health."""


def spoil(twin: LidarTwin, fault: str | None) -> None:
    """Give a sensor a fault."""
    receive = twin.receive
    if fault == "broken":
        twin.receive = lambda data: receive(data).replace(HEALTHY, BROKEN)  # type: ignore[method-assign]
    elif fault:
        sent = OTHER_DEVICE if fault == "garbage" else b""
        twin.advance = lambda dt: sent  # type: ignore[method-assign]
    if fault in ("silent", "garbage"):
        twin.receive = lambda data: b""  # type: ignore[method-assign]


def serve(emulator: LidarEmulator, note: Callable[..., None]) -> None:
    """Serve in real time, and note what changes."""
    last_state = None
    turns = 0
    deadline = time.monotonic()
    while True:
        emulator.serve_once(PERIOD)
        state = (emulator.twin.scanning, emulator.twin.running)
        if state != last_state:
            note(scanning=state[0], running=state[1])
            last_state = state
        if emulator.twin.turns > turns:
            note(turn=True)
            turns = emulator.twin.turns
        deadline = max(deadline + PERIOD, time.monotonic() - LATE)
        time.sleep(max(0.0, deadline - time.monotonic()))


ROUNDED = 0.003
"""What wires and lds2d round away [m]."""

MODELS = ("rplidar", "ld06", "ydlidar_x4")
"""A LiDAR that is asked for turns, another that always sends them, and a third that splits them."""

Start = Callable[..., Emulated]
Open = Callable[..., SerialLidar]


def open_serial(
    device: Emulated | str, model: str = "rplidar", timeout: float = 20.0
) -> SerialLidar:
    """A closed LiDAR on a device."""
    config = RobotConfig.preset("acsar").with_(lidar={"timeout": timeout}, reconnect_timeout=0.5)
    name = device if isinstance(device, str) else device.device
    return SerialLidar(name, find_drivers()[model], config, time.monotonic)


def reset(lidar: Lidar) -> None:
    lidar.reset(Scene(), np.random.default_rng(0))


def measure(lidar: SerialLidar) -> Revolution:
    reset(lidar)
    turn = lidar.scan()
    lidar.close()
    return turn


def newer(lidar: SerialLidar, than: float) -> Revolution:
    """The first turn after that."""
    wait_until(lambda: lidar.scan().stamp > than, "a newer turn")
    return lidar.scan()


def shows_the_room(turn: Revolution) -> bool:
    """Whether each measurement is of the wall at its bearing, and together they go all around."""
    gaps = np.diff(np.sort(turn.bearings))
    near = np.stack([room(turn.bearings + off) for off in np.radians((-0.1, 0.0, 0.1))])
    return bool(
        len(turn.bearings) == len(turn.distances) == len(turn.times)
        and (np.abs(turn.bearings) <= math.pi).all()
        and np.degrees(gaps.max()) < 5.0
        and (turn.distances >= near.min(axis=0) - ROUNDED).all()
        and (turn.distances <= near.max(axis=0) + ROUNDED).all()
        and (np.diff(turn.times) >= 0.0).all()
        and turn.times[-1] == turn.stamp
    )


def show_turned(turn: Revolution) -> Floats:
    """The angle between each measurement and the next [rad]."""
    return (np.diff(turn.bearings) + math.pi) % (2.0 * math.pi) - math.pi
