"""What recipes name as `vec_env_wrapper`. Imports torch.

`batch` is a compiled batch for RL Zoo. `Detours` are rewards for robots that know the way, added in
training only. A task rewards coming nearer to the goal in a straight line, which leads into every
dead end. There the way around the obstacles counts instead, as the simulator knows it: a robot that
turns back is rewarded at once. What it sees doesn't change, so that the policy drives without the
simulator.
"""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecEnvWrapper, VecMonitor
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from acsar_gym.errors import ConfigError
from acsar_gym.physics import Randomization
from acsar_gym.tools.policies.sb3 import BatchVecEnv, make_batch
from acsar_gym.vector.env import RobotVectorEnv
from acsar_gym.worlds.search import measure_goal_distances

SINGLE_ENV_ARGUMENTS = (
    *("link", "lidar", "on_fault", "view", "record", "render_mode", "disable_env_checker"),
)
"""Arguments that only a single env has."""


def batch(env: VecEnv, *, randomize: bool = True, threads: int | None = None) -> VecEnv:
    """Replace the single envs that RL Zoo has made by one batch of as many robots.

    A single env stays as it is, so that RL Zoo evaluates and renders with the real one.

    Args:
        env: of one id, all with the same arguments.
        randomize: draw the physics of each episode, as `acsar-gym train` does.
        threads: cores to use; None is all.

    Returns:
        The batch, with the Monitor file of the envs if they had one.
    """
    if env.num_envs == 1:
        return env
    spec = env.get_attr("spec", 0)[0]
    config = env.get_attr("unwrapped", 0)[0].robot.config
    options = {
        name: value for name, value in spec.kwargs.items() if name not in SINGLE_ENV_ARGUMENTS
    }
    if randomize:
        options.setdefault("randomization", Randomization.measured(config))
    made: VecEnv = make_batch(spec.id, env.num_envs, threads=threads, **options)
    made._seeds = list(env._seeds)  # noqa: SLF001 - what make_vec_env has seeded
    logs: list[Path] = []
    if isinstance(env, DummyVecEnv):
        writers: list[Any] = [each.results_writer for each in env.envs if isinstance(each, Monitor)]
        logs = [Path(writer.file_handler.name) for writer in writers if writer is not None]
    env.close()
    for path in logs:
        path.unlink(missing_ok=True)  # they are empty
    if not logs:
        return made
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that a batch has the statistics of Monitor already
        return VecMonitor(made, str(logs[0]))


class Detours(VecEnvWrapper):
    """Adds to each step's reward how much of the detour to the goal the robot has put behind it.

        weight (detour before the step - detour after it)

    where the detour is the length of the way around the obstacles less that of the straight line,
    to the world's goal, both from where the robot really is. It is a potential, so no policy
    becomes the best one that wasn't before (Ng, Harada & Russell, "Policy invariance under reward
    transformations", ICML 1999), up to the discount, and that an episode's last step gets nothing.

    The wrapper has no state of its own. Episodes with a goal of their own (`options`) count as if
    they had the world's. The returns that Monitor reports are those of the task.

    Args:
        venv: a batch, see `sb3.make_batch`, itself in wrappers or not.
        weight: of a metre; a metre nearer to the goal is worth 2 in the tasks with a LiDAR.

    Raises:
        ConfigError: the batch has no worlds.
    """

    def __init__(self, venv: VecEnv, weight: float = 2.0) -> None:
        super().__init__(venv)
        robots = find_robots(venv)
        if robots is None or robots.pool is None:
            raise ConfigError("Detours: must wrap a batch of robots in worlds")
        self._weight = weight
        self._batch = batch = robots.batch
        kinds = dict(zip(batch.places, robots.fleet, strict=True))  # one for each size of footprint
        drivers = [config for place, config in kinds.items() for _ in place]
        self._ways = measure_goal_distances(batch.worlds, drivers)
        self._goals = np.array([(world.goal.x, world.goal.y) for world in batch.worlds])
        self._before = np.zeros(venv.num_envs)

    def reset(self) -> VecEnvObs:
        """Start a new episode of every robot; returns observations (robots, n)."""
        return self.venv.reset()

    def step_async(self, actions: NDArray[np.floating]) -> None:
        """Note the detours, and step all robots with these actions (robots, 2)."""
        self._before = self.detours()
        self.venv.step_async(actions)

    def step_wait(self) -> VecEnvStepReturn:
        """Return what the batch returns, with the other rewards."""
        observations, rewards, dones, infos = self.venv.step_wait()
        gained = np.where(dones, 0.0, self._weight * (self._before - self.detours()))
        return observations, (rewards + gained).astype(np.float32), dones, infos

    def detours(self) -> NDArray[np.float64]:
        """How much longer than a straight line the ways to the goals are now, (robots,) [m]."""
        own_x, own_y, start_x, start_y, cos, sin, world = self._batch.read(
            "x", "y", "start_x", "start_y", "start_cos", "start_sin", "world"
        )
        x, y = start_x + cos * own_x - sin * own_y, start_y + sin * own_x + cos * own_y
        worlds = world.astype(np.int64)
        goals = self._goals[worlds]
        straight = np.hypot(goals[:, 0] - x, goals[:, 1] - y)
        longer: NDArray[np.float64] = self._ways.lengths(worlds, x, y) - straight
        return longer


def detours(env: VecEnv, weight: float = 2.0) -> VecEnv:
    """Wrap a batch in `Detours`; single envs, which RL Zoo evaluates with, stay as they are.

    Args:
        env: a batch, or other envs.
        weight: see `Detours`.
    """
    return env if find_robots(env) is None else Detours(env, weight)


def find_robots(env: VecEnv) -> RobotVectorEnv | None:
    """The batch of robots behind wrappers; None where there is none."""
    inner = env.unwrapped
    return inner.robots if isinstance(inner, BatchVecEnv) else None
