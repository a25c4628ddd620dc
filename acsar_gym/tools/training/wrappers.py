"""What recipes name as `vec_env_wrapper`. Imports torch.

`batch` is a compiled batch for RL Zoo. `without_rays` leaves out of the observation what belongs to
one kind of LiDAR.
"""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.spaces import Box
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecEnvWrapper, VecMonitor
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from acsar_gym.errors import ConfigError
from acsar_gym.sensors import LIDAR, MAP
from acsar_gym.tools.policies.sb3 import BatchVecEnv, make_batch

SINGLE_ENV_ARGUMENTS = (
    *("link", "lidar", "on_fault", "view", "record", "render_mode", "disable_env_checker"),
)
"""Arguments that only a single env has."""


def batch(env: VecEnv, *, randomize: bool = True, threads: int | None = None) -> VecEnv:
    """Replace the single envs that RL Zoo has made by one batch of as many robots.

    A single env stays as it is, so that RL Zoo evaluates and renders with the real one.

    Returns:
        The batch, with the Monitor file of the envs if they had one.
    """
    if env.num_envs == 1:
        return env
    spec = env.get_attr("spec", 0)[0]
    options = {k: v for k, v in spec.kwargs.items() if k not in SINGLE_ENV_ARGUMENTS}
    if randomize:
        options.setdefault("randomization", True)

    robots: VecEnv = make_batch(spec.id, env.num_envs, threads=threads, **options)
    robots._seeds = list(env._seeds)  # noqa: SLF001 - what make_vec_env has seeded
    files = _monitor_files(env)
    env.close()
    for path in files:
        path.unlink(missing_ok=True)  # they are empty
    if not files:
        return robots
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that a batch has the statistics of Monitor already
        return VecMonitor(robots, str(files[0]))


def _monitor_files(env: VecEnv) -> list[Path]:
    """Return the files to which the Monitors of single envs write."""
    envs = env.envs if isinstance(env, DummyVecEnv) else []
    writers: list[Any] = [single.results_writer for single in envs if isinstance(single, Monitor)]
    return [Path(writer.file_handler.name) for writer in writers if writer is not None]


def without_rays(env: VecEnv) -> VecEnv:
    """Leave the LiDAR's own numbers, and what follows them, out of observations.

    What the map and the sensor of movers contain is in units of the robot: a policy that observes
    no more can drive robots whose LiDAR has other rays.
    """
    inner = env.unwrapped
    robot = inner.robots if isinstance(inner, BatchVecEnv) else env.get_attr("unwrapped", 0)[0]
    sensors = list(robot.sensors)
    names = [sensor.name for sensor in sensors]
    if MAP not in names or LIDAR not in names:
        raise ConfigError("without_rays: must wrap robots with a map and a LiDAR")
    kept = sensors[: names.index(LIDAR)]
    return FirstNumbers(env, len(robot.task.observation) + sum(sensor.size for sensor in kept))


class FirstNumbers(VecEnvWrapper):
    """Keeps the first numbers of observations."""

    def __init__(self, venv: VecEnv, count: int) -> None:
        space: Any = venv.observation_space
        super().__init__(venv, Box(space.low[:count], space.high[:count]))
        self._count = count

    def reset(self) -> VecEnvObs:
        """Start a new episode of every robot; returns observations (robots, count)."""
        observations: Any = self.venv.reset()
        kept: VecEnvObs = observations[:, : self._count]
        return kept

    def step_wait(self) -> VecEnvStepReturn:
        """Return what the envs return, with shorter observations."""
        observations, rewards, dones, infos = self.venv.step_wait()
        for index in np.flatnonzero(dones):
            last = infos[index]["terminal_observation"]
            infos[index]["terminal_observation"] = last[: self._count]
        return observations[:, : self._count], rewards, dones, infos  # type: ignore[call-overload, index]
