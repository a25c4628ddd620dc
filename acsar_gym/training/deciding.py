"""Deterministic actions of a model that is being trained. Imports torch."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm

from acsar_gym.training.held_out import Decide


def decider(model: BaseAlgorithm) -> Decide:
    """Return a function from observations (n, m) to deterministic actions (n, 2).

    A recurrent policy's state begins at the first call, and is kept for all robots from then on.

    Args:
        model: of any algorithm that `train` knows.
    """
    policy: Any = model.policy
    if hasattr(policy, "lstm_actor"):
        return _Recurrent(model)
    device = policy.device

    def decide(seen: NDArray[np.float32]) -> NDArray[np.float32]:
        """As the policy's `predict`, in half the time."""
        with torch.no_grad():
            action = policy._predict(torch.from_numpy(seen).to(device), deterministic=True)  # noqa: SLF001
        clipped: NDArray[np.float32] = np.clip(action.cpu().numpy(), -1.0, 1.0)
        return clipped

    return decide


class _Recurrent:
    """Decides with the state that the policy has returned with its last decision."""

    def __init__(self, model: BaseAlgorithm) -> None:
        self._model, self._state = model, None

    def __call__(self, seen: NDArray[np.float32]) -> NDArray[np.float32]:
        begun = np.full(len(seen), self._state is None)
        action, state = self._model.predict(seen, self._state, begun, deterministic=True)
        self._state = state  # type: ignore[assignment]
        return np.asarray(action, np.float32)
