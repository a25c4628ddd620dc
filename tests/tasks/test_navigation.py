"""Tasks with a goal behind obstacles: what they remember, observe and pay, and BARN's score."""

from __future__ import annotations

import numpy as np
import pytest
from task_tools import ACSAR, Played

from acsar_gym.tasks import Barn, ObstacleGoal
from acsar_gym.tasks.navigation import BARN_SCORES, CHALLENGE_SPEED, barn_score
from acsar_gym.worlds import Region, World

WORLD = World(start=Region(0.0, 0.0, 0.0, 0.0), goal=Region(4.0, 0.0))


def played() -> Played:
    return Played(ObstacleGoal(), {}, WORLD)


def seen(episode: Played, **known: object) -> dict[str, float]:
    return episode.seen(time=episode.episode.steps * 0.1, **known)


def test_time_without_coming_nearer_is_observed() -> None:
    episode = played()
    for steps, x, expected in ((30, 0.02, 0.3), (1, 0.1, 0.0), (150, 0.1, 1.0)):
        for _ in range(steps):
            episode.step(pose=(x, 0.0, 0.0))
        assert seen(episode, pose=(x, 0.0, 0.0))["stalled"] == pytest.approx(expected)


def test_the_way_back_is_observed_as_a_detour() -> None:
    episode = played()
    for x, expected in ((1.0, 0.0), (0.2, 0.8)):
        episode.step(pose=(x, 0.0, 0.0))
        assert seen(episode, pose=(x, 0.0, 0.0))["detour"] == pytest.approx(expected)


def test_the_mean_turn_rate_tells_left_from_right() -> None:
    for rate in (0.75, -0.75):
        episode = played()
        for _ in range(30):
            episode.step(twist=(0.0, rate))
        assert seen(episode)["turning"] == pytest.approx(0.63 * rate / 1.5, rel=0.02)


def test_an_episode_begins_without_the_memory_of_the_last_one() -> None:
    episode = played()
    for _ in range(30):
        episode.step(pose=(1.0, 0.0, 0.0), twist=(0.0, 1.0))
    episode.episode.begin(episode.state())
    assert [episode.seen()[name] for name in ("stalled", "detour", "turning")] == [0.0] * 3


def paid(time: float = 0.1, ranges: float = 1.0, **known: object) -> float:
    """Reward of one step."""
    episode = played()
    episode.episode.steps = round(time / 0.1) - 1
    scan = {"ranges": np.full(2, ranges), "edges": np.array([0.2, 0.3])}
    return episode.step(**scan, **known)[0]


def test_reward_pays_for_progress_and_arrival_and_not_for_waiting() -> None:
    waiting = [paid(time) for time in (0.1, 5.0, 10.0, 20.0)]
    assert waiting == pytest.approx([-0.0105, -0.035, -0.06, -0.06])
    step = paid(pose=(0.1, 0.0, 0.0))
    assert step == pytest.approx(0.19)
    assert paid(pose=(0.1, 0.0, 0.0), action=(-1.0, 0.0)) == pytest.approx(step - 0.05)
    assert paid(pose=(0.1, 0.0, 0.0), contact=True) == pytest.approx(step - 15.0)
    assert paid(pose=(3.8, 0.0, 0.0)) == pytest.approx(7.59 + 5.0)


@pytest.mark.parametrize(
    ("ranges", "cost"), [(0.45, 0.0), (0.375, 0.075), (0.3, 0.15), (0.1, 0.15)]
)
def test_little_clearance_costs(ranges: float, cost: float) -> None:
    assert paid(ranges=ranges) == pytest.approx(paid() - cost)


@pytest.mark.parametrize(
    ("time", "k", "expected"),
    [
        (1.0, 2.0, 0.5),  # faster than k * OT counts as k * OT
        (10.0, 2.0, 0.5),
        (20.0, 2.0, 0.25),
        (40.0, 2.0, 0.125),
        (99.0, 2.0, 0.125),  # slower than 8 * OT as that
        (30.0, 4.0, 5.0 / 30.0),
    ],
)
def test_barns_score_of_ten_metres(time: float, k: float, expected: float) -> None:
    assert barn_score(1.0, time, 10.0, 2.0, k) == pytest.approx(expected)
    assert barn_score(0.0, time, 10.0, 2.0, k) == 0.0


def test_an_episode_scores_when_it_reaches_the_goal() -> None:
    played = Played(Barn(), {"world": 1}, "barn:2")
    for _ in range(200):
        played.step(pose=(5.0, 0.0, 0.0))
    assert [played.episode.info()[name] for name in BARN_SCORES] == [0.0] * 4
    played.step(pose=(9.1, 0.0, 0.0))  # within BARN's metre
    length = played.assignment.length
    assert 10.0 <= length <= 13.9
    assert [played.episode.info()[name] for name in BARN_SCORES] == pytest.approx(
        [
            barn_score(1.0, 20.1, length, speed, k)
            for speed in (CHALLENGE_SPEED, ACSAR.max_linear)
            for k in (2.0, 4.0)
        ]
    )
    assert set(played.episode.info()) == {"goal_distance", "world", *BARN_SCORES}
