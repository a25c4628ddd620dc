"""Episodes of a policy: results, timing, and faults."""

from __future__ import annotations

import json
import math
import time
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from boards import FailingLink

from acsar_gym import Link, RobotConfig, open_link
from acsar_gym.envs import PointGoalEnv
from acsar_gym.errors import ConfigError
from acsar_gym.tools.evaluation.episode import (
    Episode,
    odometry_errors,
)
from acsar_gym.tools.evaluation.episodes import run_episodes
from acsar_gym.tools.evaluation.metrics import replace_nonfinite, summarise_episodes
from acsar_gym.tools.evaluation.report import summary_table


def test_odometry_errors_come_from_the_emulators_log(tmp_path: Path) -> None:
    """The robot stood at (5, 5) looking along +y and ended 1 m ahead and 3 cm to the left."""
    log = tmp_path / "log.jsonl"
    events = [
        {"t": 9.9, "pose": [5.0, 5.0, math.pi / 2.0]},
        {"t": 10.5, "rx": "ap00.00\r\n"},
        {"t": 13.9, "pose": [4.97, 6.0, math.pi / 2.0]},
        {"t": 99.0, "pose": [0.0, 0.0, 0.0]},
    ]
    log.write_text("\n".join(map(json.dumps, events)))
    ended = Episode(success=True, collision=False, started=10.0, ended=14.0, pose=(1.0, 0.0, 0.0))
    assert odometry_errors([ended], log) == pytest.approx([0.03])
    log.write_text('{"t": 1.0, "rx": ""}\n')
    with pytest.raises(ConfigError, match="log"):
        odometry_errors([ended], log)


def test_an_episode_that_runs_out_of_time_leaves_the_robot_stopping() -> None:
    env = gymnasium.make("acsar_gym/PointGoal-v0", link="planar", max_episode_steps=5)
    (episode,) = run_episodes(env, lambda _: np.array([1.0, 0.0], np.float32), 1, seed=0)
    assert not episode.success
    assert isinstance(env.unwrapped, PointGoalEnv)
    link = env.unwrapped.robot.link
    link.advance(0.4)  # less than the board's own command time-out
    assert link.truth is not None
    assert abs(link.truth.twist[0]) < 0.1
    env.close()


CURVE = np.array([0.1, 0.1], np.float32)


def slow(_: Any) -> Any:
    """A policy that thinks for longer than a tick lasts."""
    time.sleep(0.03)
    return CURVE


def run(link: str | Link, policy: Any = lambda _: CURVE, **options: Any) -> Episode:
    """One short episode of a robot that has a busy machine's patience."""
    robot = RobotConfig.preset("acsar").with_(
        connect_timeout=20.0, feedback_timeout=5.0, watchdog_timeout=None
    )
    judged = {key: options.pop(key) for key in ("late_share",) if key in options}
    chosen: dict[str, Any] = {"max_episode_steps": 3, "robot": robot} | options
    env = gymnasium.make("acsar_gym/PointGoal-v0", link=link, **chosen)
    (episode,) = run_episodes(env, policy, 1, seed=0, **judged)
    env.close()
    return episode


def as_json(episode: Episode) -> dict[str, Any]:
    """The episode as strict JSON has it: without NaN."""
    (read,) = json.loads(json.dumps(replace_nonfinite([episode]), allow_nan=False))
    assert isinstance(read, dict)
    return read


def test_an_episode_with_many_late_ticks_is_not_valid(shared_device: str) -> None:
    episode = run(shared_device, slow)
    assert not episode.valid
    assert episode.fault == ""
    assert episode.timing is not None
    lateness = episode.timing.lateness
    assert lateness.late_ticks == episode.late_ticks >= 2  # the first tick isn't judged
    assert lateness.worst > 0.01  # the policy alone takes 20 ms too long
    assert lateness.missed_ticks >= 2
    assert lateness.ticks == episode.ticks - 1
    summary = summarise_episodes([episode])
    assert (summary.invalid, summary.late_ticks) == (1, episode.late_ticks)
    assert (summary.missed_ticks, summary.worst_lateness) == (lateness.missed_ticks, lateness.worst)
    assert summary.lateness_p99 == lateness.p99
    assert "Invalid" in str(summary_table("slow", [("wire", summary)]).caption)
    allowed = run(shared_device, slow, late_share=1.0)
    assert allowed.valid
    assert allowed.late_ticks > 0


def test_a_fault_is_told_and_makes_the_episode_invalid() -> None:
    episode = run(FailingLink(open_link("planar"), 0.25))
    assert "lost while in use" in episode.fault
    assert (episode.valid, episode.success) == (False, False)
    assert as_json(episode)["fault"] == episode.fault
    assert summarise_episodes([episode]).invalid == 1
    assert run(FailingLink(open_link("planar"), 60.0)).valid


def test_after_a_fault_the_next_episode_connects_again() -> None:
    link = FailingLink(open_link("planar"), 0.25)
    env = gymnasium.make("acsar_gym/PointGoal-v0", link=link, max_episode_steps=5)
    results = list(run_episodes(env, lambda _: CURVE, 3, seed=0))
    env.close()
    assert [bool(one.fault) for one in results] == [True] * 3
