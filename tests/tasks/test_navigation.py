"""Tasks with a goal behind obstacles: what they remember, observe and pay."""

from __future__ import annotations

import pytest
from task_tools import Played

from acsar_gym.tasks import Barn, ObstacleGoal
from acsar_gym.tasks.navigation import navigation_reward
from acsar_gym.worlds import Region, World

WORLD = World(start=Region(0.0, 0.0, 0.0, 0.0), goal=Region(4.0, 0.0))


def played() -> Played:
    return Played(ObstacleGoal(), {}, WORLD)


def seen(episode: Played, **known: object) -> dict[str, float]:
    return episode.seen(time=episode.episode.steps * 0.1, **known)


def test_time_without_coming_nearer_is_observed() -> None:
    episode = played()
    assert seen(episode)["stalled"] == 0.0
    for _ in range(30):
        episode.step(pose=(0.02, 0.0, 0.0))
    assert seen(episode, pose=(0.02, 0.0, 0.0))["stalled"] == pytest.approx(0.3)
    episode.step(pose=(0.1, 0.0, 0.0))
    assert seen(episode, pose=(0.1, 0.0, 0.0))["stalled"] == 0.0
    for _ in range(150):
        episode.step(pose=(0.1, 0.0, 0.0))
    assert seen(episode, pose=(0.1, 0.0, 0.0))["stalled"] == 1.0


def test_the_way_back_is_observed_as_a_detour() -> None:
    episode = played()
    episode.step(pose=(1.0, 0.0, 0.0))
    assert seen(episode, pose=(1.0, 0.0, 0.0))["detour"] == 0.0
    episode.step(pose=(0.2, 0.0, 0.0))
    assert seen(episode, pose=(0.2, 0.0, 0.0))["detour"] == pytest.approx(0.8)


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
    names = ("stalled", "detour", "turning")
    assert [episode.seen()[name] for name in names] == [0.0, 0.0, 0.0]


def test_standing_still_costs_ever_more() -> None:
    driving = navigation_reward(0.05, 0.0, 1.0, 0, 5.0)
    waiting = [navigation_reward(0.0, waited, 0.0, 0, 5.0) for waited in (0.0, 0.5, 1.0)]
    assert driving > 0.0 > waiting[0] > waiting[1] > waiting[2]
    assert navigation_reward(0.05, 0.0, -1.0, 0, 5.0) == pytest.approx(driving - 0.05)
    assert navigation_reward(0.05, 0.0, 1.0, 1, 5.0) == pytest.approx(driving + 5.0)
    assert navigation_reward(0.05, 0.0, 1.0, 3, 5.0) == pytest.approx(driving - 5.0)


def test_info_has_the_scores_but_not_the_memory_of_barn() -> None:
    assert Barn.told == (
        "goal_distance",
        "barn_score",
        "barn_score_k4",
        "barn_score_own",
        "barn_score_own_k4",
    )
