"""Batches of robots as a VecEnv of stable-baselines3."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray

from acsar_gym.envs import ids
from acsar_gym.errors import ConfigError, require_extra
from acsar_gym.vector.env import RobotVectorEnv

with require_extra("stable-baselines3", "train"):
    from stable_baselines3.common.vec_env import VecEnv

_NO_INFO: dict[str, Any] = {}
"""Info of a robot whose episode goes on."""


class BatchVecEnv(VecEnv):
    """A RobotVectorEnv as stable-baselines3's VecEnv, with the episode statistics of Monitor.

    `make_batch` makes one. The batch may be inside Gymnasium's vector wrappers, and must use
    AutoresetMode.SAME_STEP. While an episode goes on, the info of its robot is one shared empty
    dict. At its end the info has `terminal_observation`, `episode` (r, l, t), `is_success`,
    `TimeLimit.truncated`, and, if the batch has them, the number of its `world` and the `drawn_`
    keys of its randomization. There are no single envs, so methods of single envs can't be called.

    Args:
        batch: The batch to wrap.

    Raises:
        ConfigError: It isn't a RobotVectorEnv, or has another autoreset mode.
    """

    def __init__(self, batch: VectorEnv[Any, Any, Any]) -> None:
        if not isinstance(batch.unwrapped, RobotVectorEnv):
            raise ConfigError(f"{batch}: not a batch of acsar_gym: use sb3.make_batch")
        if batch.metadata["autoreset_mode"] is not AutoresetMode.SAME_STEP:
            raise ConfigError("stable-baselines3 needs autoreset_mode='SameStep'")
        self._batch: Any = batch  # Any: VectorEnv types `seed` as int, ours also takes a list
        super().__init__(batch.num_envs, batch.single_observation_space, batch.single_action_space)
        self._actions: NDArray[np.float32] = np.zeros((batch.num_envs, 2), np.float32)
        self._started = time.monotonic()
        self._kept_options: dict[str, Any] = {}

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
        seeds = None if self._seeds == [None] * self.num_envs else self._seeds
        observations: NDArray[np.float32]
        observations, _ = self._batch.reset(seed=seeds, options=self._kept_options)
        self._reset_seeds()
        return observations

    def set_options(self, options: list[dict[str, Any]] | dict[str, Any] | None = None) -> None:
        """Set the options of `RobotVectorEnv.reset` for all later episodes, as for a curriculum.

        Running episodes go on.

        Args:
            options: One dict, whose values may have a row for each robot. None removes the options.

        Raises:
            ConfigError: An option is unknown, or it is a list, or "reset_mask": all robots are
                reset.
        """
        # A batch is reset as a whole.
        options = options or {}
        if isinstance(options, list):
            raise ConfigError(
                "set_options: give one dict for all robots, whose values may have a row for each"
            )
        if "reset_mask" in options:
            raise ConfigError("set_options: leave out reset_mask: all robots are reset")

        # A training resets its robots only once, so the batch needs the options at once.
        self.robots.set_options(options)
        self._kept_options = dict(options)

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
        # Infos of hundreds of robots would cost more than the step: most are one empty dict.
        done = terminated | truncated
        infos = [_NO_INFO] * self.num_envs
        for robot in np.flatnonzero(done):
            infos[robot] = self._describe_end(int(robot), info)
            infos[robot]["TimeLimit.truncated"] = bool(truncated[robot] and not terminated[robot])
        return observations, rewards.astype(np.float32), done, infos

    def _describe_end(self, robot: int, info: dict[str, Any]) -> dict[str, Any]:
        """Return the info of a robot whose episode has ended."""
        # The batch has already begun the next episode: its info is of that.
        final = {name: row[robot] for name, row in info["final_info"].items()}
        described = {name: final[name] for name in final if name.startswith("drawn_")}
        if "world" in final:
            described["world"] = int(final["world"])
        return described | {
            "terminal_observation": info["final_obs"][robot],
            "is_success": bool(final["is_success"]),
            "episode": {
                "r": float(final["episode_return"]),
                "l": int(final["episode_length"]),
                "t": time.monotonic() - self._started,
            },
        }

    def close(self) -> None:
        """Close the batch."""
        self._batch.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return an attribute of the batch, repeated for each index."""
        # All robots of a batch have the same attributes.
        holder = self._batch if hasattr(self._batch, attr_name) else self._batch.unwrapped
        return [getattr(holder, attr_name)] * len(list(self._get_indices(indices)))

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
        # Algorithms would otherwise wrap the batch in a VecMonitor.
        return [wrapper_class.__name__ == "Monitor"] * len(list(self._get_indices(indices)))

    def get_images(self) -> Sequence[NDArray[np.uint8] | None]:
        """Return a picture for each robot, of which the first 16 are drawn.

        Each is None if the batch was made without `render_mode="rgb_array"`.
        """
        return self._batch.render() or [None] * self.num_envs


def make_batch(env_id: str, num_envs: int, **options: Any) -> BatchVecEnv:
    """Make a batch of planar robots for training with stable-baselines3, in one process.

    Args:
        env_id: "point_goal", "acsar_gym/PointGoal-v0", or another package's id with the module
            that registers it, as in "mine.module:mine/Clearance-v0".
        num_envs: Number of robots.
        **options: Arguments of the env and of `RobotVectorEnv`: robot, worlds, randomization,
            threads, ...

    Returns:
        The batch, for the `env` argument of an algorithm.

    Raises:
        ConfigError: An id or option is unknown.
    """
    options = {"autoreset_mode": AutoresetMode.SAME_STEP, **options}
    return BatchVecEnv(ids.make_vec(ids.find_id(env_id), num_envs, **options))
