"""What recipes name as `vec_env_wrapper`. Imports torch.

`batch` is a compiled batch for RL Zoo. `without_rays` leaves out of the observation what belongs to
one kind of LiDAR.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium.spaces import Box
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from acsar_gym.errors import ConfigError
from acsar_gym.sensors import LIDAR, MAP
from acsar_gym.tools.policies.sb3 import BatchVecEnv, make_batch

SINGLE_ENV_ARGUMENTS = (
    *("link", "lidar", "on_fault", "view", "record", "render_mode", "disable_env_checker"),
)
"""Arguments that only a single env has."""


def batch(env: VecEnv) -> VecEnv:
    """Replace the single envs that RL Zoo has made by one batch of as many robots.

    A single env stays as it is, so that RL Zoo evaluates and renders with the real env. The batch
    has the statistics of Monitor, but writes no file of them.
    """
    if env.num_envs == 1:
        return env
    spec = env.get_attr("spec", 0)[0]
    options = {k: v for k, v in spec.kwargs.items() if k not in SINGLE_ENV_ARGUMENTS}
    robots = make_batch(spec.id, env.num_envs, **{"randomization": True} | options)
    # Seeds that RL Zoo has set before the envs were replaced must not be lost.
    robots._seeds = list(env._seeds)  # noqa: SLF001 - what make_vec_env has seeded
    env.close()
    return robots


def without_rays(env: VecEnv) -> VecEnv:
    """Leave the LiDAR's own numbers, and those behind them, out of observations.

    What the map and the sensor of movers contain is in units of the robot: a policy that observes
    no more can drive robots whose LiDAR has other rays.
    """
    # RL Zoo evaluates with single envs, which are wrapped as well.
    inner = env.unwrapped
    robot = inner.robots if isinstance(inner, BatchVecEnv) else env.get_attr("unwrapped", 0)[0]
    sensors = {sensor.name: sensor.size for sensor in robot.sensors}
    if MAP not in sensors or LIDAR not in sensors:
        raise ConfigError("without_rays: must wrap robots with a map and a LiDAR")
    kept = [*sensors.values()][: [*sensors].index(LIDAR)]
    return FirstNumbers(env, len(robot.task.observation) + sum(kept))


class FirstNumbers(VecEnvWrapper):
    """Keeps the first numbers of observations."""

    def __init__(self, venv: VecEnv, count: int) -> None:
        space: Any = venv.observation_space
        super().__init__(venv, Box(space.low[:count], space.high[:count]))
        self._count = count

    def reset(self) -> VecEnvObs:
        """Start a new episode of every robot, and return observations (robots, count)."""
        observations: Any = self.venv.reset()
        kept: VecEnvObs = observations[:, : self._count]
        return kept

    def step_wait(self) -> VecEnvStepReturn:
        """Return the envs' results, with shorter observations."""
        observations: Any
        observations, rewards, dones, infos = self.venv.step_wait()
        for index in np.flatnonzero(dones):
            last = infos[index]["terminal_observation"]
            infos[index]["terminal_observation"] = last[: self._count]
        return observations[:, : self._count], rewards, dones, infos
