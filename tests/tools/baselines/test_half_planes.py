"""Linear programmes of two variables, against scipy's and a search on a grid."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.optimize import linprog

from acsar_gym.tasks.state import Floats
from acsar_gym.tools.baselines.half_planes import BOX, make_box, solve_programme


def box_and(*rows: tuple[float, float, float]) -> Floats:
    """The box from -1 to 1, and half planes (a, b, c), which are normalized."""
    planes = np.zeros((BOX + len(rows), 3))
    make_box((-1.0, 1.0), (-1.0, 1.0), planes)
    for n, row in enumerate(rows):
        planes[BOX + n] = np.array(row) / math.hypot(*row[:2])
    return planes


@pytest.mark.parametrize(
    ("rows", "wanted", "nearest"),
    [
        ([], (2.0, 0.5), (1.0, 0.5)),
        ([(-1, 0, -0.25), (0, 1, 0.5)], (0.9, 0.1), (0.25, 0.5)),
        ([(-1, -1, 0)], (0.5, 0.5), (0.0, 0.0)),
    ],
)
def test_solve_programme_finds_the_nearest_point(
    rows: list[tuple[float, float, float]],
    wanted: tuple[float, float],
    nearest: tuple[float, float],
) -> None:
    planes = box_and(*rows)
    assert solve_programme(planes, len(planes), *wanted) == pytest.approx(nearest)


def test_solve_programme_breaks_the_worst_half_plane_least() -> None:
    """The least distance from the worst half plane is a linear programme of three variables."""
    rng = np.random.default_rng(1)
    empty = 0

    for _ in range(200):
        angles = rng.uniform(-math.pi, math.pi, 5)
        offsets = rng.normal(0.2, 0.4, 5)
        planes = box_and(*zip(np.cos(angles), np.sin(angles), offsets, strict=True))
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
