"""Tasks with a goal behind obstacles: what they remember, observe and pay."""

from __future__ import annotations

import numpy as np
import pytest
from task_tools import Played

from acsar_gym.tasks import Barn, ObstacleGoal
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


def paid(time: float = 0.1, ranges: float = 1.0, **known: object) -> float:
    """Reward of one step."""
    episode = played()
    episode.episode.steps = round(time / 0.1) - 1
    scan = {"ranges": np.full(2, ranges), "edges": np.array([0.2, 0.3])}
    return episode.step(**scan, **known)[0]


def test_standing_still_costs_ever_more() -> None:
    waiting = [paid(time) for time in (0.1, 5.0, 10.0, 20.0)]
    assert waiting == pytest.approx([-0.0105, -0.035, -0.06, -0.06])


def test_reward_pays_for_progress_and_arrival() -> None:
    step = paid(pose=(0.1, 0.0, 0.0))
    assert step == pytest.approx(0.19)
    assert paid(pose=(0.1, 0.0, 0.0), action=(-1.0, 0.0)) == pytest.approx(step - 0.05)
    assert paid(pose=(0.1, 0.0, 0.0), contact=True) == pytest.approx(step - 15.0)
    assert paid(pose=(3.8, 0.0, 0.0)) == pytest.approx(7.59 + 5.0)


def test_little_clearance_costs() -> None:
    free = paid()
    assert paid(ranges=0.45) == pytest.approx(free)
    assert paid(ranges=0.375) == pytest.approx(free - 0.075)
    assert paid(ranges=0.3) == pytest.approx(free - 0.15)
    assert paid(ranges=0.1) == pytest.approx(free - 0.15), "a touch, which noise makes nearer"


def test_info_has_the_scores_but_not_the_memory_of_barn() -> None:
    assert Barn.told == (
        "goal_distance",
        "barn_score",
        "barn_score_k4",
        "barn_score_own",
        "barn_score_own_k4",
    )
