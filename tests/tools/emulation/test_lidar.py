"""The emulated LiDAR on a robot: it measures while it turns, and while the robot drives."""

from __future__ import annotations

import os
import tty

import numpy as np
import pytest
from lds2d.drivers import rplidar as library

from acsar_gym import RobotConfig
from acsar_gym.protocol import encode
from acsar_gym.tools.emulation.board import LIDAR_SAMPLES, Emulator
from acsar_gym.worlds import Scene, World
from acsar_gym.worlds.geometry import measure_ranges
from acsar_gym.worlds.movers import walk

ROOM = World(
    np.zeros((0, 3)),
    np.array([[-2, -1, 3, -1], [3, -1, 3, 2], [3, 2, -2, 2], [-2, 2, -2, -1]], float),
)
LOOPS = 200


def test_each_measurement_is_from_where_the_robot_was_then() -> None:
    """Its pose is between those of the loops, which are centimetres off."""
    config = RobotConfig().with_(lidar_x_offset=0.1, lidar_y_offset=-0.05)
    with Emulator(config, scene=Scene(world=ROOM), sees=True) as emulator:
        assert emulator.lidar_device is not None
        ports = [
            os.open(name, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
            for name in (emulator.device, emulator.lidar_device)
        ]
        for port in ports:
            tty.setraw(port)
        os.write(ports[1], b"\xa5\x20")
        poses, heard = [emulator._poses[1]], b""
        for _ in range(LOOPS):
            os.write(ports[0], encode((15.0, -15.0, -15.0, 15.0)))
            emulator._run_loop()
            poses.append(emulator._poses[1])
            heard += os.read(ports[1], 4096)
        for port in ports:
            os.close(port)
    data = heard[7:]  # what answers the request
    points = [library.parse_node(data[at : at + 5])[0] for at in range(0, len(data) - 4, 5)]
    bearings = -np.radians([point.angle_deg for point in points])
    measured = np.array([point.dist_mm for point in points]) / 1000.0
    times = np.arange(1, len(points) + 1) / (LIDAR_SAMPLES * config.lidar.rate)
    ends = np.arange(LOOPS + 1) / config.firmware.loop_rate
    x, y, theta = np.array(poses).T
    theta = np.unwrap(theta)
    assert abs(theta[-1]) > 1.0

    def errors(when: np.ndarray) -> np.ndarray:
        at_x, at_y, heading = (np.interp(when, ends, values) for values in (x, y, theta))
        cos, sin = np.cos(heading), np.sin(heading)
        place = at_x + cos * 0.1 + sin * 0.05, at_y + sin * 0.1 - cos * 0.05
        return np.abs(measured - measure_ranges(place, bearings + heading, ROOM))

    assert errors(times).max() < 0.003
    assert errors(np.ceil(times / 0.005 - 1e-9) * 0.005).max() > 0.01


def test_measurements_meet_movers_where_they_were_then() -> None:
    """The walker goes 15 cm in a control period, of 20 loops."""
    config = RobotConfig(lidar_x_offset=0.0, lidar_y_offset=0.0, control_rate=10.0)
    walker = walk([[1.0, -2.0], [1.0, 2.0]], 1.5, pauses=[0.1, 0.0])
    world = World(movers=(walker,))
    bearings, ages, met = np.linspace(-1.2, 1.2, 49), np.linspace(0.005, 0.0, 49), 0
    with Emulator(config, scene=Scene(world=world), sees=True) as emulator:
        assert emulator._lidar is not None
        for loop in range(1, 400):
            emulator._run_loop()
            ranges = emulator._lidar.twin._look(bearings, ages)
            times = (loop * 0.005 - ages).tolist()
            places = np.array([[walker.position(time)] for time in times])
            expected = measure_ranges((0.0, 0.0), bearings, world, places)
            met += np.isfinite(expected).sum()
            if loop > 20:  # until then it stands
                assert ranges == pytest.approx(expected, abs=1e-6)
    assert met > 1000
