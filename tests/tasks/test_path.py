"""Following a path: where the robot is beside it, what it sees, and when it has ended."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from task_tools import Played

from acsar_gym.errors import ConfigError, WorldError
from acsar_gym.tasks import Outcome, PathFollow
from acsar_gym.tasks.path import path_reward
from acsar_gym.worlds import Pose
from acsar_gym.worlds.search import sample_path

TASK = PathFollow()
L_SHAPE = [(0.0, 0.0), (2.0, 0.0), (2.0, 2.0)]


def played(path: Any = L_SHAPE) -> Played:
    return Played(TASK, {"path": path})


def walk(following: Played, *poses: Pose) -> list[tuple[float, Outcome]]:
    return [following.step(pose=pose, action=(0.5, 0.1)) for pose in poses]


def seen_at(following: Played, x: float, y: float) -> dict[str, float]:
    return following.seen(pose=(x, y, 0.0), twist=(0.3, 0.1), action=(0.5, 0.1))


def test_left_of_the_path_is_positive() -> None:
    following = played()
    walk(following, (0.5, 0.1, 0.2))
    info = following.episode.info()
    assert info["cross_track_error"] == pytest.approx(0.1)
    assert info["heading_error"] == pytest.approx(0.2)
    assert info["path_progress"] == pytest.approx(0.125)
    seen = seen_at(following, 0.5, 0.1)
    assert seen["cross_track_error"] == pytest.approx(0.2)
    assert (seen["ahead_1"], seen["left_1"]) == pytest.approx((0.25, -0.1))
    assert (seen["ahead_4"], seen["left_4"]) == pytest.approx((1.0, -0.1))
    assert seen["remaining"] == pytest.approx(0.35)
    assert seen["linear_velocity"] == pytest.approx(0.6)


def test_the_end_needs_the_whole_path() -> None:
    """Beside the end of a loop the robot isn't done before it has gone round."""
    square = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0), (0.0, 0.05)]
    following = played(square)
    assert walk(following, (0.02, 0.0, 0.0))[0][1] is Outcome.GOING
    points = sample_path(np.array(square))
    outcomes = [outcome for _, outcome in walk(following, *map(tuple, points[::4].tolist()))]
    assert outcomes[0] is Outcome.GOING
    assert walk(following, (0.0, 0.1, 0.0))[0][1] is Outcome.SUCCESS


@pytest.mark.parametrize(("y", "outcome"), [(0.49, Outcome.GOING), (0.51, Outcome.OUT_OF_BOUNDS)])
def test_too_far_beside_is_out_of_bounds(y: float, outcome: Outcome) -> None:
    assert walk(played(), (0.3, y, 0.0))[0][1] is outcome


def test_reward_pays_for_progress_along_the_path() -> None:
    (reward, _), (back, _) = walk(played(), (0.05, 0.0, 0.0), (0.0, 0.0, 0.0))
    assert reward == pytest.approx(0.08)
    assert back == pytest.approx(-0.12)
    assert path_reward(1.0, 0.01, 1.0, 0) == pytest.approx(0.07)
    assert path_reward(1.0, 0.0, -1.0, 0) == pytest.approx(0.03)
    assert path_reward(0.0, 0.0, 1.0, 1) == pytest.approx(1.98)
    assert path_reward(0.0, 0.0, 1.0, 2) == pytest.approx(-2.02)


@pytest.mark.parametrize("path", [[], [(0.0, 0.0)], [(1.0, 1.0)] * 3, "path", [(0.0, math.nan)]])
def test_paths_that_are_none_are_refused(path: Any) -> None:
    with pytest.raises((WorldError, ConfigError)) as caught:
        played(path)
    assert "path" in str(caught.value)
    with pytest.raises(ConfigError, match="max_cross_track"):
        PathFollow(max_cross_track=math.nan)
