"""The main job end to end: train in simulation, then drive the same file over a serial device."""

from __future__ import annotations

import contextlib
import gc
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

from acsar_gym.errors import LinkError, MissingExtraError
from acsar_gym.evaluation import episodes as evaluation
from acsar_gym.evaluation import report, runs
from acsar_gym.evaluation.episodes import EpisodeResult
from acsar_gym.evaluation.runs import Run
from acsar_gym.policies import OnnxPolicy
from acsar_gym.resources import agent

END_TIMEOUT = 30.0
"""How long the emulator may take to end before it is killed [s]."""
ENDING_WITH_US = """
import os, threading

def follow():
    os.read(0, 1)  # returns when the other end of the pipe is closed, or its process has ended
    os._exit(0)

threading.Thread(target=follow, daemon=True).start()
from acsar_gym.cli import main
main()
"""
"""`acsar-gym`, ending with the process that started it, however that ends."""


def run(steps: int, episodes: int, serial_episodes: int, out: Path) -> list[tuple[str, Run]]:
    """Train, evaluate in PyBullet, evaluate over a pseudo-terminal; one row each.

    Raises MissingExtraError before the training begins, SystemExit where a signal has ended it.
    """
    for module, extra in (("pybullet", "bullet"), ("onnxruntime", "deploy")):
        if find_spec(module) is None:
            raise MissingExtraError("the demo", extra)
    console = report.SafeConsole()
    console.rule("1. train PPO on simulated robots", align="left")
    policy_file = train(steps, out)
    policy = OnnxPolicy(policy_file)
    gc.freeze()  # what training left behind isn't searched for garbage while the robot drives
    console.rule(f"2. drive {policy_file.name} in PyBullet", align="left")
    simulated = runs.drive(policy, "bullet", None, range(10_000, 10_000 + episodes))
    console.rule(f"3. drive {policy_file.name} over a serial device", align="left")
    serial = _over_serial(policy, serial_episodes, out / "emulator.jsonl")
    return [("PyBullet", simulated), ("serial device (emulator)", serial)]


def train(steps: int, out: Path) -> Path:
    """Run agents/train.py here; returns the ONNX file, raises SystemExit where a signal came."""
    script = agent("train")
    code = script.train(script.Options(steps=steps, out=out))
    if code != 0:
        raise SystemExit(code)
    return out / "policy.onnx"


def _over_serial(policy: OnnxPolicy, count: int, log: Path) -> Run:
    """The emulator runs in another process; its log tells how far odometry was off."""
    with emulator("--body", "bullet", "--log", str(log)) as device:
        run = runs.drive(policy, device, None, range(20_000, 20_000 + count))
    return replace(run, results=with_truth(run.results, log))


def with_truth(results: Sequence[EpisodeResult], log: Path) -> list[EpisodeResult]:
    """The results with their odometry errors filled in from the emulator's log."""
    errors = evaluation.odometry_errors(results, log)
    return [replace(r, odometry_error=e) for r, e in zip(results, errors, strict=True)]


@contextlib.contextmanager
def emulator(*arguments: str) -> Iterator[str]:
    """`acsar-gym emulate` in another process; yields the device it serves, and ends it.

    It also ends when this process does, even by SIGKILL. Ctrl-C is left to this process.
    """
    command = [sys.executable, "-c", ENDING_WITH_US, "emulate", *arguments]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True
    ) as process:
        try:
            line = process.stdout.readline() if process.stdout else ""
            device = line.strip().split(" ")[-1]
            if not device.startswith("/"):
                said = f"run 'acsar-gym emulate {' '.join(arguments)}' to see why"
                raise LinkError("the emulator didn't start", said)
            yield device
        finally:
            _end(process)


def _end(process: subprocess.Popen[str]) -> None:
    process.terminate()
    try:
        process.wait(END_TIMEOUT)
    except subprocess.TimeoutExpired:
        process.kill()
