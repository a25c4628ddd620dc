"""Commands for policies: train, evaluate, run, export, policy show."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from acsar_gym.config import RobotConfig
from acsar_gym.errors import LateTicksError, LinkError
from acsar_gym.tools.cli.options import (
    EnvArg,
    EpisodeOptions,
    File,
    HostOptions,
    OutFile,
    PolicyOptions,
    RobotArg,
    RobotOptions,
    ScaleOptions,
    VideoOptions,
    WorldOptions,
    check_writable,
    countdown,
    print_results,
    say,
)

if TYPE_CHECKING:
    from acsar_gym.tools.evaluation.runs import EvaluationRun


def show_policy(
    file: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="FILE|NAME")],
    json: File = None,
) -> int:
    """Print what a policy file says about itself: its task, robot, training and figures.

    Args:
        file: ONNX file, or the name of a packaged policy.
        json: also write all of it to this file.
    """
    from acsar_gym.tools.evaluation import report  # noqa: PLC0415
    from acsar_gym.tools.policies import describe, onnx  # noqa: PLC0415

    check_writable(json)
    path, bundle = onnx.read_bundle(file)
    table = report.fact_table(str(path), describe.bundle_rows(bundle))
    print_results(table, json=json, data=bundle.model_dump(mode="json"))
    return 0


def train_policy() -> int:
    """Train a policy and export it, with options of its own."""
    from acsar_gym.tools.training.seeds import main  # noqa: PLC0415

    return main(sys.argv[2:])


def evaluate_policy(
    policy: PolicyOptions,
    robot: RobotOptions,
    worlds: WorldOptions,
    host: HostOptions,
    scale: ScaleOptions,
    episodes: EpisodeOptions,
    video: VideoOptions,
    json: File = None,
) -> int:
    """Evaluate a policy over some episodes on any link, and print its metrics.

    Args:
        policy: the policy.
        robot: link, robot, LiDAR, and recording.
        worlds: worlds of the evaluation.
        host: process priority and cores.
        scale: parallel processes, and other machines.
        episodes: the episodes.
        video: videos of the worst episodes.
        json: also write the metrics and every episode to this file.
    """
    from acsar_gym.tools.evaluation import runs, shards  # noqa: PLC0415

    check_writable(json)
    video.prepare()
    host.prepare()
    seeds = runs.seed_range(episodes.seed, episodes.episodes)
    loaded = runs.load_policy(policy.policy, trust=policy.trust, env=policy.env)
    done = shards.evaluate_in_parallel(
        loaded,
        robot.link,
        robot.robot,
        seeds,
        how={"in_order": worlds.in_order, "late_share": episodes.late_share},
        workers=scale.workers,
        address=scale.address,
        worlds=worlds.worlds,
        difficulty=worlds.difficulty,
        lidar=robot.lidar,
        tracked=video.video is not None,
        record=robot.recorder("evaluate", link=robot.link, policy=loaded.about),
    )
    title = f"{policy.policy}, seeds {seeds[0]} to {seeds[-1]}, worlds: {done.worlds}"
    try:
        return _report_run(title, robot.link, done, json)
    finally:
        video.write(done.results)


def run_policy(
    goal: Annotated[tuple[float, float], tyro.conf.Positional, tyro.conf.arg(metavar="X Y")],
    policy: PolicyOptions,
    robot: RobotOptions,
    host: HostOptions,
    json: File = None,
    yes: bool = False,
    goal_distance: Annotated[
        tuple[float, float] | None, tyro.conf.arg(metavar="NEAREST FARTHEST")
    ] = None,
) -> int:
    """Drive to one goal with a policy (x y, in m, relative to the robot's start).

    Args:
        goal: x and y in the odometry frame [m]: x forward, y to the left.
        policy: the policy.
        robot: link, robot, LiDAR, and recording.
        host: process priority and cores.
        json: also write the metrics to this file.
        yes: drive a real robot without a countdown.
        goal_distance: how near and how far goals may be [m]; default: as in training.
    """
    from acsar_gym.links.factory import is_device  # noqa: PLC0415
    from acsar_gym.tools.evaluation import runs  # noqa: PLC0415

    check_writable(json)
    host.prepare()
    loaded = runs.load_policy(policy.policy, trust=policy.trust, env=policy.env)

    def ready() -> None:
        if is_device(robot.link):
            countdown(f"the robot on {robot.link} will drive", yes=yes)

    if misfit := RobotConfig.of(robot.robot).misfit:
        say(f"{robot.robot}: {misfit}")
    recorder = robot.recorder("run", link=robot.link, policy=loaded.about)
    options = {"lidar": robot.lidar, "record": recorder, "goal_distance": goal_distance}
    done = runs.drive_to_goal(loaded, robot.link, robot.robot, goal, ready, **options)
    title = f"{policy.policy} to ({goal[0]:g}, {goal[1]:g}), worlds: {done.worlds}"
    return _report_run(title, robot.link, done, json, to_goal=True)


def _report_run(
    title: str, link: str, done: EvaluationRun, json: Path | None, *, to_goal: bool = False
) -> int:
    """Print and write what there is of an evaluation, then raise what ended it early.

    Returns:
        The exit code: 1 where a drive `to_goal` didn't reach it.

    Raises:
        LinkError: a fault ended an episode.
        LateTicksError: episodes are invalid, which a script has to know.
    """
    from acsar_gym.tools.evaluation import report  # noqa: PLC0415

    tables = []
    if done.results:
        tables.append(report.summary_table(title, [(link, done.summary)], done.notes))
    if done.results and not to_goal:
        tables.append(report.interval_table(title, done.summary))
    print_results(*tables, json=json, data=done.as_dict())
    if done.ended is not None:
        raise done.ended
    if done.faults:
        raise LinkError(done.faults[0])
    if to_goal and not done.results[0].success:
        return 1
    if done.late:
        raise LateTicksError(done.late, len(done.results))
    return 0


def convert_policy(
    model: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="MODEL")],
    out: OutFile,
    trust: bool = False,
    env: EnvArg = "",
    robot: RobotArg = None,
    vecnormalize: Annotated[str | None, tyro.conf.arg(metavar="FILE|none")] = None,
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
    """
    from acsar_gym.tools.evaluation import runs  # noqa: PLC0415

    check_writable(out)
    runs.export_policy(model, out, env, robot, trust=trust, vecnormalize=vecnormalize)
    say(f"written: {out}")
    return 0
