"""Following a path: where the robot is next to it, what it sees, and when it has ended."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from task_tools import Played

from acsar_gym.errors import ConfigError, WorldError
from acsar_gym.tasks import Outcome, PathFollow
from acsar_gym.worlds import Pose
from acsar_gym.worlds.search import sample_path

L_SHAPE = [(0.0, 0.0), (2.0, 0.0), (2.0, 2.0)]


def play(path: Any = L_SHAPE) -> Played:
    return Played(PathFollow(), {"path": path})


def walk(following: Played, *poses: Pose, linear: float = 0.5) -> list[tuple[float, Outcome]]:
    return [following.step(pose=pose, action=(linear, 0.1)) for pose in poses]


def test_left_of_the_path_is_positive() -> None:
    following = play()
    walk(following, (0.5, 0.1, 0.2))
    info = following.episode.info()
    assert info["cross_track_error"] == pytest.approx(0.1)
    assert info["heading_error"] == pytest.approx(0.2)
    assert info["path_progress"] == pytest.approx(0.125)

    seen = following.seen(pose=(0.5, 0.1, 0.0), twist=(0.3, 0.1), action=(0.5, 0.1))
    assert seen["cross_track_error"] == pytest.approx(0.2)
    assert (seen["ahead_1"], seen["left_1"]) == pytest.approx((0.25, -0.1))
    assert (seen["ahead_4"], seen["left_4"]) == pytest.approx((1.0, -0.1))
    assert seen["remaining"] == pytest.approx(0.35)
    assert seen["linear_velocity"] == pytest.approx(0.6)


def test_the_end_needs_the_whole_path() -> None:
    """Next to the end of a loop the robot isn't done before it has gone round."""
    square = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0), (0.0, 0.05)]
    following = play(square)
    assert walk(following, (0.02, 0.0, 0.0))[0][1] is Outcome.GOING
    points = sample_path(np.array(square))
    walk(following, *map(tuple, points[::4].tolist()))
    assert walk(following, (0.0, 0.1, 0.0))[0][1] is Outcome.SUCCESS


@pytest.mark.parametrize(("y", "outcome"), [(0.49, Outcome.GOING), (0.51, Outcome.OUT_OF_BOUNDS)])
def test_too_far_beside_is_out_of_bounds(y: float, outcome: Outcome) -> None:
    reward, ended = walk(play(), (0.0, y, 0.0))[0]
    assert ended is outcome
    assert reward == pytest.approx(-0.02 - y - (0.0 if outcome == Outcome.GOING else 2.0))


def test_reward_pays_for_progress_along_the_path() -> None:
    (forth, _), (back, _) = walk(play(), (0.05, 0.0, 0.0), (0.0, 0.0, 0.0))
    assert forth == pytest.approx(0.08)
    assert back == pytest.approx(-0.12)
    assert walk(play(), (0.0, 0.0, 0.0), linear=-1.0)[0][0] == pytest.approx(-0.07)


@pytest.mark.parametrize("path", [[], [(0.0, 0.0)], [(1.0, 1.0)] * 3, "path", [(0.0, math.nan)]])
def test_wrong_paths_are_refused(path: Any) -> None:
    with pytest.raises((WorldError, ConfigError), match="path"):
        play(path)


def test_a_wrong_limit_is_refused() -> None:
    with pytest.raises(ConfigError, match="max_cross_track"):
        PathFollow(max_cross_track=math.nan)
