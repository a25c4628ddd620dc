"""The time limit of an episode, of which the env is the owner, wherever a user has set it.

`gymnasium.make` hands `max_episode_steps` to a wrapper alone, whose `step` says nothing to the env
inside: the wheels would go on turning. So the env looks which wrappers call its `reset`.
"""

from __future__ import annotations

import sys
import weakref
from types import FrameType
from typing import Any

import gymnasium
from gymnasium.wrappers import TimeLimit


def find_limits(env: gymnasium.Env[Any, Any]) -> list[weakref.ref[Any]]:
    """Find the TimeLimit wrappers around an env whose `reset` is running.

    Weak references, because else `del env` would stop nothing.
    """
    limits = []
    frame: FrameType | None = sys._getframe(1)  # noqa: SLF001 - Gymnasium has no other way
    while frame is not None:
        if frame.f_code is TimeLimit.reset.__code__ and frame.f_locals["self"].unwrapped is env:
            limits.append(weakref.ref(frame.f_locals["self"]))
        frame = frame.f_back
    return limits


def is_last_step(limit: weakref.ref[Any]) -> bool:
    """Return whether a wrapper's limit ends the episode with the running step.

    By the wrapper's own count, as others between it and the env may repeat steps.
    """
    wrapper = limit()
    if wrapper is None:
        return False
    ended: bool = wrapper._elapsed_steps + 1 >= wrapper._max_episode_steps  # noqa: SLF001
    return ended
