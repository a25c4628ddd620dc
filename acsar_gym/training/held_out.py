"""Evaluates a policy during training, in worlds and with seeds that aren't trained on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acsar_gym.vector.env import RobotVectorEnv
from acsar_gym.worlds import splits
from acsar_gym.worlds.pool import Pool

ROBOTS = 64
"""Robots in an evaluation during training; each runs one episode."""
ROBOTS_FOR_TARGET = 512
"""Robots in an evaluation that decides whether a target is reached."""
FIRST_SEED = 2**32
"""First seed of held-out episodes; seeds of a training are smaller."""

Decide = Callable[[NDArray[np.float32]], NDArray[Any]]
"""Maps observations (n, m) to actions (n, 2); one that has a state begins at its first call."""


@dataclass(frozen=True, slots=True)
class Score:
    """Result of an evaluation with one episode per robot."""

    episodes: int
    success_rate: float
    collision_rate: float
    """Share of unsuccessful episodes that ended in contact with an obstacle."""
    mean_return: float
    mean_length: float
    """Mean length of an episode [steps]."""


def evaluate(batch: RobotVectorEnv, decide: Decide) -> Score:
    """Run the first episode of every robot to its end, always from the same seeds.

    One episode per robot avoids a bias: the first n finished episodes of a batch would contain too
    many quick ones.

    Args:
        batch: the robots; needs a time limit.
        decide: the policy.

    Returns:
        Rates and means over the episodes.
    """
    observations, _ = batch.reset(seed=FIRST_SEED)
    robots = batch.num_envs
    running = np.ones(robots, np.bool_)
    success, collision = np.zeros((2, robots), np.bool_)
    returns, lengths = np.zeros((2, robots))
    while running.any():
        observations, rewards, terminated, truncated, info = batch.step(decide(observations))
        returns += rewards * running
        lengths += running
        ended = running & (terminated | truncated)
        success |= ended & (info["is_success"] == 1.0)
        collision |= ended & ~success & (info["true_contact"] == 1.0)
        running &= ~ended
    return Score(
        robots,
        float(success.mean()),
        float(collision.mean()),
        float(returns.mean()),
        float(lengths.mean()),
    )


def measured(batch: RobotVectorEnv) -> str:
    """Return the label of a success rate measured with this batch."""
    if _others(batch):
        return "held-out success"
    return "success in the same worlds, other seeds"


def told(learning: RobotVectorEnv, batch: RobotVectorEnv) -> str:
    """Describe the worlds of training and evaluation in one line.

    Args:
        learning: robots of the training.
        batch: robots of the evaluation.
    """
    pools = [one.pool for one in (learning, batch)]
    if pools[0] is None:
        return "training on an open floor, held out: other seeds"
    apart = (
        f"held out: {pools[1]}" if _others(batch) else "evaluated in the same worlds, other seeds"
    )
    return f"training in {pools[0]}, {apart}"


def _others(batch: RobotVectorEnv) -> bool:
    """Return whether the evaluation has other worlds, or other goals on the open floor."""
    pool = batch.pool
    return pool is None or pool.generated


def worlds_beside(pool: Pool | None, robots: int = ROBOTS) -> str | None:
    """Choose held-out worlds.

    Args:
        pool: worlds of the training; None for an open floor.
        robots: how many worlds.

    Returns:
        Generated worlds of the same kind, none of which is in `pool`: those of the validation
        split, or those behind the pool's where it holds some of them. None for files and an open
        floor, which have no others, so that only the seeds differ.
    """
    if pool is None or not pool.generated:
        return None
    own = splits.numbers(pool.kind, splits.VALIDATION)
    apart = pool.numbers[0] > own[-1] or pool.numbers[-1] < own[0]
    first = own[0] if apart else pool.numbers[-1] + 1
    return f"{pool.kind}:{first}-{first + robots - 1}"
