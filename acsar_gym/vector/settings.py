"""The options that all batches have, beside those of their task."""

from __future__ import annotations

import os
import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode

from acsar_gym import jit
from acsar_gym.errors import ConfigError, shown
from acsar_gym.tasks.options import Options

MOST_ROBOTS = 1_000_000
"""Robots of a batch, at most; so many take about 2 GB."""
MOST_STEPS = 10**9
"""Largest time limit of an episode [steps]."""
FAIR_SHARE = 256
"""A thread more is used for so many robots; with fewer its start costs more than it saves."""


@dataclass(frozen=True, kw_only=True)
class BatchOptions(Options):
    """The options of a batch; `RobotVectorEnv` describes them."""

    max_episode_steps: int | None = None
    autoreset_mode: Any = AutoresetMode.NEXT_STEP
    threads: int | None = None
    link: str = "planar"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.link != "planar":
            raise ConfigError(
                f"link = {self.link!r}: a batch has planar robots; for others make_vec with "
                "vectorization_mode='sync' or 'async'"
            )
        if self.render_mode is not None:
            raise ConfigError("a batch of robots has no pictures: render a single env instead")
        if self.max_episode_steps is not None:
            count("max_episode_steps", self.max_episode_steps, MOST_STEPS)
        object.__setattr__(self, "autoreset_mode", _autoreset(self.autoreset_mode))
        if not jit.COMPILED:
            warnings.warn(
                "numba isn't installed, so batches are slow: pip install 'acsar_gym[fast]'",
                RuntimeWarning,
                stacklevel=6,
            )


def _autoreset(mode: AutoresetMode | str) -> AutoresetMode:
    """Convert an autoreset mode or its value; ConfigError for anything else."""
    try:
        return AutoresetMode(mode)
    except ValueError:
        known = ", ".join(repr(known.value) for known in AutoresetMode)
        raise ConfigError(f"autoreset_mode = {mode!r}: must be one of {known}") from None


def count(name: str, value: int, most: int) -> int:
    """Check that an option is a whole number from 1 to `most`, and return it.

    Args:
        name: of the option, for the message.
        value: of the option.
        most: largest allowed value.

    Raises:
        ConfigError: for anything else.
    """
    if not isinstance(value, int | np.integer) or not 1 <= value <= most:
        raise ConfigError(f"{name} = {shown(value)}: must be a whole number from 1 to {most:,}")
    return int(value)


def cores() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def check_threads(name: str, asked: int) -> int:
    """Check a number of threads that a user asked for, and return it.

    Args:
        name: of the option, for the message.
        asked: by the user.

    Raises:
        ConfigError: for fewer than 1, or more than the cores that this process may use.
    """
    usable, all_cores = cores(), os.cpu_count() or 1
    if isinstance(asked, int | np.integer) and 1 <= asked <= usable:
        return int(asked)
    which = "the cores of this machine"
    if usable < all_cores:
        which = (
            f"the cores that this process may use: taskset, a batch system or a container keeps "
            f"it from the others of this machine's {all_cores}"
        )
    most = f"1 to {usable}" if usable > 1 else "1"
    raise ConfigError(f"{name} {shown(asked)}: must be {most}, {which}")


def threads_for(asked: int | None, robots: int) -> int:
    """Number of threads to use.

    Args:
        asked: by the user; None uses all cores, but gives each at least FAIR_SHARE robots.
        robots: of the batch.

    Raises:
        ConfigError: as `check_threads`.
    """
    if asked is None:
        return max(1, min(cores(), robots // FAIR_SHARE))
    return min(check_threads("threads =", asked), robots)
