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

from acsar_gym import RobotConfig, open_link
from acsar_gym.errors import ConfigError
from acsar_gym.tools.evaluation.episode import (
    Episode,
    odometry_errors,
)
from acsar_gym.tools.evaluation.episodes import run_episodes
from acsar_gym.tools.evaluation.metrics import replace_nonfinite, summarise_episodes
from acsar_gym.tools.evaluation.report import summary_table

CURVE = np.array([0.1, 0.1], np.float32)


def test_odometry_errors_come_from_the_emulators_log(tmp_path: Path) -> None:
    """The robot stood at (5, 5) looking along +y and ended 1 m ahead and 3 cm to the left."""
    log = tmp_path / "log.jsonl"
    poses = [(9.9, 5.0, 5.0), (13.9, 4.97, 6.0), (99.0, 0.0, 0.0)]
    events = [{"t": stamp, "pose": [x, y, math.pi / 2.0]} for stamp, x, y in poses]
    lines = [json.dumps(event) for event in (*events, {"t": 10.5, "rx": "ap00.00\r\n"})]
    log.write_text("\n".join(lines))
    ended = Episode(success=True, collision=False, started=10.0, ended=14.0, pose=(1.0, 0.0, 0.0))
    assert odometry_errors([ended], log) == pytest.approx([0.03])
    log.write_text('{"t": 1.0, "rx": ""}\n')
    with pytest.raises(ConfigError, match="log"):
        odometry_errors([ended], log)


def test_run_episodes_stops_the_robot_when_the_time_is_over() -> None:
    env = gymnasium.make("acsar_gym/PointGoal-v0", link="planar", max_episode_steps=5)
    (episode,) = run_episodes(env, lambda _: np.array([1.0, 0.0], np.float32), 1, seed=0)
    assert not episode.success
    inner: Any = env.unwrapped
    inner.robot.link.advance(0.4)  # less than the board's own command time-out
    assert abs(inner.robot.link.truth.twist[0]) < 0.1
    env.close()


def think_slowly(observation: Any) -> Any:
    """A policy that thinks for longer than a tick lasts."""
    time.sleep(0.03)
    return CURVE


@pytest.mark.parametrize("late_share", [0.01, 1.0])
def test_run_episodes_counts_late_ticks(late_share: float, shared_device: str) -> None:
    robot = RobotConfig.preset("acsar").with_(
        connect_timeout=20.0, feedback_timeout=5.0, watchdog_timeout=None
    )
    options: dict[str, Any] = {"link": shared_device, "robot": robot, "max_episode_steps": 3}
    env = gymnasium.make("acsar_gym/PointGoal-v0", **options)
    (episode,) = run_episodes(env, think_slowly, 1, seed=0, late_share=late_share)
    env.close()
    assert episode.valid == (late_share == 1.0)
    assert episode.fault == ""
    assert episode.timing is not None
    lateness = episode.timing.lateness
    assert lateness.late_ticks == episode.late_ticks >= 2  # the first tick isn't judged
    assert lateness.worst > 0.01  # the policy alone takes 20 ms too long

    summary = summarise_episodes([episode])
    assert (summary.invalid, summary.late_ticks) == (not episode.valid, episode.late_ticks)
    assert summary.worst_lateness == lateness.worst
    caption = str(summary_table("slow", [("wire", summary)]).caption)
    assert ("Invalid" in caption) != episode.valid


def test_run_episodes_connects_again_after_a_fault() -> None:
    link = FailingLink(open_link("planar"), 0.25)
    env = gymnasium.make("acsar_gym/PointGoal-v0", link=link, max_episode_steps=5)
    episodes = list(run_episodes(env, lambda _: CURVE, 3, seed=0))
    env.close()
    for episode in episodes:
        assert "lost while in use" in episode.fault
        assert (episode.valid, episode.success) == (False, False)
    assert summarise_episodes(episodes).invalid == 3
    json.dumps(replace_nonfinite(episodes), allow_nan=False)
