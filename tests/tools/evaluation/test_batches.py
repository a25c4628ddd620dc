"""Batches of planar robots: the results of one robot after the other."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import pytest

from acsar_gym.errors import ConfigError
from acsar_gym.tools.evaluation import episodes, runs
from acsar_gym.tools.evaluation.episode import Episode
from acsar_gym.tools.evaluation.episodes import run_episodes, run_resets
from acsar_gym.tools.policies import FilePolicy, OnnxPolicy
from acsar_gym.worlds import Region, World
from acsar_gym.worlds.movers import walk

NEARLY = (
    *("episode_return", "path", "driven", "left", "turning", "jerk", "clearance", "energy"),
    *("odometry_error", "cross_track", "pose", "told", "closest_person", "time_to_collision"),
)
"""Fields in which both may differ by rounding; all others are equal."""


def assert_equal(episodes: list[Episode], others: list[Episode]) -> None:
    assert len(episodes) == len(others)
    for one, other in zip(episodes, others, strict=True):
        for field in dataclasses.fields(Episode):
            name, value = field.name, getattr(one, field.name)
            wanted: Any = getattr(other, field.name)
            if name in NEARLY:
                wanted = pytest.approx(wanted, rel=1e-9, abs=1e-9, nan_ok=True)
            elif isinstance(wanted, float) and math.isnan(wanted):
                wanted = pytest.approx(wanted, nan_ok=True)
            assert value == wanted, (one.seed, name)


def both(
    policy: FilePolicy, monkeypatch: pytest.MonkeyPatch, count: int = 20, **options: Any
) -> tuple[list[Episode], list[Episode]]:
    """Episodes as a batch of few robots, and one after the other."""
    how = {"in_order": options.pop("in_order", False)}
    env = runs.make_env(policy, "planar", None, options)
    monkeypatch.setattr(episodes, "MAX_BATCH", 7)
    assert episodes.can_batch(env, policy, [(0, {})] * count)
    batched = list(run_episodes(env, policy, count, 3, **how))
    monkeypatch.setattr(episodes, "can_batch", lambda *_: False)
    single = list(run_episodes(env, policy, count, 3, **how))
    env.close()
    return batched, single


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("point_goal", {}),
        ("point_goal", {"randomization": {"friction": (0.5, 1.0)}, "max_episode_steps": 40}),
        ("obstacle_goal", {"worlds": "clutter:30", "in_order": True}),
        ("path_follow", {"worlds": "smooth_path:5"}),
        pytest.param("barn", {"worlds": "barn:10"}, marks=pytest.mark.slow),
    ],
)
def test_a_batch_gives_the_results_of_one_robot_after_the_other(
    name: str, options: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    batched, single = both(OnnxPolicy(name), monkeypatch, **options)
    assert_equal(batched, single)
    assert len({episode.length for episode in batched}) > 3 or "max_episode_steps" in options


def test_a_batch_among_people_tells_what_one_robot_does(monkeypatch: pytest.MonkeyPatch) -> None:
    """Some walk into the robot's way, some react to it."""
    ends: dict[str, Any] = {"start": Region(0.0, 0.0, 0.0, 0.0), "goal": Region(5.0, 0.0)}
    crossing = [walk([[x, -2.0], [x, 2.0]], 1.0, spread=8.0) for x in (1.5, 3.0)]
    meeting = walk([[5.0, 0.1], [-1.0, 0.1]], 0.8, spread=4.0, reacts=True)
    worlds = [World(**ends, movers=crossing), World(**ends, movers=[*crossing, meeting])]
    batched, single = both(OnnxPolicy("obstacle_goal"), monkeypatch, worlds=worlds)
    assert_equal(batched, single)
    assert len({episode.person_contact for episode in batched}) > 1
    assert all(episode.closest_person < 10.0 for episode in batched)
    assert any(episode.intrusions for episode in batched)


def test_named_worlds_alone_are_made() -> None:
    policy = OnnxPolicy("obstacle_goal")
    env = runs.make_env(policy, "planar", None, {"worlds": "clutter:100000-100999"})
    resets = [(number, {"world": number}) for number in (100_004, 100_002) * 8]
    inner: Any = env.unwrapped
    assert episodes._name_worlds(inner, resets) == [100_002, 100_004]
    batched = list(run_resets(env, policy, resets))
    assert [episode.world for episode in batched] == [number for number, _ in resets]
    assert_equal(batched[:2], list(run_resets(env, policy, resets[:2])))
    env.close()


@pytest.mark.parametrize(
    ("policy", "options", "resets"),
    [
        ("turn_drive", {}, [(0, {})] * 20),  # has a memory
        ("point_goal", {}, [(0, {})] * 5),  # few
        ("point_goal", {}, [(0, {"goal": (1.0, 0.0)})] * 20),
        ("point_goal", {"faults": {"dropped_lines": 0.1}}, [(0, {})] * 20),
    ],
)
def test_others_are_driven_one_by_one(
    policy: str, options: dict[str, Any], resets: list[Any]
) -> None:
    env_id = "point_goal" if policy == "turn_drive" else ""
    loaded = runs.load_policy(policy, trust=False, env=env_id)
    env = runs.make_env(loaded, "planar", None, options)
    assert not episodes.can_batch(env, loaded, resets)
    env.close()


def test_an_unknown_world_is_one_error() -> None:
    policy = OnnxPolicy("obstacle_goal")
    env = runs.make_env(policy, "planar", None, {"worlds": "clutter:2"})
    with pytest.raises(ConfigError, match="20 episodes in order need as many worlds"):
        list(run_episodes(env, policy, 20, 0, in_order=True))
    env.close()
