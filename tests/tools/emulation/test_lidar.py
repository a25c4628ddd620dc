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
from acsar_gym.worlds.world import make_rectangle

ROOM = World(segments=make_rectangle(-2.0, -1.0, 3.0, 2.0))
YAW = 1.2
"""Direction of the LiDAR's zero on the robot [rad]."""
LOOPS = 200
LOOP = 0.005
"""Period of the firmware's loop [s]."""


def open_raw(device: str | None) -> int:
    port = os.open(device or "", os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    tty.setraw(port)
    return port


def test_lidar_measures_from_where_the_robot_was() -> None:
    """Its pose is between the poses of the loops, which are centimetres off."""
    config = RobotConfig().with_(lidar_x_offset=0.1, lidar_y_offset=-0.05, lidar_yaw=YAW)
    with Emulator(config, scene=Scene(world=ROOM), sees=True) as emulator:
        board = open_raw(emulator.device)
        lidar = open_raw(emulator.lidar_device)
        os.write(lidar, b"\xa5\x20")
        poses = [emulator._pose]
        received = b""
        for _ in range(LOOPS):
            os.write(board, encode((15.0, -15.0, -15.0, 15.0)))
            emulator.run_loop()
            poses.append(emulator._pose)
            received += os.read(lidar, 4096)
        os.close(board)
        os.close(lidar)

    data = received[7:]  # without the answer to the request
    points = [library.parse_node(data[i : i + 5])[0] for i in range(0, len(data) - 4, 5)]
    bearings = YAW - np.radians([point.angle_deg for point in points])
    measured = np.array([point.dist_mm for point in points]) / 1000.0
    times = np.arange(1, len(points) + 1) / (LIDAR_SAMPLES * config.lidar.rate)
    ends = np.arange(LOOPS + 1) * LOOP
    x, y, theta = np.array(poses).T
    theta = np.unwrap(theta)
    assert abs(theta[-1]) > 1.0

    def errors(when: np.ndarray) -> np.ndarray:
        heading = np.interp(when, ends, theta)
        place = np.interp(when, ends, x + 1j * y) + (0.1 - 0.05j) * np.exp(1j * heading)
        exact = measure_ranges((place.real, place.imag), bearings + heading, ROOM)
        return np.abs(measured - exact)

    assert errors(times).max() < 0.003
    assert errors(np.ceil(times / LOOP - 1e-9) * LOOP).max() > 0.01


def test_lidar_meets_movers_where_they_were() -> None:
    """The walker goes 15 cm in a control period, of 20 loops."""
    config = RobotConfig(lidar_x_offset=0.0, lidar_y_offset=0.0, control_rate=10.0)
    walker = walk([[1.0, -2.0], [1.0, 2.0]], 1.5, pauses=[0.1, 0.0])
    world = World(movers=(walker,))
    bearings = np.linspace(-1.2, 1.2, 49)
    ages = np.linspace(LOOP, 0.0, 49)

    with Emulator(config, scene=Scene(world=world), sees=True) as emulator:
        for loop in range(1, 400):
            emulator.run_loop()
            places = np.array([[walker.position(loop * LOOP - age)] for age in ages.tolist()])
            expected = measure_ranges((0.0, 0.0), bearings, world, places)
            if loop > 20:  # until then it stands
                assert emulator._look(bearings, ages) == pytest.approx(expected, abs=1e-6)
                assert np.isfinite(expected).any()
