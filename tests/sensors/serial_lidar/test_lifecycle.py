"""An RPLIDAR that is opened, closed, forked, suspended, or left behind."""

from __future__ import annotations

import copy
import gc
import pickle
import threading
import time

import pytest
from lds2d.drivers import rplidar as library
from lidar_tools import room, state
from rplidar_tools import MAX, Open, Start, measure, newer, reset, shows_the_room
from serial_tools import TIMEOUT, Emulated, first_line, no_leak, program, wait_until

from acsar_gym import RobotConfig
from acsar_gym.errors import LidarError
from acsar_gym.odometry import Odometry
from acsar_gym.sensors import rplidar
from acsar_gym.sensors.rplidar import RplidarLidar, TurnDecoder
from acsar_gym.tools.emulation.rplidar import RplidarTwin

pytestmark = pytest.mark.usefixtures("deadline")

STANDSTILL = (False, 0)

PROGRAM = """
import os, resource, signal, sys, time
import numpy as np
from acsar_gym import RobotConfig
from acsar_gym.sensors.rplidar import RplidarLidar
from acsar_gym.worlds import Scene

resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
config = RobotConfig.preset("acsar").with_(lidar={"timeout": 20.0})
lidar = RplidarLidar(sys.argv[1], config, time.monotonic)
lidar.reset(Scene(), np.random.default_rng(0))
print("scanning", flush=True)
"""
"""Beginning of a program that scans with the device in argv[1]."""


def test_closing_stops_scan_and_motor_and_twice_is_once(start: Start, make: Open) -> None:
    emulated = start()
    lidar = make(emulated)
    lidar.close()
    with no_leak():
        reset(lidar)
        assert state(emulated) == (True, 660)
        lidar.close()
        lidar.close()
    wait_until(lambda: state(emulated) == STANDSTILL, "a stop")
    with pytest.raises(LidarError, match=r"is closed: call reset\(\) first"):
        lidar.scan()


def test_opened_closed_or_forgotten_it_leaves_nothing_behind(sensor: Emulated) -> None:
    config = RobotConfig.preset("acsar").with_(lidar={"timeout": 20.0})
    threads = threading.active_count()
    with no_leak():
        lidar = RplidarLidar(sensor.device, config, time.monotonic)
        for _ in range(10):
            assert measure(lidar).max() < MAX
            assert threading.active_count() == threads
        reset(lidar)
        del lidar
        gc.collect()
        assert threading.active_count() == threads


def test_copies_and_pickles_are_closed(sensor: Emulated, make: Open) -> None:
    lidar = make(sensor)
    reset(lidar)
    for twin in (copy.copy(lidar), copy.deepcopy(lidar), pickle.loads(pickle.dumps(lidar))):  # noqa: S301
        assert twin.device == lidar.device
        with pytest.raises(LidarError, match="is closed"):
            twin.scan()
    newer(lidar, time.monotonic())


def test_it_spins_up_from_standstill(start: Start, make: Open) -> None:
    emulated = start("--spin-up", "0.5", "--rate", "5.5", "--baud", "460800")  # a C1's
    lidar = make(emulated)
    for _ in range(2):
        reset(lidar)
        assert lidar.scan().ranges.max() < MAX
        lidar.close()
        wait_until(lambda: state(emulated) == STANDSTILL, "a stop")


@pytest.mark.parametrize("ending", ["os.kill(os.getpid(), signal.SIGTERM)", "pass"])
def test_a_process_that_ends_stops_the_motor(sensor: Emulated, ending: str) -> None:
    with program(PROGRAM + ending, sensor.device) as process:
        assert first_line(process) == "scanning"
        process.communicate(timeout=TIMEOUT)
    wait_until(lambda: state(sensor) == STANDSTILL, "a stop")


def test_after_a_crash_it_is_opened_while_it_still_scans(sensor: Emulated, make: Open) -> None:
    with program(PROGRAM + "os.kill(os.getpid(), signal.SIGKILL)", sensor.device) as process:
        process.communicate(timeout=TIMEOUT)
    assert state(sensor)[0]
    assert shows_the_room(measure(make(sensor, rays=180)))


def test_a_forked_child_leaves_its_parents_device_alone(sensor: Emulated) -> None:
    forking = """
if os.fork() == 0:
    try:
        lidar.scan()
    except Exception as error:
        print(type(error).__name__, flush=True)
    lidar.close()
    sys.exit()
os.wait()
before = time.monotonic()
while lidar.scan().stamp < before:
    time.sleep(0.01)
print("goes on", flush=True)
"""
    with program(PROGRAM + forking, sensor.device) as process:
        said, complaints = process.communicate(timeout=TIMEOUT)
    assert said.split("\n")[1:3] == ["LidarError", "goes on"]
    assert not complaints


class SlowPort:
    """A port whose reader sleeps now and then; what it missed is as old as its sleep."""

    def __init__(self) -> None:
        self.twin = RplidarTwin(room, rate=20.0, samples=100)
        self.twin.receive(b"\xa5\x20")
        self.pause = 0.0
        self.flushed = 0

    def read(self, size: int) -> bytes:
        time.sleep(self.pause)
        return self.twin.advance(0.005 + self.pause)[-size:]

    def reset_input_buffer(self) -> None:
        self.flushed += 1


def test_what_was_missed_is_dropped_not_stamped_as_new() -> None:
    port = SlowPort()
    config = RobotConfig()
    reader = rplidar._Reader(
        port, TurnDecoder(library), config, time.monotonic, Odometry.of(config)
    )
    reader.start()
    wait_until(lambda: reader.newest is not None, "a turn")
    port.pause = 0.2
    wait_until(lambda: port.flushed > 2, "flushes")
    stale = reader.newest
    time.sleep(0.5)
    assert reader.newest is stale
    port.pause = 0.0
    wait_until(lambda: reader.newest is not stale, "a turn")
    reader.running = False
    reader.join()
