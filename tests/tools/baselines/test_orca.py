"""ORCA: the half plane that a mover leaves, and what a robot does among movers."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from acsar_gym import RobotConfig
from acsar_gym.tools.baselines.orca import (
    VelocityModel,
    forbid_meeting,
    list_planes,
    true_tracks,
)
from acsar_gym.truth import GroundTruth
from acsar_gym.worlds.crowd import Crowd
from acsar_gym.worlds.geometry import make_surroundings
from acsar_gym.worlds.movers import walk
from acsar_gym.worlds.world import World

CONFIG = RobotConfig.preset("acsar")
MODEL = VelocityModel(
    radius=0.3, horizon=2.0, wall_horizon=0.5, wall_margin=0.05, share=1.0, period=0.1
)


def meets(velocity: tuple[float, float], mover: Any) -> bool:
    """Whether the disc of MODEL meets a mover within the horizon, on a fine grid of times."""
    times = np.linspace(0.0, MODEL.horizon, 4001)[:, None]
    offsets = mover[:2] + times * (mover[2:4] - np.array(velocity))
    return bool(np.hypot(*offsets.T).min() < MODEL.radius + mover[4] - 1e-3)


def test_forbid_meeting_leaves_no_velocity_that_meets_the_mover() -> None:
    rng = np.random.default_rng(0)
    met = 0

    for _ in range(300):
        mover = np.array([*rng.uniform(-2.0, 2.0, 2), *rng.uniform(-1.0, 1.0, 2), 0.25])
        if math.hypot(*mover[:2]) < MODEL.radius + mover[4] + 0.05:
            continue
        plane = np.zeros(3)
        forbid_meeting(plane, mover, 0.4, MODEL)
        assert math.hypot(*plane[:2]) == pytest.approx(1.0)
        for velocity in rng.uniform(-1.0, 1.0, (20, 2)):
            within = plane[:2] @ velocity >= plane[2]
            met += meets(velocity, mover)
            assert not (within and meets(velocity, mover))
        if not meets((0.4, 0.0), mover):
            assert plane[0] * 0.4 >= plane[2] - 1e-6
    assert met > 100


def test_list_planes_of_what_stands() -> None:
    """The bumper is 0.17 m ahead: a wall at 0.52 m leaves 0.3 m with the margin."""
    footprint = make_surroundings(None, None, CONFIG)
    points = np.array([[0.52, 0.0], [0.52, 0.1], [-0.2, 0.0]])
    planes, walls = list_planes(0.0, points, np.zeros((0, 5)), MODEL, footprint)
    assert walls == 3
    assert planes[-3:] == pytest.approx(np.array([[-1, 0, -0.6], [-1, 0, -0.6], [1, 0, 0.0]]))


def test_true_tracks_are_in_the_odometry_frame() -> None:
    """The odometry has turned by a right angle, and is off by a metre."""
    crowd = Crowd(World(movers=(walk([[2, 1], [2, 5]], 1.0),)), CONFIG, 0.0)
    truth = GroundTruth(pose=(1.0, 1.0, 0.0), crowd=crowd)
    tracks = true_tracks(truth, (0.0, 1.0, math.pi / 2.0))
    assert tracks == pytest.approx(np.array([[0.0, 2.0, -1.0, 0.0, 0.25]]))
    assert true_tracks(GroundTruth(), (0.0, 0.0, 0.0)).shape == (0, 5)
