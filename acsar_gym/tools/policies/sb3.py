"""Training with stable-baselines3: batches of robots as a VecEnv, and labels for saved models."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray

from acsar_gym.envs import ids
from acsar_gym.errors import ConfigError, MissingExtraError
from acsar_gym.tools.policies.bundle import BUNDLE_KEY, Bundle
from acsar_gym.vector.env import RobotVectorEnv

try:
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.vec_env import VecEnv
except ImportError:
    raise MissingExtraError("stable-baselines3", "train") from None


class BatchVecEnv(VecEnv):
    """A RobotVectorEnv as stable-baselines3's VecEnv, with the episode statistics of Monitor.

    The batch may be inside Gymnasium's vector wrappers; `make_batch` makes one. It must use
    AutoresetMode.SAME_STEP. While an episode goes on, the info of its robot is one shared empty
    dict; at its end the info has `terminal_observation`, `episode` (r, l, t), `is_success`,
    `TimeLimit.truncated`, and, where the batch has them, the number of its `world` and the `drawn_`
    keys of its randomization. There are no single envs, so methods of single envs can't be called.

    Args:
        batch: the batch to wrap.

    Raises:
        ConfigError: it isn't a RobotVectorEnv, or has another autoreset mode.
    """

    def __init__(self, batch: VectorEnv[Any, Any, Any]) -> None:
        if not isinstance(batch.unwrapped, RobotVectorEnv):
            raise ConfigError(f"{batch}: not a batch of acsar_gym; use sb3.make_batch")
        if batch.metadata["autoreset_mode"] is not AutoresetMode.SAME_STEP:
            raise ConfigError("stable-baselines3 needs autoreset_mode='SameStep'")
        self._batch: Any = batch  # Any: VectorEnv types `seed` as int, ours also takes a list
        super().__init__(batch.num_envs, batch.single_observation_space, batch.single_action_space)
        self._actions: NDArray[np.float32] = np.zeros((batch.num_envs, 2), np.float32)
        self._asked: dict[str, Any] = {}
        self._started = time.monotonic()

    @property
    def robots(self) -> RobotVectorEnv:
        """The batch, without Gymnasium's wrappers."""
        robots: RobotVectorEnv = self._batch.unwrapped
        return robots

    def reset(self) -> NDArray[np.float32]:
        """Start a new episode of every robot, with the seeds and options that were set before.

        Returns:
            Observations, float32 (robots, n).
        """
        seeded = any(seed is not None for seed in self._seeds)
        observations: NDArray[np.float32]
        seeds = self._seeds if seeded else None
        observations, _ = self._batch.reset(seed=seeds, options=self._asked)
        self._reset_seeds()
        return observations

    def set_options(self, options: list[dict[str, Any]] | dict[str, Any] | None = None) -> None:
        """Set the options of `RobotVectorEnv.reset` for all later episodes.

        Running episodes aren't affected.

        Args:
            options: one dict, whose values may have one row per robot; None removes the
                options.

        Raises:
            ConfigError: for unknown options, for a list, and for "reset_mask", as reset()
                always resets all robots.
        """
        if isinstance(options, list):
            raise ConfigError(
                "set_options: give one dict for all robots, whose values may have a row for each, "
                'such as {"world": [1000, 1001]}'
            )
        if options and "reset_mask" in options:
            raise ConfigError("set_options: 'reset_mask' isn't one here: all robots are reset")
        self._batch.unwrapped.set_options(options or {})
        self._asked = dict(options or {})

    def step_async(self, actions: NDArray[np.float32]) -> None:
        """Store actions (robots, 2) for `step_wait`."""
        self._actions = actions

    def step_wait(self) -> tuple[Any, Any, Any, list[dict[str, Any]]]:
        """Step every robot once.

        Returns:
            Observations (robots, n), rewards (robots,), dones (robots,), and one info per
            robot.
        """
        observations, rewards, terminated, truncated, info = self._batch.step(self._actions)
        done = terminated | truncated
        infos = [_GOES_ON] * self.num_envs
        for index in np.flatnonzero(done):
            infos[index] = self._ended(info, int(index))
            infos[index]["TimeLimit.truncated"] = bool(truncated[index] and not terminated[index])
        return observations, rewards.astype(np.float32), done, infos

    def _ended(self, info: dict[str, Any], index: int) -> dict[str, Any]:
        """Build the info of a robot whose episode has ended."""
        final = info["final_info"]
        return {
            "terminal_observation": info["final_obs"][index],
            "is_success": bool(final["is_success"][index]),
            "episode": {
                "r": float(final["episode_return"][index]),
                "l": int(final["episode_length"][index]),
                "t": time.monotonic() - self._started,
            },
            **{name: final[name][index] for name in final if name.startswith("drawn_")},
            **({"world": int(final["world"][index])} if "world" in final else {}),
        }

    def close(self) -> None:
        """Close the batch."""
        self._batch.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return an attribute of the batch, repeated for each index."""
        holder = self._batch if hasattr(self._batch, attr_name) else self._batch.unwrapped
        return [getattr(holder, attr_name)] * len(self._indices(indices))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Not supported: robots of a batch have no attributes of their own."""
        raise ConfigError(f"can't set {attr_name!r}: robots of a batch have no attributes")

    def env_method(
        self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any
    ) -> list[Any]:
        """Not supported: robots of a batch have no methods of their own."""
        raise ConfigError(f"can't call {method_name!r}: robots of a batch have no methods")

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        """Return True for Monitor, whose episode statistics are included, and False for others."""
        return [wrapper_class.__name__ == "Monitor"] * len(self._indices(indices))

    def get_images(self) -> Sequence[NDArray[np.uint8] | None]:
        """Return None for every robot: a batch renders no pictures."""
        return [None] * self.num_envs

    def _indices(self, indices: int | Iterable[int] | None) -> list[int]:
        return list(self._get_indices(indices))


def make_batch(env_id: str, num_envs: int, **options: Any) -> BatchVecEnv:
    """Make a batch of planar robots for training with stable-baselines3, in one process.

    Args:
        env_id: "point_goal", "acsar_gym/PointGoal-v0", or another package's id with the module
            that registers it, as in "mine.module:mine/Clearance-v0".
        num_envs: number of robots.
        **options: arguments of the env and of `RobotVectorEnv`: robot, worlds, randomization,
            threads, ...

    Returns:
        The batch, for the `env` argument of an algorithm.

    Raises:
        ConfigError: for unknown ids and options.
    """
    options = {"autoreset_mode": AutoresetMode.SAME_STEP, **options}
    return BatchVecEnv(ids.make_vec(ids.find_id(env_id), num_envs, **options))


_GOES_ON: dict[str, Any] = {}


def label(model: BaseAlgorithm, bundle: Bundle) -> None:
    """Store in a model what it was trained for and how; `model.save` keeps this."""
    setattr(model, BUNDLE_KEY, bundle.as_json())
