"""PPO of RLlib whose env runners step a batch of robots each, on one machine or a Ray cluster.

    pip install "acsar_gym[train,fast]" "ray[rllib]"
    python agents/examples/rllib_batch.py --env acsar_gym:acsar_gym/PointGoal-v0 --steps 300000
    python agents/examples/rllib_batch.py --runners 16 --address auto   # on a cluster's head node

`gym_env_vectorize_mode="vector_entry_point"` is what makes RLlib take the batch; without it, each
env runner steps single envs one by one (`env_config={"link": "planar"}`). What RLlib does with
info, and to rescale actions, is switched off: it took longer than the robots. RLlib also takes the
id as it is, `environment("acsar_gym:acsar_gym/PointGoal-v0")`. A runner that dies is started again.

A runner samples 27,000 steps/s with one core, and the learner takes in 7,500 (6 epochs): it's the
learner that limits. 300,000 steps take 55 s of one core; rllib.onnx then reaches 100 of 100 goals.
"""

import argparse
import time
from typing import Any

import gymnasium
import ray
import torch
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.core.rl_module.rl_module import RLModule
from ray.tune import register_env

from acsar_gym import policies


class Silent(gymnasium.vector.VectorWrapper):
    """A batch without its info, which RLlib would copy and send for each step of each robot."""

    def reset(self, **options: Any) -> Any:
        """Start new episodes."""
        return self.env.reset(**options)[0], {}

    def step(self, actions: Any) -> Any:
        """One step of all robots."""
        return *self.env.step(actions)[:4], {}


def batch(asked: dict[str, Any]) -> gymnasium.vector.VectorEnv[Any, Any, Any]:
    """Make the robots of an env runner; RLlib puts their number into `asked`."""
    mode = "vector_entry_point"
    made = gymnasium.make_vec(asked["id"], asked["num_envs"], vectorization_mode=mode, threads=1)
    return Silent(made)


class Mean(torch.nn.Module):
    """The mean action of RLlib's Gaussian policy."""

    def __init__(self, module: RLModule) -> None:
        super().__init__()
        self.module = module

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        """Map observations (batch, n) to actions (batch, 2)."""
        told: torch.Tensor = self.module.forward_inference({"obs": observation})[
            "action_dist_inputs"
        ]
        return told[:, :2]


def configured(asked: argparse.Namespace) -> PPOConfig:
    """RLlib's configuration: who steps how many robots, and how PPO learns from them."""
    config = PPOConfig().debugging(seed=asked.seed)
    register_env("batch", batch)
    config.environment("batch", env_config={"id": asked.env}, normalize_actions=False)
    config.env_runners(
        num_env_runners=asked.runners,
        num_envs_per_env_runner=asked.robots,
        gym_env_vectorize_mode="vector_entry_point",
        rollout_fragment_length=asked.rollout,
    )
    steps = asked.rollout * asked.robots * max(asked.runners, 1)
    config.fault_tolerance(restart_failed_env_runners=True)
    return config.training(
        train_batch_size_per_learner=steps,
        minibatch_size=max(steps // 4, 1),
        num_epochs=6,
        gamma=0.98,
        lambda_=0.95,
        lr=1e-3,
    )


def main(arguments: list[str] | None = None) -> None:
    """Train and export."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--env", default="acsar_gym:acsar_gym/PointGoal-v0")
    parser.add_argument("--steps", type=int, default=300_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--robots", type=int, default=256, help="of each env runner")
    parser.add_argument("--rollout", type=int, default=64, help="steps of a robot between updates")
    parser.add_argument("--runners", type=int, default=1, help="0: in this process")
    parser.add_argument("--address", help="of a Ray cluster; by default a new one on this machine")
    parser.add_argument("--out", default="rllib.onnx")
    asked = parser.parse_args(arguments)

    ray.init(address=asked.address or "local", log_to_driver=False)
    algorithm, steps, started = configured(asked).build_algo(), 0, time.perf_counter()
    while steps < asked.steps:
        told = algorithm.train()
        runners, timers = told["env_runners"], told["timers"]
        steps = int(runners["num_env_steps_sampled_lifetime"])
        sampling, learning = timers["env_runner_sampling_timer"], timers["learner_update_timer"]
        print(
            f"{steps:,} steps, mean return {runners.get('episode_return_mean', float('nan')):.2f}, "
            f"sampling {sampling:.2f} s, learning {learning:.2f} s"
        )
    print(f"{steps / (time.perf_counter() - started):,.0f} steps/s")
    policies.save(Mean(algorithm.get_module()), asked.env, asked.out)
    algorithm.stop()


if __name__ == "__main__":
    main()
