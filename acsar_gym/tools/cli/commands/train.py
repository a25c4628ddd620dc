"""The commands `train` and `export`: where policy files come from."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import tyro

from acsar_gym.tools.cli.commands import command
from acsar_gym.tools.cli.options import EnvArg, Force, OutFile, RobotArg, check_writable, say


@command("train", "policies")
def train_policy() -> int:
    """Train a policy and export it, with options of its own."""
    from acsar_gym.tools.training.seeds import main  # noqa: PLC0415

    return main(sys.argv[2:])


@command("export", "policies")
def convert_policy(
    model: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="MODEL")],
    out: OutFile,
    trust: bool = False,
    env: EnvArg = "",
    robot: RobotArg = None,
    vecnormalize: Annotated[str | None, tyro.conf.arg(metavar="FILE|none")] = None,
    force: Force = False,
) -> int:
    """Convert a stable-baselines3 zip to an ONNX policy, which runs no code when it's loaded.

    Args:
        model: zip of PPO, A2C, SAC, TD3, DDPG, TQC or RecurrentPPO.
        out: the ONNX file.
        trust: allow the zip to run code: only zips from people you trust.
        env: env that it was trained for, such as point_goal; models of 'acsar-gym train' know
            it.
        robot: preset or config file of the robot that it was trained on.
        vecnormalize: file of the VecNormalize that it was trained with; can run code, too.
        force: replace a file that exists.
    """
    from acsar_gym.tools.evaluation import runs  # noqa: PLC0415

    check_writable(out, force=force, mark="")
    runs.export_policy(model, out, env, robot, trust=trust, vecnormalize=vecnormalize)
    say(f"written: {out}")
    return 0
