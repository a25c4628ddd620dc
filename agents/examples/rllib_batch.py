"""PPO of RLlib whose env runners step a batch of robots each, on one machine or a Ray cluster.

    pip install "acsar_gym[train,fast]" "ray[rllib]"
    python agents/examples/rllib_batch.py --env acsar_gym:acsar_gym/PointGoal-v0 --steps 300000
    python agents/examples/rllib_batch.py --runners 16 --address auto   # on a cluster's head node

`gym_env_vectorize_mode="vector_entry_point"` is what makes RLlib take the batch; without it, a
runner steps single envs one by one. What RLlib does with info, and to rescale actions, is switched
off: it took longer than the robots. A runner samples 27,000 steps/s with one core, and the learner
takes in 7,500 (6 epochs). 300,000 steps take 55 s of one core; rllib.onnx then reaches 100 of 100
goals. A runner that dies is started again.
"""

import time

import ray
import tyro
from ray.rllib.algorithms.ppo import PPOConfig
from ray.tune import register_env

from acsar_gym.tools import policies
from acsar_gym.tools.policies import rllib


def main(
    env: str = "acsar_gym:acsar_gym/PointGoal-v0",
    steps: int = 300_000,
    seed: int = 0,
    robots: int = 256,
    rollout: int = 64,
    runners: int = 1,
    address: str = "local",
    out: str = "rllib.onnx",
) -> None:
    """Train and export; each of the `runners` has `robots`, and 0 runners are this process."""
    ray.init(address=address, log_to_driver=False)
    register_env("batch", rllib.make_batch)
    config, size = PPOConfig().debugging(seed=seed), robots * rollout * max(runners, 1)
    config.environment("batch", env_config={"id": env}, normalize_actions=False)
    config.env_runners(num_env_runners=runners, num_envs_per_env_runner=robots)
    config.env_runners(gym_env_vectorize_mode="vector_entry_point")
    config.env_runners(rollout_fragment_length=rollout)
    config.fault_tolerance(restart_failed_env_runners=True)
    config.training(train_batch_size_per_learner=size, minibatch_size=max(size // 4, 1))
    config.training(num_epochs=6, gamma=0.98, lambda_=0.95, lr=1e-3)
    algorithm, done, started = config.build_algo(), 0, time.perf_counter()
    while done < steps:
        told = algorithm.train()["env_runners"]
        done = int(told["num_env_steps_sampled_lifetime"])
        print(f"{done:,} steps, mean return {told.get('episode_return_mean', float('nan')):.2f}")
    print(f"{done / (time.perf_counter() - started):,.0f} steps/s")
    policies.save(rllib.actor(algorithm.get_module()), env, out)
    algorithm.stop()


if __name__ == "__main__":
    tyro.cli(main)
