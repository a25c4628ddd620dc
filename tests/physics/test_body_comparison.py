"""The planar robot and PyBullet's do the same, through the wire and the same firmware twin."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pytest

from acsar_gym import RobotConfig, open_link
from acsar_gym.protocol import ZERO, Speeds, encode
from acsar_gym.worlds import Pose, Scene

CONFIG = RobotConfig.preset("acsar")


def slalom(now: float) -> Speeds:
    swing = 3.0 * math.sin(2.0 * now)
    return (6.0 + swing, 6.0 - swing, 6.0 - swing, 6.0 + swing)


DRIVES: dict[str, Callable[[float], Speeds]] = {
    "arc": lambda _: (8.0, 5.0, 5.0, 8.0),
    "slalom": slalom,
    "stop": lambda now: (7.0, 4.0, 4.0, 7.0) if now < 5.0 else ZERO,
    "saturated": lambda _: (99.0, 20.0, 20.0, 99.0),
}
"""Commanded wheel speeds [rad/s] as functions of time [s], by name."""


class Trace(NamedTuple):
    """Poses and wheel speeds of ten seconds, one per tick."""

    poses: list[Pose]
    wheels: list[Speeds]


def drive(link_name: str, name: str, config: RobotConfig = CONFIG) -> Trace:
    link: Any = open_link(link_name, config)
    trace = Trace([], [])
    link.reset(Scene())
    for tick in range(round(10.0 * config.control_rate)):
        link.write(encode(DRIVES[name](tick * config.period)))
        link.advance(config.period)
        trace.poses.append(link.truth.pose)
        trace.wheels.append(link.body.wheel_speeds)
    link.close()
    return trace


def heading_change(before: float, after: float) -> float:
    return abs(math.remainder(after - before, 2.0 * math.pi))


def distance(one: Trace, other: Trace) -> float:
    """The largest distance between two robots [m]."""
    pairs = zip(one.poses, other.poses, strict=True)
    return max(math.dist(p[:2], q[:2]) for p, q in pairs)


@pytest.mark.parametrize("name", DRIVES)
def test_planar_and_bullet_do_the_same_for_ten_seconds(name: str) -> None:
    one, other = drive("bullet", name), drive("planar", name)
    assert distance(one, other) < 0.03
    headings, others = ([pose[2] for pose in trace.poses] for trace in (one, other))
    turned = sum(map(heading_change, headings[:-1], headings[1:]))
    assert max(map(heading_change, headings, others)) < max(math.radians(2.0), 0.01 * turned)
    assert np.abs(np.subtract(one.wheels, other.wheels)).max() < 0.05


def test_a_different_robot_would_be_noticed() -> None:
    longer = drive("planar", "arc", CONFIG.with_(wheelbase=0.24))
    assert distance(drive("bullet", "arc"), longer) > 0.03
