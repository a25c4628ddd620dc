"""PPO of skrl on a batch of robots.

    pip install ".[train,fast]" skrl
    python agents/examples/skrl_ppo.py --env acsar_gym:acsar_gym/PointGoal-v0 --steps 300000

skrl's automatic choice of a wrapper looks at the names of an env's base classes and doesn't know
ours; `wrapper="gymnasium"` is the right one. It takes the batch as it is. 300,000 steps take 9 s
of one core (34,200 steps/s); skrl.onnx then reaches 100 of 100 goals.
"""

import time

import gymnasium
import tyro
from skrl.envs.wrappers.torch import wrap_env
from skrl.utils.runner.torch import Runner

from acsar_gym.tools import policies

NET = {"name": "net", "input": "OBSERVATIONS", "layers": [64, 64], "activations": "tanh"}
MODELS = {
    "separate": True,
    "policy": {"class": "GaussianMixin", "network": [NET], "output": "ACTIONS"},
    "value": {"class": "DeterministicMixin", "network": [NET], "output": "ONE"},
}
AGENT = {"class": "PPO", "learning_epochs": 6, "mini_batches": 4, "discount_factor": 0.98}


def main(
    env: str = "acsar_gym:acsar_gym/PointGoal-v0",
    steps: int = 300_000,
    seed: int = 0,
    robots: int = 256,
    rollout: int = 64,
    out: str = "skrl.onnx",
) -> None:
    """Train and export; a robot makes `rollout` steps between updates."""
    mode, each = "vector_entry_point", steps // robots
    batch = gymnasium.make_vec(env, robots, vectorization_mode=mode, autoreset_mode="SameStep")
    config = {
        "seed": seed,
        "models": MODELS,
        "memory": {"class": "RandomMemory", "memory_size": -1},
        "agent": AGENT | {"rollouts": rollout, "time_limit_bootstrap": True},
        "trainer": {"class": "SequentialTrainer", "timesteps": each, "headless": True},
    }
    runner, started = Runner(wrap_env(batch, wrapper="gymnasium"), config), time.perf_counter()
    runner.run()
    print(f"{each * robots / (time.perf_counter() - started):,.0f} steps/s")
    actor = runner.agent.policy  # returns the mean action first
    mean = policies.actor(actor, lambda net, seen: net.compute({"observations": seen}, "policy")[0])
    policies.save(mean, env, out)


if __name__ == "__main__":
    tyro.cli(main)
