"""ORCA: the half planes that obstacles leave, and the velocity within them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from scipy.optimize import linprog

from acsar_gym import RobotConfig
from acsar_gym.tools.baselines.base import RobotUnits
from acsar_gym.tools.baselines.half_planes import BOX, make_box, solve_programme
from acsar_gym.tools.baselines.orca import (
    OrcaConstants,
    forbid_movers,
    forbid_walls,
    true_tracks,
)
from acsar_gym.truth import GroundTruth
from acsar_gym.worlds.crowd import Crowd
from acsar_gym.worlds.geometry import make_surroundings
from acsar_gym.worlds.movers import walk
from acsar_gym.worlds.world import World

CONFIG = RobotConfig.preset("acsar")
CONSTANTS = OrcaConstants(mover_margin=0.2, wall_margin=0.05)
UNITS = RobotUnits.of(CONFIG, 0.1)._replace(radius=0.25)
NEAREST = 1.2 * 0.25 + 0.25
"""Distance of the centres of robot and mover, with the margin, at which they touch [m]."""


def meets(velocity: tuple[float, float], mover: Any) -> bool:
    """Whether the disc of the robot meets a mover within the horizon, on a fine grid of times."""
    times = np.linspace(0.0, CONSTANTS.horizon, 4001)[:, None]
    offsets = mover[:2] + times * (mover[2:4] - np.array(velocity))
    return bool(np.hypot(*offsets.T).min() < NEAREST - 1e-3)


def test_forbid_movers_leaves_no_velocity_that_meets_the_mover() -> None:
    rng = np.random.default_rng(0)
    met = 0

    for _ in range(300):
        mover = np.array([*rng.uniform(-2.0, 2.0, 2), *rng.uniform(-1.0, 1.0, 2), 0.25])
        if math.hypot(*mover[:2]) < NEAREST + 0.05:
            continue
        (plane,) = forbid_movers(mover[None], 0.4, CONSTANTS, UNITS)
        assert math.hypot(*plane[:2]) == pytest.approx(1.0)
        for velocity in rng.uniform(-1.0, 1.0, (20, 2)):
            within = plane[:2] @ velocity >= plane[2]
            met += meets(velocity, mover)
            assert not (within and meets(velocity, mover))
        if not meets((0.4, 0.0), mover):
            assert plane[0] * 0.4 >= plane[2] - 1e-6
    assert met > 100


def test_forbid_movers_leaves_a_mover_that_it_touches() -> None:
    """They overlap by 5 cm, so it backs off at 0.5 m/s for 0.1 s, or half of that if shared."""
    mover = np.array([[NEAREST - 0.05, 0.0, 0.0, 0.0, 0.25]])
    for share in (1.0, 0.5):
        planes = forbid_movers(mover, 0.0, CONSTANTS._replace(share=share), UNITS)
        assert planes == pytest.approx(np.array([[-1.0, 0.0, 0.5 * share]]))


def test_forbid_walls() -> None:
    """The bumper is 0.17 m ahead: a wall at 0.52 m leaves 0.3 m with the margin."""
    footprint = make_surroundings(None, None, CONFIG)
    points = np.array([[0.52, 0.0], [0.52, 0.1], [-0.2, 0.0]])
    planes = forbid_walls(points, CONSTANTS, footprint)
    assert planes == pytest.approx(np.array([[-1, 0, -0.6], [-1, 0, -0.6], [1, 0, 0.0]]))


def test_true_tracks_are_in_the_odometry_frame() -> None:
    """The odometry has turned by a right angle, and is off by a metre."""
    crowd = Crowd(World(movers=(walk([[2, 1], [2, 5]], 1.0),)), CONFIG, 0.0)
    truth = GroundTruth(pose=(1.0, 1.0, 0.0), crowd=crowd)
    tracks = true_tracks(truth, (0.0, 1.0, math.pi / 2.0))
    assert tracks == pytest.approx(np.array([[0.0, 2.0, -1.0, 0.0, 0.25]]))
    assert true_tracks(GroundTruth(), (0.0, 0.0, 0.0)).shape == (0, 5)


UNIT_BOX = make_box((-1.0, 1.0), (-1.0, 1.0))


@pytest.mark.parametrize(
    ("rows", "wanted", "nearest"),
    [
        ([(-1.0, 0.0, -0.25), (0.0, 1.0, 0.5)], (0.9, 0.1), (0.25, 0.5)),
        ([(-0.6, -0.8, 0.0)], (0.6, 0.8), (0.0, 0.0)),
    ],
)
def test_solve_programme_finds_the_nearest_point(rows: Any, wanted: Any, nearest: Any) -> None:
    planes = np.vstack([UNIT_BOX, rows])
    assert solve_programme(UNIT_BOX, BOX, 2.0, 0.5) == (1.0, 0.5)
    assert solve_programme(planes, len(planes), *wanted) == pytest.approx(nearest)


def test_solve_programme_breaks_the_worst_half_plane_least() -> None:
    """The least distance from the worst half plane is a linear programme of three variables."""
    rng = np.random.default_rng(1)
    empty = 0

    for _ in range(200):
        angles = rng.uniform(-math.pi, math.pi, 5)
        offsets = rng.normal(0.2, 0.4, 5)
        planes = np.vstack([UNIT_BOX, np.column_stack([np.cos(angles), np.sin(angles), offsets])])
        hard = BOX + 1
        x, y = solve_programme(planes, hard, 0.0, 0.0)
        slack = (np.arange(len(planes)) >= hard).astype(float)[:, None]
        best = linprog(
            [0, 0, 1], -np.hstack([planes[:, :2], slack]), -planes[:, 2], bounds=(None, None)
        )
        if best.fun is not None and best.fun > 1e-6:
            broken = planes[:, 2] - planes[:, :2] @ (x, y)
            assert broken[:hard].max() < 1e-9
            assert broken[hard:].max() == pytest.approx(best.fun, abs=1e-6)
            empty += 1
    assert empty > 20
