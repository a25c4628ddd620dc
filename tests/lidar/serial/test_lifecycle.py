"""A LiDAR that is opened, closed, forked, suspended, or left behind."""

from __future__ import annotations

import gc
import threading
import time

import pytest
from lidar_tools import (
    MODELS,
    Open,
    Start,
    measure,
    newer,
    open_serial,
    reset,
    shows_the_room,
    state,
    turns,
)
from lidar_twins import MAKERS
from processes import first_line, program
from serial_tools import TIMEOUT, Emulated, no_leak, wait_until

from acsar_gym.errors import LidarError

pytestmark = pytest.mark.usefixtures("deadline")

PROGRAM = """
import os, resource, signal, sys, time
import numpy as np
from acsar_gym import RobotConfig
from acsar_gym.lidar.drivers import find_drivers
from acsar_gym.lidar.serial import SerialLidar
from acsar_gym.worlds import Scene

resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
config = RobotConfig.preset("acsar").with_(lidar={"timeout": 20.0})
lidar = SerialLidar(sys.argv[1], find_drivers()["rplidar"], config, time.monotonic)
lidar.reset(Scene(), np.random.default_rng(0))
print("scanning", flush=True)
"""
"""Beginning of a program that scans with the device in argv[1]."""


@pytest.mark.parametrize("model", MAKERS)
def test_close_stops_scan_and_motor(start: Start, make: Open, model: str) -> None:
    emulated = start("--model", model)
    lidar = make(emulated, model)
    with no_leak():
        reset(lidar)
        assert state(emulated) == (True, True)
        lidar.close()
        lidar.close()
    if MAKERS[model].stops:
        wait_until(lambda: not any(state(emulated)), "a stop")
    with pytest.raises(LidarError, match=r"is closed: call reset\(\) first"):
        lidar.scan()


def test_serial_lidar_leaves_nothing_behind(sensor: Emulated) -> None:
    threads = threading.active_count()
    with no_leak():
        lidar = open_serial(sensor)
        for _ in range(10):
            assert shows_the_room(measure(lidar))
            assert threading.active_count() == threads
        reset(lidar)
        del lidar
        gc.collect()
        assert threading.active_count() == threads


@pytest.mark.parametrize("ending", ["os.kill(os.getpid(), signal.SIGTERM)", "pass"])
def test_serial_lidar_stops_its_motor_at_the_end_of_a_process(
    sensor: Emulated, ending: str
) -> None:
    with program(PROGRAM + ending, sensor.device) as process:
        assert first_line(process) == "scanning"
        process.communicate(timeout=TIMEOUT)
    wait_until(lambda: not any(state(sensor)), "a stop")


FORK = """
child = os.fork()
if child == 0:
    sys.exit()
os.waitpid(child, 0)
stamp = lidar.scan().stamp
while lidar.scan().stamp == stamp:
    time.sleep(0.01)
print("goes on", flush=True)
"""


def test_serial_lidar_goes_on_after_a_fork(sensor: Emulated) -> None:
    with program(PROGRAM + FORK, sensor.device) as process:
        assert [first_line(process) for _ in range(2)] == ["scanning", "goes on"]
        process.communicate(timeout=TIMEOUT)
    wait_until(lambda: not any(state(sensor)), "a stop")


def test_serial_lidar_opens_a_device_that_still_scans(sensor: Emulated, make: Open) -> None:
    with program(PROGRAM + "os.kill(os.getpid(), signal.SIGKILL)", sensor.device) as process:
        process.communicate(timeout=TIMEOUT)
    assert state(sensor)[0]
    assert shows_the_room(measure(make(sensor)))


@pytest.mark.parametrize("model", MODELS)
def test_serial_lidar_stamps_a_turn_when_it_ended(start: Start, make: Open, model: str) -> None:
    emulated = start("--model", model, "--rate", "5.5")
    lidar = make(emulated, model)
    reset(lidar)
    stamp = newer(lidar, lidar.scan().stamp).stamp
    assert stamp <= time.monotonic()
    # The emulator logs when it has sent the beginning of the next turn.
    assert min(abs(end - stamp) for end in turns(emulated)) < 0.4 / 5.5
