"""Policies in stable-baselines3 zips. Loading one can run code, so the user must trust the file."""

from __future__ import annotations

import hashlib
import importlib
import io
import warnings
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium.spaces import Box, Dict, Space
from numpy.typing import NDArray

from acsar_gym import reading
from acsar_gym.config import RobotConfig
from acsar_gym.errors import (
    MissingExtraError,
    PolicyError,
    escape_unprintable,
    format_error,
    require_extra,
)
from acsar_gym.sensors import Sensor
from acsar_gym.tasks import Observation, Task
from acsar_gym.tasks.factory import task_name
from acsar_gym.tasks.spec import task_spaces
from acsar_gym.tools.policies.bundle import BUNDLE_KEY, parse_bundle
from acsar_gym.tools.policies.policy import NO_POLICY, FilePolicy, resolve

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm

MAX_ZIP_BYTES = 500_000_000
MAX_UNPACKED_BYTES = 50_000_000
"""Most bytes of a zip that was packed, once it is unpacked."""
ZIP_ALGORITHMS = "PPO, A2C, SAC, TD3, DDPG, TQC or RecurrentPPO"
ALGORITHM_MODULES = {
    "RecurrentActorCriticPolicy": ("sb3_contrib", "RecurrentPPO"),
    "ActorCriticPolicy": ("stable_baselines3", "PPO"),  # A2C's policies, too
    "SACPolicy": ("stable_baselines3", "SAC"),
    "TD3Policy": ("stable_baselines3", "TD3"),  # DDPG's, too
    "TQCPolicy": ("sb3_contrib", "TQC"),
}
"""Module and class that load a policy, by the base class of the policy, the most special first."""
INFERENCE_OBJECTS = {"learning_rate": 0.0, "lr_schedule": None, "clip_range": 0.0, "buffer_size": 1}
"""Stand in for what only training needs; other Python versions may not unpickle schedules."""


class ZipPolicy(FilePolicy):
    """A policy from a zip of PPO, A2C, SAC, TD3, DDPG, TQC or RecurrentPPO.

    Loading a zip can run any code in it. Statistics of a VecNormalize aren't part of a zip. A
    policy that was trained with VecFrameStack gets the last observations side by side, as there.

    Args:
        path: the zip.
        trust: whether the user trusts the zip; without it, only the names in it are read.
        env_id: id of the env that it is for; by default the one that `sb3.label` stored in it.

    Raises:
        PolicyError: `trust` is False, or the file is missing, broken or of another algorithm.
        MissingExtraError: stable-baselines3 isn't installed.
    """

    def __init__(self, path: str | Path, *, trust: bool = False, env_id: str = "") -> None:
        self.path = resolve(path)
        content = reading.read_file(self.path, MAX_ZIP_BYTES, PolicyError)
        if not _is_model(content):
            raise PolicyError(f"{self.path}: {NO_POLICY}")
        if not trust:
            raise PolicyError(
                f"{self.path}: a stable-baselines3 zip can run any code when it's loaded: pass "
                "--trust if you made it or trust whoever did, or convert it once with "
                f"'acsar-gym export {self.path} policy.onnx --trust'"
            )
        try:
            data, self.network, self.algorithm = _load_zip(content)
            said = data.get(BUNDLE_KEY)
            self.bundle = None if said is None else parse_bundle(str(said))
        except MissingExtraError:
            raise
        except PolicyError as error:
            raise PolicyError(f"{self.path}: {error}") from error
        except Exception as error:
            said = format_error(error)
            raise PolicyError(f"{self.path}: not a stable-baselines3 model: {said}") from error
        self.sha256 = hashlib.sha256(content).hexdigest()
        by_train = self.bundle is not None and self.bundle.training is not None
        self.normalized = not by_train and uses_normalization(data)
        """Whether it was trained with a VecNormalize of observations, as none of 'acsar-gym train'
        is."""
        own = "" if self.bundle is None else self.bundle.env.id
        self.env_id, self.env_named = env_id or own, bool(env_id)
        self._width = (self.network.observation_space.shape or (0,))[0]
        self.frames = 1
        """How many observations it gets at once; known once it is checked with an env."""
        self._state: tuple[NDArray[Any], ...] | None = None
        self._seen = np.zeros(0, np.float32)

    def check(
        self,
        task: Task,
        sensors: Sequence[Sensor],
        policy_rate: float | None = None,
        config: RobotConfig | None = None,
    ) -> None:
        """As FilePolicy.check; also compares the spaces, and counts the frames.

        Args:
            task: of the env.
            sensors: of the env's robot.
            policy_rate: env steps per second [Hz]; None where it isn't known.
            config: of the env's robot; None where it isn't known.

        Raises:
            PolicyError: the policy was made for other spaces than this env has.
        """
        super().check(task, sensors, policy_rate, config)
        action, seen = task_spaces(task, sensors)
        times, rest = divmod(self._width, len(seen.low))
        self.frames = 1 if rest else max(times, 1)
        low, high = (np.repeat(end, self.frames)[: self._width] for end in (seen.low, seen.high))
        own = Box(low, high)  # in VecFrameStack's order; a policy may leave out the last numbers
        spaces = self.network.action_space, self.network.observation_space
        for space, wanted, whole in zip(spaces, (action, own), (action, seen), strict=True):
            if space != wanted:
                raise PolicyError(
                    f"{self.path}: made for {describe_space(space)}, but {task_name(task)} has "
                    f"{describe_space(whole)}: of the wrappers that change observations, only "
                    "VecNormalize and VecFrameStack can be part of a policy"
                )

    def reset(self) -> None:
        """Begin an episode: earlier observations and states become zero."""
        self._state = None
        self._seen = np.zeros(0, np.float32)

    def __call__(self, observation: Observation) -> NDArray[np.float32]:
        """Compute the deterministic action in [-1, 1], shape (2,), for one observation."""
        if self.frames > 1:
            width = self.frames * observation.size
            padded = (np.zeros(width, np.float32), self._seen, observation)
            observation = self._seen = np.concatenate(padded)[-width:]
        observation = observation[: self._width]
        begun = np.array([self._state is None])
        action, self._state = self.network.predict(
            observation, self._state, begun, deterministic=True
        )
        return np.asarray(action, np.float32)


def statistics_beside(path: Path) -> Path | None:
    """Find a saved VecNormalize in a model's folder or, as RL Zoo stores it, one folder deeper.

    Args:
        path: the model's zip.

    Returns:
        The first such file; None where there is none.
    """
    patterns = ("*vecnormalize*.pkl", "*/vecnormalize.pkl")
    return next((f for p in patterns for f in sorted(path.parent.glob(p))), None)


def describe_space(space: Space[Any]) -> str:
    """Describe a space in a few words, however many numbers it has."""
    if isinstance(space, Box):
        return f"Box({space.low.min()}, {space.high.max()}, {space.shape})"
    if isinstance(space, Dict):
        return f"a Dict of {escape_unprintable(', '.join(map(str, space)))}"
    return f"a {type(space).__name__}"


def uses_normalization(data: Mapping[str, Any]) -> bool:
    """Find out whether a model was trained with a VecNormalize that changes observations.

    A zip has the last observation as the network got it, and an original one where there was a
    VecNormalize. SAC, TD3, DDPG and TQC have an original one always, so that there what the network
    got must have left the observation space.
    """
    seen, original = data.get("_last_obs"), data.get("_last_original_obs")
    if seen is None or original is None or np.array_equal(seen, original):
        return False
    space = data["observation_space"]
    within = [((one >= space.low) & (one <= space.high)).all() for one in (original, seen)]
    return "replay_buffer_class" not in data or within == [True, False]


def _is_model(data: bytes) -> bool:
    """Whether the names in a zip are those of a model of stable-baselines3."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            return {"data", "policy.pth"} <= set(archive.namelist())
    except (OSError, ValueError, NotImplementedError, zipfile.BadZipFile):
        return False


def _load_zip(content: bytes) -> tuple[dict[str, Any], Any, str]:
    """Load a model; returns its data, its policy, and the algorithm that it was loaded with."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        size = sum(entry.file_size for entry in archive.infolist())
    if size > max(MAX_UNPACKED_BYTES, len(content)):  # stable-baselines3 doesn't pack anything
        raise PolicyError(f"unpacks to {size / 1e6:,.0f} MB, too much for what it is")
    with require_extra("loading a stable-baselines3 zip", "train"):
        from stable_baselines3.common.save_util import load_from_zip_file  # noqa: PLC0415
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about objects that can't be unpickled and aren't needed
        read, _, _ = load_from_zip_file(
            io.BytesIO(content), device="cpu", custom_objects=INFERENCE_OBJECTS
        )
        data: dict[str, Any] = read or {}
        bases = {base.__name__ for base in data["policy_class"].__mro__}
        found = next((ALGORITHM_MODULES[name] for name in ALGORITHM_MODULES if name in bases), None)
        if found is None:
            raise PolicyError(
                f"holds a {data['policy_class'].__name__}, not one of {ZIP_ALGORITHMS}"
            )
        if not isinstance(data["observation_space"], Box):
            raise PolicyError(
                f"made for observations that are {describe_space(data['observation_space'])}: a "
                "policy of this package gets one row of numbers: train on the env without the "
                "wrapper that made them"
            )
        with require_extra("loading a stable-baselines3 zip", "train"):
            algorithm: type[BaseAlgorithm] = getattr(importlib.import_module(found[0]), found[1])
        model = algorithm.load(io.BytesIO(content), device="cpu", custom_objects=INFERENCE_OBJECTS)
    return data, model.policy, algorithm.__name__
