"""Following a path: where the robot is next to it, what it sees, and when it has ended."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from acsar_gym.errors import ConfigError, WorldError
from acsar_gym.tasks import Outcome, PathFollow
from acsar_gym.worlds import Pose
from acsar_gym.worlds.search import sample_path

L_SHAPE = [(0.0, 0.0), (2.0, 0.0), (2.0, 2.0)]


@pytest.fixture
def follow(play: Any) -> Any:
    """`follow(path)` is an episode on it."""
    return lambda path=L_SHAPE: play(PathFollow(), {"path": path})


def walk(following: Any, *poses: Pose, linear: float = 0.5) -> list[tuple[float, Outcome]]:
    return [following.step(pose=pose, action=(linear, 0.1)) for pose in poses]


def test_cross_track_error_is_positive_to_the_left(follow: Any) -> None:
    following = follow()
    walk(following, (0.5, 0.1, 0.2))
    info = following.episode.info()
    assert info["cross_track_error"] == pytest.approx(0.1)
    assert info["heading_error"] == pytest.approx(0.2)
    assert info["path_progress"] == pytest.approx(0.125)

    observation = following.seen(pose=(0.5, 0.1, 0.0), twist=(0.3, 0.1), action=(0.5, 0.1))
    assert observation["cross_track_error"] == pytest.approx(0.2)
    assert (observation["ahead_1"], observation["left_1"]) == pytest.approx((0.25, -0.1))
    assert (observation["ahead_4"], observation["left_4"]) == pytest.approx((1.0, -0.1))
    assert observation["remaining"] == pytest.approx(0.35)
    assert observation["linear_velocity"] == pytest.approx(0.6)


def test_path_end_needs_the_whole_path(follow: Any) -> None:
    """Next to the end of a loop the robot isn't done before it has gone round."""
    square = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0), (0.0, 0.05)]
    following = follow(square)
    assert walk(following, (0.02, 0.0, 0.0))[0][1] is Outcome.GOING
    points = sample_path(np.array(square))
    walk(following, *map(tuple, points[::4].tolist()))
    assert walk(following, (0.0, 0.1, 0.0))[0][1] is Outcome.SUCCESS


@pytest.mark.parametrize(("y", "outcome"), [(0.49, Outcome.GOING), (0.51, Outcome.OUT_OF_BOUNDS)])
def test_path_outcome_too_far_beside(y: float, outcome: Outcome, follow: Any) -> None:
    reward, ended = walk(follow(), (0.0, y, 0.0))[0]
    assert ended is outcome
    assert reward == pytest.approx(-0.02 - y - (0.0 if outcome == Outcome.GOING else 2.0))


@pytest.mark.parametrize("path", [[(0.0, 0.0)], "path", [(0.0, math.nan)]])
def test_path_that_is_wrong_is_refused(path: Any, follow: Any) -> None:
    with pytest.raises((WorldError, ConfigError), match="path"):
        follow(path)
