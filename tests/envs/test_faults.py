"""Faults of links and boards in the env: what ends an episode, and what goes on."""

from __future__ import annotations

import numpy as np
import pytest
from env_tools import LINKS, inner, make
from failing_link import FailingLink

from acsar_gym import open_link
from acsar_gym.errors import LinkError


@pytest.mark.parametrize(("silent", "code"), [(True, 1.0), (False, 3.0)])
@pytest.mark.parametrize("link", LINKS)
def test_a_fault_truncates_the_episode_and_the_next_reset_recovers(
    link: str, silent: bool, code: float
) -> None:
    failing = FailingLink(open_link(link), 1.0, silent=silent)
    env = make("acsar_gym/PointGoal-v0", failing)
    for _ in range(2):
        env.reset(seed=0)
        truncated, steps = False, 0
        while not truncated:
            *_, terminated, truncated, info = env.step(np.array([0.0, 0.2], np.float32))
            assert not terminated
            steps += 1
        assert info["fault"] == code
        assert 10 <= steps < 20
        assert not inner(env).robot.active
    env.close()


def test_faults_can_be_raised_instead() -> None:
    failing = FailingLink(open_link("planar"), 0.3)
    env = make("acsar_gym/PointGoal-v0", failing, on_fault="raise")
    env.reset(seed=0)
    with pytest.raises(LinkError):
        for _ in range(20):
            env.step(np.array([0.5, 0.0], np.float32))
    env.close()


def test_lost_and_late_lines_end_no_episode() -> None:
    env = make("acsar_gym/PointGoal-v0", faults={"dropped_lines": 0.1, "late_lines": 0.1})
    _, info = env.reset(seed=0)
    for _ in range(20):
        assert info["fault"] == 0.0
        *_, truncated, info = env.step(np.array([0.5, 0.0], np.float32))
        assert not truncated
    env.close()
