"""Batches of planar robots: the results of one robot after the other."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest

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
"""Fields in which both may differ by rounding. All others are equal."""


def assert_equal(batched: list[Episode], single: list[Episode]) -> None:
    assert len(batched) == len(single)
    for episode, expected in zip(batched, single, strict=True):
        for name, value in dataclasses.asdict(expected).items():
            wanted: Any = value
            if isinstance(value, float) or name in NEARLY:
                tolerance = 1e-9 if name in NEARLY else 0.0
                wanted = pytest.approx(value, rel=tolerance, abs=tolerance, nan_ok=True)
            assert getattr(episode, name) == wanted, (episode.seed, name)


def drive_both(
    policy: FilePolicy, monkeypatch: pytest.MonkeyPatch, **options: Any
) -> tuple[list[Episode], list[Episode]]:
    """Twenty episodes as a batch of few robots, and one after the other."""
    env = runs.make_env(policy, "planar", None, options)
    monkeypatch.setattr(episodes, "MAX_BATCH", 7)
    assert episodes.make_batch(env, policy, [(0, {})] * 20) is not None
    batched = list(run_episodes(env, policy, 20, 3))
    monkeypatch.setattr(episodes, "make_batch", lambda *_: None)
    single = list(run_episodes(env, policy, 20, 3))
    env.close()
    return batched, single


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("point_goal", {}),
        ("point_goal", {"randomization": {"friction": (0.5, 1.0)}, "max_episode_steps": 40}),
        ("obstacle_goal", {"worlds": "clutter:30"}),
        ("path_follow", {"worlds": "smooth_path:5"}),
        pytest.param("barn", {"worlds": "barn:10"}, marks=pytest.mark.slow),
    ],
)
def test_run_episodes_as_a_batch_gives_the_results_of_one_robot_after_the_other(
    name: str, options: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    batched, single = drive_both(OnnxPolicy(name), monkeypatch, **options)
    assert_equal(batched, single)
    assert len({episode.length for episode in batched}) > 3 or "max_episode_steps" in options


def test_run_episodes_as_a_batch_measures_people(monkeypatch: pytest.MonkeyPatch) -> None:
    """Some walk into the robot's way, some react to it."""
    ends: dict[str, Any] = {"start": Region(0.0, 0.0, 0.0, 0.0), "goal": Region(5.0, 0.0)}
    crossing = [walk([[x, -2.0], [x, 2.0]], 1.0, spread=8.0) for x in (1.5, 3.0)]
    meeting = walk([[5.0, 0.1], [-1.0, 0.1]], 0.8, spread=4.0, reacts=True)
    worlds = [World(**ends, movers=crossing), World(**ends, movers=[*crossing, meeting])]
    batched, single = drive_both(OnnxPolicy("obstacle_goal"), monkeypatch, worlds=worlds)
    assert_equal(batched, single)
    assert len({episode.person_contact for episode in batched}) > 1
    assert all(episode.closest_person < 10.0 for episode in batched)
    assert any(episode.intrusions for episode in batched)


def test_run_resets_as_a_batch_drives_in_the_named_worlds() -> None:
    policy = OnnxPolicy("obstacle_goal")
    env = runs.make_env(policy, "planar", None, {"worlds": "clutter:500-509"})
    resets = [(number, {"world": number}) for number in (504, 502) * 8]
    batched = list(run_resets(env, policy, resets))
    assert [episode.world for episode in batched] == [number for number, _ in resets]
    assert_equal(batched[:2], list(run_resets(env, policy, resets[:2])))
    env.close()


@pytest.mark.parametrize(
    ("name", "options", "resets"),
    [
        ("turn_drive", {}, [(0, {})] * 20),  # has a memory
        ("point_goal", {}, [(0, {})] * 5),  # few
        ("point_goal", {}, [(0, {"goal": (1.0, 0.0)})] * 20),
        ("point_goal", {"faults": {"dropped_lines": 0.1}}, [(0, {})] * 20),
    ],
)
def test_make_batch_leaves_others_to_single_envs(
    name: str, options: dict[str, Any], resets: list[Any]
) -> None:
    policy = runs.load_policy(name, trust=False, env="point_goal")
    env = runs.make_env(policy, "planar", None, options)
    assert episodes.make_batch(env, policy, resets) is None
    env.close()
