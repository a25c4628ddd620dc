"""The main job end to end: train in simulation, then drive the same file over a serial device."""

from __future__ import annotations

import contextlib
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from acsar_gym import evaluation, report, runs
from acsar_gym.errors import AcsarError, LinkError
from acsar_gym.evaluation import EpisodeResult
from acsar_gym.policies import OnnxPolicy
from acsar_gym.resources import AGENTS
from acsar_gym.runs import Run

START_TIMEOUT = 30.0
"""How long the emulator may take to say its device [s]."""


def run(steps: int, episodes: int, serial_episodes: int, out: Path) -> list[tuple[str, Run]]:
    """Train, evaluate in PyBullet, evaluate over a pseudo-terminal; one row each."""
    console = report.SafeConsole()
    console.rule("1. train PPO on simulated robots", align="left")
    policy_file = train(steps, out)
    policy = OnnxPolicy(policy_file)
    console.rule(f"2. drive {policy_file.name} in PyBullet", align="left")
    simulated = runs.drive(policy, "bullet", None, episodes, seed=10_000)
    console.rule(f"3. drive {policy_file.name} over a serial device", align="left")
    serial = _over_serial(policy, serial_episodes)
    return [("PyBullet", simulated), ("serial device (emulator)", serial)]


def train(steps: int, out: Path) -> Path:
    """Run agents/train.py in a process of its own; returns the ONNX file."""
    command = [sys.executable, str(AGENTS / "train.py"), "--steps", str(steps), "--out", str(out)]
    if subprocess.run(command, check=False).returncode != 0:
        raise AcsarError(f"training failed: run '{' '.join(command)}' to see why")
    return out / "policy.onnx"


def _over_serial(policy: OnnxPolicy, count: int) -> Run:
    """The emulator runs in another process; its log tells how far odometry was off."""
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "emulator.jsonl"
        with emulator("--body", "bullet", "--log", str(log)) as device:
            run = runs.drive(policy, device, None, count, seed=20_000)
        return replace(run, results=with_truth(run.results, log))


def with_truth(results: Sequence[EpisodeResult], log: Path) -> list[EpisodeResult]:
    """The results with their odometry errors filled in from the emulator's log."""
    errors = evaluation.odometry_errors(results, log)
    return [replace(r, odometry_error=e) for r, e in zip(results, errors, strict=True)]


@contextlib.contextmanager
def emulator(*arguments: str) -> Iterator[str]:
    """`acsar-gym emulate` in another process; yields the device it serves, and ends it."""
    command = [sys.executable, "-m", "acsar_gym", "emulate", *arguments]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        line = process.stdout.readline() if process.stdout else ""
        device = line.strip().split(" ")[-1]
        if not device.startswith("/"):
            raise LinkError("the emulator didn't start", f"run '{' '.join(command)}' to see why")
        yield device
    finally:
        process.terminate()
        process.wait(START_TIMEOUT)
        if process.stdout:
            process.stdout.close()
