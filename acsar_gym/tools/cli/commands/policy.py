"""The command `policy`."""

from __future__ import annotations

from typing import Annotated

import tyro

from acsar_gym.tools.cli.commands import command
from acsar_gym.tools.cli.options import (
    EnvArg,
    File,
    ResultOptions,
    RobotArg,
    check_writable,
    print_results,
    say,
)


@command("policy")
def show_policy(
    file: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="FILE|NAME")],
    output: ResultOptions,
    out: File = None,
    trust: bool = False,
    env: EnvArg = "",
    robot: RobotArg = None,
    vecnormalize: Annotated[str | None, tyro.conf.arg(metavar="FILE|none")] = None,
) -> int:
    """Show what a policy was trained for and how. With --out, convert it to ONNX.

    Args:
        file: ONNX file, name of a packaged policy, or zip of PPO, A2C, SAC, TD3, DDPG, TQC or
            RecurrentPPO.
        output: Results in a file.
        out: ONNX file to write, which runs no code when it's loaded.
        trust: Allow a zip to run code: only zips from people you trust.
        env: Env that a zip was trained for, such as point_goal. Models of 'acsar-gym train' know
            it.
        robot: Preset or config file of the robot that a zip was trained on.
        vecnormalize: File of the VecNormalize that a zip was trained with. Can run code as well.
            Default: the file beside the zip.
    """
    from acsar_gym.envs.ids import find_id
    from acsar_gym.tools.evaluation import report
    from acsar_gym.tools.policies import OnnxPolicy, ZipPolicy, resolve

    output.check()
    check_writable(out, mark="")
    policy: OnnxPolicy
    if resolve(file).suffix == ".zip":
        env_id = find_id(env) if env else ""
        policy = ZipPolicy(file, trust=trust, env_id=env_id, robot=robot, vecnormalize=vecnormalize)
    else:
        policy = OnnxPolicy(file)
    table = report.fact_table(str(policy.path), policy.document.rows())
    print_results(table, json=output.json, data=policy.document.model_dump(mode="json"))
    if out is not None:
        policy.save(out)
        say(f"written: {out}")
    return 0
