"""A map can be made of a recording: measurements lie on walls from where the robot was then."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from acsar_gym import Robot, RobotConfig, open_link
from acsar_gym.recording import Recorder, read
from acsar_gym.worlds import Scene, World

ROOM = World(
    np.zeros((0, 3)),
    np.array([[-2, -1, 3, -1], [3, -1, 3, 2], [3, 2, -2, 2], [-2, 2, -2, -1]], float),
)


def test_measurements_lie_on_the_walls_and_make_the_recorded_scans(tmp_path: Path) -> None:
    path = tmp_path / "tape.mcap"
    config = RobotConfig.preset("acsar").with_(lidar={"noise": 0.0, "rate": 5.0})
    robot = Robot(open_link("planar", config), config, ["lidar"], Recorder(path))
    with robot:
        robot.reset(Scene(world=ROOM))
        for tick in range(300):
            robot.drive(0.3 * math.cos(tick / 40.0), 1.2)
    episode = read(path, revolutions=True).episodes[-1]
    x, y, theta = *episode.truth.T[:2], np.unwrap(episode.truth[:, 2])
    assert theta[-1] > 1.0

    def off_walls(late: float) -> float:
        off = []
        for bearings, distances, times in episode.revolutions.measured[2:]:
            when = times + late
            heading = np.interp(when, episode.stamps, theta)
            place = np.interp(when, episode.stamps, x) + 1j * np.interp(when, episode.stamps, y)
            seen = config.lidar_x_offset + 1j * config.lidar_y_offset
            met = place + (seen + distances * np.exp(1j * bearings)) * np.exp(1j * heading)
            walls = np.abs([met.real - 3, met.real + 2, met.imag - 2, met.imag + 1]).min(axis=0)
            off.append(walls[distances > 0])
        return float(np.concatenate(off).max())

    assert len(episode.revolutions.measured) >= 15
    assert off_walls(0.0) < 0.005
    assert off_walls(-0.05) > 0.02
