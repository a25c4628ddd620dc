"""Faults of the wire in every id: what ends an episode, and what repeats."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from env_tools import LINKS, inner, make

from acsar_gym.errors import LinkError

FAULTS: list[tuple[dict[str, Any], float]] = [
    ({"unplug_at": 1.0, "replug_time": 0.5}, 3.0),
    ({"board_reset_at": 1.0}, 1.0),
]


@pytest.mark.parametrize(("faults", "code"), FAULTS)
@pytest.mark.parametrize("link", LINKS)
def test_a_fault_truncates_the_episode_and_the_next_reset_recovers(
    link: str, faults: dict[str, Any], code: float
) -> None:
    env = make("acsar_gym/PointGoal-v0", link, faults=faults)
    for _ in range(2):
        _, info = env.reset(seed=0)
        assert info["fault"] == 0.0
        truncated, steps = False, 0
        while not truncated:
            *_, terminated, truncated, info = env.step(np.array([0.0, 0.2], np.float32))
            assert not terminated
            steps += 1
        assert info["fault"] == code
        assert steps < 20
        assert not inner(env).robot.active
    env.close()


def test_faults_can_be_raised_instead() -> None:
    env = make("acsar_gym/PointGoal-v0", faults={"unplug_at": 0.3}, on_fault="raise")
    env.reset(seed=0)
    with pytest.raises(LinkError):
        for _ in range(20):
            env.step(np.array([0.5, 0.0], np.float32))  # a fault's clock starts as wheels turn
    env.close()
