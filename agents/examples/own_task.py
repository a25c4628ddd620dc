"""A task of one's own, parking: trained in a batch of robots, then driven one by one on any link.

python agents/examples/own_task.py --steps 500000 --link bullet
"""

import math
from typing import Any

import gymnasium
import torch
import tyro
from stable_baselines3 import PPO

import acsar_gym
from acsar_gym import Outcome, State
from acsar_gym.jit import compilable
from acsar_gym.tools.evaluation.episodes import run_episodes
from acsar_gym.tools.policies import OnnxPolicy, save, sb3


@compilable
def distance_to_goal(state: State) -> float:
    """Distance to the goal by odometry [m]."""
    return math.hypot(state.goal[0] - state.pose[0], state.goal[1] - state.pose[1])


class Parking(acsar_gym.Task):
    """Stand still on a point of an open floor. To cross it isn't enough."""

    compiled = True  # for the batch

    observation = {"ahead": (-20, 20), "left": (-20, 20), "speed": (-2, 2), "turning": (-4, 4)}
    memory = {"distance": 0.0}

    def begin(self, state: State, memory: Any) -> None:
        memory.distance = distance_to_goal(state)

    def outcome(self, state: State, memory: Any) -> Outcome:
        is_near = distance_to_goal(state) < 0.15
        return Outcome.SUCCESS if is_near and abs(state.twist[0]) < 0.05 else Outcome.GOING

    def reward(self, state: State, memory: Any, outcome: Outcome) -> float:
        distance = distance_to_goal(state)
        gain = memory.distance - distance
        memory.distance = distance
        reward: float = 2 * gain - 0.02 + 2 * (outcome == Outcome.SUCCESS)
        return reward

    def observe(self, state: State, memory: Any) -> tuple[float, ...]:
        dx = state.goal[0] - state.pose[0]
        dy = state.goal[1] - state.pose[1]
        distance = distance_to_goal(state)
        bearing = math.atan2(dy, dx) - state.pose[2]
        return distance * math.cos(bearing), distance * math.sin(bearing), *state.twist


acsar_gym.register("mine/Parking-v0", task=Parking, max_episode_steps=200)


def main(steps: int = 500_000, link: str = "planar", count: int = 100) -> None:
    """Train 256 robots, write parking.onnx, and drive `count` episodes on `link`."""
    batch = sb3.make_batch("mine/Parking-v0", 256)
    actor = PPO("MlpPolicy", batch, 1e-3, n_steps=64, batch_size=4096, seed=0).learn(steps).policy
    network = torch.nn.Sequential(actor.mlp_extractor.policy_net, actor.action_net)
    save(network, "mine/Parking-v0", "parking.onnx")
    env, policy = gymnasium.make("mine/Parking-v0", link=link), OnnxPolicy("parking.onnx")
    results = list(run_episodes(env, policy, count, seed=0))
    env.close()
    print(f"{link}: parked in {sum(each.success for each in results)} of {count} episodes")


if __name__ == "__main__":
    tyro.cli(main)
