"""Compile and generate ahead of time what the first use of an environment needs.

That is the compiled loops and the worlds of a batch, which are kept on disk.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from numba.core import event

from acsar_gym.config.robot import RobotSource
from acsar_gym.envs import ids
from acsar_gym.jit import LOG
from acsar_gym.registration import IDS, snake_case

ENV_NAMES = tuple(snake_case(name.partition("-")[0]) for name in IDS)
"""Short names of this package's ids."""


class WarmUp(NamedTuple):
    """How many functions were compiled, how many worlds are kept now, and how long it took [s]."""

    functions: int
    worlds: int
    seconds: float


def warm_env(name: str, robot: RobotSource = None, options: Mapping[str, Any] = {}) -> WarmUp:
    """Reset and step an env and a batch of an id once."""
    start = time.perf_counter()
    level = LOG.level
    LOG.setLevel(logging.ERROR)  # no warning that compiling takes long
    try:
        with event.install_recorder("numba:compile") as recorder:
            worlds = _use_env(ids.find_id(name), {"robot": robot, **options})
    finally:
        LOG.setLevel(level)
    functions = sum(entry.is_start for _, entry in recorder.buffer)
    return WarmUp(functions, worlds, time.perf_counter() - start)


def _use_env(env_id: str, options: Mapping[str, Any]) -> int:
    """Reset and step an env and a batch once. Returns the number of the batch's worlds."""
    # Single envs and batches compile different functions.
    env = gymnasium.make(env_id, link="planar", **options)
    env.reset(seed=0)
    env.step(np.zeros(2, np.float32))
    env.close()

    batch = ids.make_vec(env_id, 2, **options)
    batch.reset(seed=0)
    batch.step(np.zeros((2, 2)))
    batch.close()
    return 0 if batch.pool is None else len(batch.pool)
