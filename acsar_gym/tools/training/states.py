"""Takes and restores the state of a training between two rollouts. Imports torch."""

from __future__ import annotations

import random
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm

from acsar_gym.errors import ConfigError
from acsar_gym.tools.training.checkpoints import TrainingState, select_arrays
from acsar_gym.vector import env
from acsar_gym.vector.env import RobotVectorEnv

REPLAY_ARRAYS = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")
"""Arrays of a replay buffer; those of its next observations may be empty."""
Arrays = dict[str, NDArray[Any]]


def take_state(
    model: BaseAlgorithm, batch: RobotVectorEnv, seconds: float, history: list[dict[str, float]]
) -> TrainingState:
    """Copy the state of a training; its model isn't part of it.

    Args:
        model: the model, between two rollouts.
        batch: the robots that it trains on.
        seconds: time so far [s].
        history: the learning curve so far.
    """
    arrays: Arrays = {"torch": torch.get_rng_state().numpy()}
    if torch.cuda.is_available():
        arrays["cuda"] = torch.cuda.get_rng_state().numpy()
    kind, keys, *rest = np.random.get_state(legacy=True)  # noqa: NPY002 - stable-baselines3 uses it
    arrays["numpy"] = np.asarray(keys)
    sections = {"batch": env.copy_state(batch), "lstm": _lstm(model), "replay": _replay(model)}
    for section, found in sections.items():
        arrays |= {f"{section}/{name}": array for name, array in (found or {}).items()}
    generators = {
        "numpy": [kind, *rest],
        "python": random.getstate(),
        "space": model.action_space.np_random.bit_generator.state,
    }
    return TrainingState(model.num_timesteps, seconds, list(history), generators, arrays)


def restore_state(state: TrainingState, model: BaseAlgorithm, batch: RobotVectorEnv) -> None:
    """Restore all but the model itself, right before the next rollout.

    Args:
        state: what `taken` has returned.
        model: the model of the same checkpoint.
        batch: like the one that it was trained on.

    Raises:
        ConfigError: the state is of another training.
    """
    arrays, generators = state.arrays, state.random
    try:
        if select_arrays(arrays, "batch"):
            env.restore_state(batch, select_arrays(arrays, "batch"))
        _restore_lstm(model, select_arrays(arrays, "lstm"))
        _restore_replay(model, select_arrays(arrays, "replay"))
        kind, *rest = generators["numpy"]
        np.random.set_state((kind, arrays["numpy"], *rest))  # noqa: NPY002
        version, keys, gauss = generators["python"]
        random.setstate((version, tuple(keys), gauss))
        model.action_space.np_random.bit_generator.state = generators["space"]
        torch.set_rng_state(torch.from_numpy(arrays["torch"]))
        if "cuda" in arrays and torch.cuda.is_available():
            torch.cuda.set_rng_state(torch.from_numpy(arrays["cuda"]))
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise ConfigError(f"the checkpoint is of another training: {error}") from None


def resumes_exactly(state: TrainingState) -> bool:
    """Return whether the robots go on in mid-episode, too."""
    return bool(select_arrays(state.arrays, "batch"))


def _lstm(model: Any) -> Arrays | None:
    """Copy the hidden states of a recurrent policy."""
    states = getattr(model, "_last_lstm_states", None)
    if states is None:
        return None
    pairs = zip(("pi", "vf"), states, strict=True)
    return {f"{name}{i}": pair[i].cpu().numpy() for name, pair in pairs for i in (0, 1)}


def _restore_lstm(model: Any, arrays: Arrays) -> None:
    """Restore the hidden states of a recurrent policy."""
    if not arrays:
        return
    kind, device = type(model._last_lstm_states), model.device  # noqa: SLF001
    tensors = {name: torch.from_numpy(array).to(device) for name, array in arrays.items()}
    model._last_lstm_states = kind(  # noqa: SLF001
        *((tensors[f"{name}0"], tensors[f"{name}1"]) for name in ("pi", "vf"))
    )


def _replay(model: Any) -> Arrays | None:
    """Copy the filled part of a replay buffer."""
    buffer = getattr(model, "replay_buffer", None)
    if buffer is None:
        return None
    filled = buffer.buffer_size if buffer.full else buffer.pos
    arrays = {name: getattr(buffer, name, None) for name in REPLAY_ARRAYS}
    copied = {name: array[:filled] for name, array in arrays.items() if array is not None}
    return copied | {"place": np.array([buffer.pos, buffer.full])}


def _restore_replay(model: Any, arrays: Arrays) -> None:
    """Fill a replay buffer."""
    if not arrays:
        return
    buffer, place = model.replay_buffer, arrays.pop("place")
    for name, array in arrays.items():
        getattr(buffer, name)[: len(array)] = array
    buffer.pos, buffer.full = int(place[0]), bool(place[1])
