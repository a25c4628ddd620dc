"""Rewards for robots that know the way, added in training only.

A task rewards coming nearer to the goal in a straight line, which leads into every dead end. Here
the way around the obstacles counts instead, as the simulator knows it: a robot that turns back is
rewarded at once. What it sees doesn't change, so that the policy drives without the simulator.
Imports torch.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from acsar_gym.errors import ConfigError
from acsar_gym.policies.sb3 import BatchVecEnv
from acsar_gym.vector.env import RobotVectorEnv
from acsar_gym.vector.kernel import layout
from acsar_gym.worlds.ways import ways_of


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
        robots = robots_of(venv)
        if robots is None or robots.pool is None:
            raise ConfigError("Detours: must wrap a batch of robots in worlds")
        self._weight = weight
        self._batch = robots.batch
        self._ways = ways_of(list(robots.pool), robots.config)
        self._goals = np.array([(world.goal.x, world.goal.y) for world in robots.pool])
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
        state = self._batch.state
        cos, sin = state[layout.START_COS], state[layout.START_SIN]
        x = state[layout.START_X] + cos * state[layout.X] - sin * state[layout.Y]
        y = state[layout.START_Y] + sin * state[layout.X] + cos * state[layout.Y]
        worlds = state[layout.WORLD].astype(np.int64)
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
    return env if robots_of(env) is None else Detours(env, weight)


def robots_of(env: VecEnv) -> RobotVectorEnv | None:
    """The batch of robots behind wrappers; None where there is none."""
    inner = env.unwrapped
    return inner.robots if isinstance(inner, BatchVecEnv) else None
