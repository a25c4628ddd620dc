"""The demo: train in simulation, then run the same policy file over a serial device."""

from __future__ import annotations

import gc
from dataclasses import replace
from pathlib import Path

from acsar_gym.config import RobotConfig
from acsar_gym.errors import check_extra
from acsar_gym.tools.emulation.board import PATIENCE, run_emulator
from acsar_gym.tools.evaluation import report, runs
from acsar_gym.tools.evaluation.episode import odometry_errors
from acsar_gym.tools.evaluation.runs import EvaluationRun
from acsar_gym.tools.policies import OnnxPolicy
from acsar_gym.tools.training.options import TrainingOptions
from acsar_gym.tools.training.run import require_training, train
from acsar_gym.tools.warm_up import warm_env


def run_demo(
    steps: int, episodes: int, serial_episodes: int, out: Path
) -> list[tuple[str, EvaluationRun]]:
    """Train a policy, then evaluate it in PyBullet and over a pseudo-terminal."""
    for module, extra in (("pybullet", "bullet"), ("onnxruntime", "deploy")):
        check_extra("the demo", extra, module)
    require_training()
    console = report.SafeConsole()

    console.rule("1. train PPO on simulated robots", align="left")
    with console.status("compiling, once after each installation: a minute"):
        warm_env("point_goal")
    policy_file = train_demo_policy(steps, out)
    policy = OnnxPolicy(policy_file)
    gc.freeze()  # keeps garbage collection short while the robot drives

    console.rule(f"2. drive {policy_file.name} in PyBullet", align="left")
    simulated = _drive(policy, "bullet", range(10_000, 10_000 + episodes), None)

    console.rule(f"3. drive {policy_file.name} over a serial device", align="left")
    log = out / "emulator.jsonl"
    # The emulator is another process, so nothing but bytes connects policy and physics.
    with run_emulator("--body", "bullet", "--log", str(log)) as devices:
        robot = RobotConfig.of(None).with_(**PATIENCE)
        serial = _drive(policy, devices.robot, range(20_000, 20_000 + serial_episodes), robot)
    # Only the emulator knows the true poses, which its log contains.
    errors = odometry_errors(serial.results, log)
    pairs = zip(serial.results, errors, strict=True)
    results = [replace(episode, odometry_error=error) for episode, error in pairs]
    return [
        ("PyBullet", simulated),
        ("serial device (emulator)", replace(serial, results=results)),
    ]


def train_demo_policy(steps: int, out: Path) -> Path:
    """Train in this process."""
    return train(TrainingOptions(steps=steps, out=out)).out / "policy.onnx"


def _drive(policy: OnnxPolicy, link: str, seeds: range, robot: RobotConfig | None) -> EvaluationRun:
    """Evaluate a policy, however busy the computer is. Raises what ended the evaluation early."""
    run = runs.evaluate_policy(policy, link, robot, seeds, late_share=1.0)
    if run.ended is not None:
        raise run.ended
    return run
