"""The time limit of an episode, which Gymnasium keeps outside of the environment.

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


class StepLimit:
    """Says which step is an episode's last.

    Args:
        steps: the env's own limit [steps]; None is none.
    """

    def __init__(self, steps: int | None) -> None:
        self._steps = steps
        self._wrappers: list[weakref.ref[TimeLimit]] = []

    def find_wrappers(self, env: gymnasium.Env[Any, Any]) -> None:
        """Find the TimeLimit wrappers around an env; to be called in its `reset`."""
        self._wrappers = []
        frame: FrameType | None = sys._getframe(1)  # noqa: SLF001 - Gymnasium has no other way
        while frame is not None:
            if frame.f_code is TimeLimit.reset.__code__:
                wrapper = frame.f_locals["self"]
                if wrapper.unwrapped is env:
                    self._wrappers.append(weakref.ref(wrapper))  # else `del env` would stop nothing
            frame = frame.f_back

    def is_last(self, step: int) -> bool:
        """Return whether no step follows, by the env's own limit or a wrapper's.

        A wrapper is asked for its own count, as others between it and the env may repeat steps.

        Args:
            step: number of the env's step, from 1.
        """
        if self._steps is not None and step >= self._steps:
            return True
        wrappers: list[Any] = [reference() for reference in self._wrappers]
        return any(
            one._elapsed_steps + 1 >= one._max_episode_steps  # noqa: SLF001
            for one in wrappers
            if one is not None
        )

    def __reduce__(self) -> tuple[type[StepLimit], tuple[int | None]]:
        """Copies find the wrappers of their own env."""
        return StepLimit, (self._steps,)
