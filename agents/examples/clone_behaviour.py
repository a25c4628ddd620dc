"""Behaviour cloning: a person's drives become a policy that drives to any goal by itself.

    pip install ".[train,deploy,export,fast]"
    acsar-gym drive --link /dev/ttyUSB0 --record 1.mcap      # drive to a place, q; and again
    python agents/examples/clone_behaviour.py 1.mcap 2.mcap

A drive's goal is the place where it ended. Without recordings a control law drives, in simulation.
"""

from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import tyro
from pyarrow import parquet
from torch import nn

from acsar_gym import Robot, open_link
from acsar_gym.recording import Recorder
from acsar_gym.tools import datasets, policies
from acsar_gym.tools.evaluation import runs

Files = Annotated[tuple[Path, ...], tyro.conf.Positional]


def demonstrate(path: Path, place: complex) -> Path:
    """Record a drive to a place x + iy [m], as `acsar-gym drive --record` does; returns `path`."""
    with Robot(open_link("planar"), recorder=Recorder(path)) as robot:
        while abs(way := place - complex(*robot.odometry.pose[:2])) > 0.05:
            off = float(np.angle(way * np.exp(-1j * robot.odometry.pose[2])))
            robot.drive(0.5 * max(np.cos(off), 0.0), np.clip(2.0 * off, -1.0, 1.0))
    return path


def main(files: Files = (), out: Path = Path("clone"), drives: int = 20) -> None:
    """Export to LeRobot's format, train, save out/policy.onnx, and evaluate it."""
    places = np.random.default_rng(0).uniform(0.7, 2.8, drives) * np.exp(2.4j * np.arange(drives))
    out.mkdir(parents=True, exist_ok=True)
    files = files or tuple(demonstrate(out / f"{n}.mcap", one) for n, one in enumerate(places))
    folder, data = datasets.write_dataset(files, "lerobot", out / "data")
    print(f"{folder}: {len(data.episodes)} drives, {data.steps} steps")
    frames = parquet.read_table(folder / "data")
    seen, done = (torch.tensor(frames[key].to_pylist()) for key in ("observation.state", "action"))
    torch.manual_seed(0)
    torch.set_num_threads(1)  # more are slower with networks as small as this
    network = nn.Sequential(nn.Linear(len(data.names), 64), nn.Tanh(), nn.Linear(64, 2))
    adam = torch.optim.Adam(network.parameters(), 3e-3)
    for _ in range(3000):
        adam.zero_grad()
        (network(seen) - done).square().mean().backward()
        adam.step()
    policies.save(network, data.env_id, policy := out / "policy.onnx")
    summary = runs.evaluate_policy(policies.OnnxPolicy(policy), "planar", None, range(100)).summary
    print(f"success {summary.success_rate:.0%}, SPL {summary.spl:.2f}")


if __name__ == "__main__":
    tyro.cli(main)
