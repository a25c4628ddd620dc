"""BARN's score against its definition."""

from __future__ import annotations

import pytest
from task_tools import ACSAR, Played

from acsar_gym.tasks import Barn
from acsar_gym.tasks.navigation import BARN_SCORES, barn_score, barn_scores


@pytest.mark.parametrize(
    ("time", "k", "expected"),
    [
        (1.0, 2.0, 0.5),  # faster than k * OT counts as k * OT
        (10.0, 2.0, 0.5),
        (20.0, 2.0, 0.25),
        (40.0, 2.0, 0.125),
        (99.0, 2.0, 0.125),  # slower than 8 * OT as that
        (10.0, 4.0, 0.25),
        (30.0, 4.0, 5.0 / 30.0),
    ],
)
def test_the_score_of_ten_metres(time: float, k: float, expected: float) -> None:
    assert barn_score(1.0, time, 10.0, 2.0, k) == pytest.approx(expected)
    assert barn_score(0.0, time, 10.0, 2.0, k) == 0.0


def test_a_slower_robot_is_measured_by_its_own_speed() -> None:
    assert barn_scores(1.0, 25.0, 10.0, 0.5) == pytest.approx((0.2, 0.2, 0.5, 0.25))


def test_an_episode_scores_when_it_reaches_the_goal() -> None:
    played = Played(Barn(), {"world": 1}, "barn:2")
    for _ in range(200):
        played.step(pose=(5.0, 0.0, 0.0))
    assert [played.episode.info()[name] for name in BARN_SCORES] == [0.0] * 4
    played.step(pose=(9.1, 0.0, 0.0))  # within BARN's metre
    expected = barn_scores(1.0, 20.1, played.assignment.length, ACSAR.max_linear)
    assert [played.episode.info()[name] for name in BARN_SCORES] == pytest.approx(expected)
    assert 10.0 <= played.assignment.length <= 13.9
