"""A training loop of one's own: PPO in plain PyTorch on a batch of 256 robots.

    python agents/examples/own_loop.py --steps 300000
    acsar-gym evaluate --policy own.onnx --link planar --episodes 100

300,000 steps take 14 s of one core (22,000 steps/s); own.onnx then reaches 100 of 100 goals.
"""

import gymnasium
import torch
import tyro
from torch import nn
from torch.distributions import Normal

from acsar_gym.tools import policies


def network(numbers: int, size: int) -> nn.Sequential:
    """Make a network with two hidden layers."""
    hidden = nn.Linear(numbers, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh()
    return nn.Sequential(*hidden, nn.Linear(64, size))


def main(env: str = "acsar_gym:acsar_gym/PointGoal-v0", steps: int = 300_000) -> None:
    """Train in rollouts of 64 steps, with 6 epochs of 4 batches each, and export the actor."""
    torch.manual_seed(0)
    batch = gymnasium.make_vec(env, 256, vectorization_mode="vector_entry_point")
    seen, idle = torch.tensor(batch.reset(seed=0)[0]), torch.zeros(256, dtype=torch.bool)
    actor, critic, spread = network(seen.shape[1], 2), network(seen.shape[1], 1), torch.zeros(2)
    weights = [*actor.parameters(), *critic.parameters(), spread.requires_grad_()]
    adam = torch.optim.Adam(weights, 1e-3)
    for done in range(0, steps, 64 * 256):
        rows = []
        for _ in range(64):
            policy = Normal(actor(seen).detach(), spread.exp().detach())
            action = policy.sample()
            after, *told = map(torch.tensor, batch.step(action.numpy())[:4])  # reward, end, cut
            rows.append((seen, action, policy.log_prob(action).sum(-1), idle, *told))
            seen, idle = after, told[1] | told[2]  # these robots' next step only resets them
        inputs, actions, before, none, reward, end, cut = map(torch.stack, zip(*rows, strict=True))
        values = critic(torch.cat([inputs, seen[None]])).squeeze(-1).detach()
        gains = reward + 0.98 * values[1:] * ~end - values[:-1]
        for step in reversed(range(63)):  # generalized advantage estimation
            gains[step] += 0.98 * 0.95 * ~(end | cut)[step] * gains[step + 1]
        data = [each[~none] for each in (inputs, actions, before, gains, gains + values[:-1])]
        for part in torch.cat([torch.randperm(len(data[0])) for _ in range(6)]).chunk(24):
            x, action, old, gain, value = (each[part] for each in data)
            gain = (gain - gain.mean()) / gain.std()
            ratio = (Normal(actor(x), spread.exp()).log_prob(action).sum(-1) - old).exp()
            loss = -torch.min(ratio * gain, ratio.clamp(0.8, 1.2) * gain).mean()
            adam.zero_grad()
            (loss + (critic(x).squeeze(-1) - value).square().mean() / 2).backward()
            adam.step()
        print(f"{done + 64 * 256:,} steps, mean reward of a step {reward[~none].mean():.3f}")
    policies.save(actor, env, "own.onnx")


if __name__ == "__main__":
    tyro.cli(main)
