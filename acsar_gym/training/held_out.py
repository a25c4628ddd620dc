"""Success of a policy that is being trained, in worlds and from seeds that it never trains on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acsar_gym.vector.env import RobotVectorEnv
from acsar_gym.worlds.pool import Pool

ROBOTS = 64
"""Robots, and so episodes, of an evaluation during training."""
FIRST_WORLD = 900
"""Held-out worlds begin here: between those of the final evaluation and those of the training."""
FIRST_SEED = 2**32
"""Seeds of the held-out episodes begin here; those of a training are below."""

Decide = Callable[[NDArray[np.float32]], NDArray[Any]]
"""Actions (n, 2) for observations (n, m)."""


@dataclass(frozen=True, slots=True)
class Score:
    """What one episode of every robot came to."""

    episodes: int
    success_rate: float
    collision_rate: float
    """Episodes without success at whose end the robot touched an obstacle."""
    mean_return: float
    mean_length: float
    """[steps]"""


def evaluate(batch: RobotVectorEnv, decide: Decide) -> Score:
    """Run every robot to the end of its first episode, always from the same seeds.

    Quick and slow episodes count alike: whoever takes the first n episodes that end, whichever
    robot they are of, counts the quick ones more often. The batch needs a time limit.
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
    """What a score of these robots is, for people."""
    if _others(batch):
        return "held-out success"
    return "success in the same worlds, other seeds"


def told(learning: RobotVectorEnv, batch: RobotVectorEnv) -> str:
    """Where the robots learn and where they are evaluated, for people."""
    pools = [one.pool for one in (learning, batch)]
    if pools[0] is None:
        return "training on an open floor, held out: other seeds"
    apart = (
        f"held out: {pools[1]}" if _others(batch) else "evaluated in the same worlds, other seeds"
    )
    return f"training in {pools[0]}, {apart}"


def _others(batch: RobotVectorEnv) -> bool:
    """Whether its episodes are in other worlds, or to other goals on the open floor."""
    pool = batch.pool
    return pool is None or pool.generated


def worlds_beside(pool: Pool | None) -> str | None:
    """ROBOTS generated worlds of the same kind, none of which is in this pool.

    None where there are no others, as for files and on the open floor: only other seeds.
    """
    if pool is None or not pool.generated:
        return None
    first = FIRST_WORLD
    if pool.numbers[0] < FIRST_WORLD + ROBOTS and pool.numbers[-1] >= FIRST_WORLD:
        first = pool.numbers[-1] + 1
    return f"{pool.kind}:{first}-{first + ROBOTS - 1}"
