"""The planar robot and PyBullet's do the same, through the wire and the same firmware twin."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from acsar_gym import RobotConfig, open_link
from acsar_gym.protocol import ZERO, Speeds, encode
from acsar_gym.worlds import Scene

CONFIG = RobotConfig.preset("acsar")
DRIVES: dict[str, Callable[[float], Speeds]] = {
    "slalom": lambda now: (
        6.0 + 3.0 * math.sin(2.0 * now),
        6.0 - 3.0 * math.sin(2.0 * now),
        6.0 - 3.0 * math.sin(2.0 * now),
        6.0 + 3.0 * math.sin(2.0 * now),
    ),
    "stop": lambda now: (7.0, 4.0, 4.0, 7.0) if now < 5.0 else ZERO,
    "saturated": lambda _: (99.0, 20.0, 20.0, 99.0),
}
"""Commanded wheel speeds [rad/s] as functions of time [s], by name."""


def drive(
    link_name: str, name: str, config: RobotConfig = CONFIG
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Poses (ticks, 3) and wheel speeds (ticks, 4) of ten seconds."""
    link: Any = open_link(link_name, config)
    link.reset(Scene())
    poses, wheels = [], []
    for tick in range(round(10.0 * config.control_rate)):
        link.write(encode(DRIVES[name](tick * config.period)))
        link.advance(config.period)
        poses.append(link.truth.pose)
        wheels.append(link.body.wheel_speeds)
    link.close()
    return np.array(poses), np.array(wheels)


@pytest.mark.parametrize("name", DRIVES)
def test_planar_and_bullet_do_the_same_for_ten_seconds(name: str) -> None:
    (poses, wheels), (planar_poses, planar_wheels) = drive("bullet", name), drive("planar", name)
    difference = poses - planar_poses
    assert np.hypot(*difference[:, :2].T).max() < 0.03
    headings = np.unwrap(poses[:, 2])
    turned = np.abs(np.diff(headings)).sum()
    error = np.abs(headings - np.unwrap(planar_poses[:, 2])).max()
    assert error < max(math.radians(2.0), 0.01 * turned)
    assert np.abs(wheels - planar_wheels).max() < 0.05


def test_a_different_robot_would_be_noticed() -> None:
    longer, _ = drive("planar", "stop", CONFIG.with_(wheelbase=0.24))
    poses, _ = drive("bullet", "stop")
    assert np.hypot(*(poses - longer)[:, :2].T).max() > 0.03
