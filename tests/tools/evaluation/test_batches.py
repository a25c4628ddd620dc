"""Batches of planar robots: the results of one robot after the other."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest

from acsar_gym.tools.evaluation import episodes, runs
from acsar_gym.tools.evaluation.episode import Episode
from acsar_gym.tools.evaluation.episodes import run_episodes, run_resets
from acsar_gym.tools.policies import OnnxPolicy
from acsar_gym.worlds import Region, World
from acsar_gym.worlds.movers import walk

NEARLY = (
    *("episode_return", "path", "driven", "left", "turning", "jerk", "clearance", "energy"),
    *("odometry_error", "cross_track", "pose", "told", "closest_person", "time_to_collision"),
)
"""Fields in which both may differ by rounding. All others are equal."""
CROSSING = [walk([[x, -2.0], [x, 2.0]], 1.0, spread=8.0) for x in (1.5, 3.0)]
MEETING = walk([[5.0, 0.1], [-1.0, 0.1]], 0.8, spread=4.0, reacts=True)
PEOPLE = [
    World(start=Region(0.0, 0.0, 0.0, 0.0), goal=Region(5.0, 0.0), movers=movers)
    for movers in (CROSSING, [*CROSSING, MEETING])
]


def assert_equal(batched: list[Episode], single: list[Episode]) -> None:
    assert len(batched) == len(single)
    for episode, expected in zip(batched, single, strict=True):
        for name, value in dataclasses.asdict(expected).items():
            wanted: Any = value
            if isinstance(value, float) or name in NEARLY:
                tolerance = 1e-9 if name in NEARLY else 0.0
                wanted = pytest.approx(value, rel=tolerance, abs=tolerance, nan_ok=True)
            assert getattr(episode, name) == wanted, (episode.seed, name)


@pytest.mark.parametrize(
    ("name", "options", "varied"),
    [
        (
            "point_goal",
            {"randomization": {"friction": (0.5, 1.0)}, "max_episode_steps": 45},
            "success",
        ),
        ("obstacle_goal", {"worlds": "clutter:30"}, "length"),
        ("path_follow", {"worlds": "smooth_path:5"}, "length"),
        ("obstacle_goal", {"worlds": PEOPLE}, "person_contact"),
        pytest.param("barn", {"worlds": "barn:10"}, "length", marks=pytest.mark.slow),
    ],
)
def test_run_episodes_as_a_batch_gives_the_results_of_one_robot_after_the_other(
    name: str, options: dict[str, Any], varied: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy = OnnxPolicy(name)
    env = runs.make_env(policy, "planar", None, options)
    monkeypatch.setattr(episodes, "MAX_BATCH", 7)
    assert episodes.make_batch(env, policy, [(0, {})] * 20) is not None
    batched = list(run_episodes(env, policy, 20, 3))
    monkeypatch.setattr(episodes, "make_batch", lambda *_: None)
    assert_equal(batched, list(run_episodes(env, policy, 20, 3)))
    assert len({getattr(episode, varied) for episode in batched}) > 1
    env.close()


def test_run_resets_as_a_batch_drives_in_the_named_worlds() -> None:
    policy = OnnxPolicy("obstacle_goal")
    env = runs.make_env(policy, "planar", None, {"worlds": "clutter:500-509"})
    resets = [(number, {"world": number}) for number in (504, 502) * 8]
    batched = list(run_resets(env, policy, resets))
    assert [episode.world for episode in batched] == [number for number, _ in resets]
    assert_equal(batched[:2], list(run_resets(env, policy, resets[:2])))
    env.close()


@pytest.mark.parametrize(
    ("name", "options", "reset"),
    [
        ("turn_drive", {}, {}),  # has a memory
        ("point_goal", {}, {"goal": (1.0, 0.0)}),
        ("point_goal", {"faults": {"dropped_lines": 0.1}}, {}),
    ],
)
def test_make_batch_leaves_others_to_single_envs(
    name: str, options: dict[str, Any], reset: dict[str, Any]
) -> None:
    policy = runs.load_policy(name, trust=False, env="point_goal")
    env = runs.make_env(policy, "planar", None, options)
    assert episodes.make_batch(env, policy, [(0, reset)] * 20) is None
    env.close()
