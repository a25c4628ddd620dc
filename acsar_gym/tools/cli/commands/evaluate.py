"""The commands `evaluate` and `run`: a policy over episodes, or to one goal."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from acsar_gym.config import RobotConfig
from acsar_gym.errors import BUSY_HINT, LateTicksError, LinkError
from acsar_gym.ros.node import ROS_ARGUMENTS
from acsar_gym.tools.cli.commands import command
from acsar_gym.tools.cli.options import (
    EnvArg,
    HostOptions,
    LidarArg,
    PageOptions,
    RecordOptions,
    ResultOptions,
    RobotArg,
    RosArgs,
    WorldFileOptions,
    Worlds,
    countdown,
    print_results,
    say,
)

if TYPE_CHECKING:
    from acsar_gym.tools.evaluation.runs import EvaluationRun


@dataclass(frozen=True)
class PolicyOptions:
    """The policy."""

    policy: str = "point_goal"
    """ONNX file, name of a packaged policy, or a Python function such as mine.py:act."""
    trust: bool = False
    """Allow a stable-baselines3 zip, which can run code: only zips from people you trust."""
    env: EnvArg = ""
    """Overrides the env that the policy names: point_goal, ..., or mine.module:mine/Task-v0."""


@dataclass(frozen=True)
class RobotOptions(RecordOptions):
    """The robot and its devices, recording, and which drives count."""

    link: str = "bullet"
    """bullet, planar, mujoco, a serial device, or ros2 (ros2:/NAMESPACE)."""
    robot: RobotArg = None
    """Preset or config file."""
    lidar: LidarArg = None
    """On hardware, if the policy needs a LiDAR: its model and device, such as
    rplidar:///dev/ttyUSB1 or ld06:///dev/ttyUSB1, or module:Class of your own."""
    late_share: float = 0.01
    """On hardware: largest share of late ticks in a valid episode."""
    ros_args: RosArgs = ()
    """With ros2: arguments of ROS, up to the end or to --, such as -r /tf:=/robot1/tf."""


@dataclass(frozen=True)
class WorldOptions(WorldFileOptions):
    """The worlds of an evaluation."""

    worlds: Worlds = ()
    """Overrides the test split: rooms:test, barn:1000-1099, ..., a file, or a folder. Give it again
    for worlds of several."""
    in_order: bool = False
    """Use every world once, in order, instead of random ones."""
    difficulty: float | None = None
    """Difficulty of generated worlds, 0 to 1."""


@dataclass(frozen=True)
class EpisodeOptions:
    """The episodes of an evaluation."""

    episodes: int = 100
    """Number of episodes."""
    seed: int = 0
    """Seed of the first episode; the next ones count up."""


@dataclass(frozen=True)
class ScaleOptions:
    """Parallel processes, and other machines."""

    workers: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Processes to use; default: one, or with --address one for each CPU of the cluster."""
    address: Annotated[str | None, tyro.conf.arg(metavar="HOST:PORT|auto|local")] = None
    """Ray cluster to run on: host:port, ray://host:port, auto, or local to start one here."""


@command("evaluate", "policies", drives=True)
def evaluate_policy(
    policy: PolicyOptions,
    robot: RobotOptions,
    worlds: WorldOptions,
    host: HostOptions,
    scale: ScaleOptions,
    episodes: EpisodeOptions,
    output: PageOptions,
) -> int:
    """Evaluate a policy over some episodes on any link, and print its metrics.

    Args:
        policy: the policy.
        robot: link, robot, LiDAR, and recording.
        worlds: worlds of the evaluation.
        host: process priority and cores; whether the emergency stop may be missing.
        scale: parallel processes, and other machines.
        episodes: the episodes.
        output: results in files.
    """
    from acsar_gym.tools.evaluation import report, runs  # noqa: PLC0415

    output.check()
    host.prepare(robot.link)
    ROS_ARGUMENTS.set(robot.ros_args)
    seeds = runs.seed_range(episodes.seed, episodes.episodes)
    loaded = runs.load_policy(policy.policy, trust=policy.trust, env=policy.env)
    done = runs.evaluate_policy(
        loaded,
        robot.link,
        robot.robot,
        seeds,
        how={"in_order": worlds.in_order, "late_share": robot.late_share},
        workers=scale.workers,
        address=scale.address,
        worlds=worlds.place(*worlds.worlds),
        difficulty=worlds.difficulty,
        lidar=robot.lidar,
        record=robot.recorder("evaluate", link=robot.link, policy=loaded.about),
    )
    title = f"{policy.policy}, seeds {seeds[0]} to {seeds[-1]}, worlds: {done.worlds}"
    if output.html is not None and done.results:
        report.write_evaluation_page(output.html, title, robot.link, done.summary, done.results)
    return report_run(title, robot.link, done, output.json)


@command("run", "policies", drives=True)
def run_policy(
    goal: Annotated[tuple[float, float], tyro.conf.Positional, tyro.conf.arg(metavar="X Y")],
    policy: PolicyOptions,
    robot: RobotOptions,
    host: HostOptions,
    output: ResultOptions,
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
        host: process priority and cores; whether the emergency stop may be missing.
        output: results in a file.
        yes: drive a real robot without a countdown.
        goal_distance: how near and how far goals may be [m]; default: as in training.
    """
    from acsar_gym.links.factory import is_device  # noqa: PLC0415
    from acsar_gym.tools.evaluation import runs  # noqa: PLC0415

    output.check()
    host.prepare(robot.link)
    ROS_ARGUMENTS.set(robot.ros_args)
    loaded = runs.load_policy(policy.policy, trust=policy.trust, env=policy.env)

    def ready() -> None:
        if is_device(robot.link):
            countdown(f"the robot on {robot.link} will drive", yes=yes)

    if misfit := RobotConfig.of(robot.robot).misfit:
        say(f"{robot.robot}: {misfit}")
    recorder = robot.recorder("run", link=robot.link, policy=loaded.about)
    options = {
        "lidar": robot.lidar,
        "record": recorder,
        "goal_distance": goal_distance,
    }
    how = {"late_share": robot.late_share}
    done = runs.drive_to_goal(loaded, robot.link, robot.robot, goal, ready, how=how, **options)
    title = f"{policy.policy} to ({goal[0]:g}, {goal[1]:g}), worlds: {done.worlds}"
    return report_run(title, robot.link, done, output.json, to_goal=True)


def report_run(
    title: str, link: str, done: EvaluationRun, json: Path | None, *, to_goal: bool = False
) -> int:
    """Print and write what there is of an evaluation, then raise what ended it early.

    Returns:
        The exit code: 1 where a drive `to_goal` didn't reach one.

    Raises:
        LinkError: a fault ended an episode.
        LateTicksError: episodes are invalid, which a script has to know.
    """
    from acsar_gym.tools.evaluation import report  # noqa: PLC0415

    tables, rows = [], [(link, done.summary)]
    if done.results:
        tables.append(report.summary_table(title, rows, done.notes))
        if not math.isnan(done.summary.closest_person):
            tables.append(report.people_table(rows))
    print_results(*tables, json=json, data=done.as_dict())
    if done.ended is not None:
        raise done.ended
    if done.faults:
        raise LinkError(done.faults[0])
    if to_goal and not all(episode.success for episode in done.results):
        return 1
    if done.late and not link.startswith("replay:"):  # nobody can mend what was recorded
        raise LateTicksError(
            f"too many late ticks in {done.late} of {len(done.results)} episodes: {BUSY_HINT}, or "
            "allow a larger --late-share"
        )
    return 0
