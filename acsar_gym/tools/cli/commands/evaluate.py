"""The commands `evaluate` and `run`: a policy over episodes, or to one goal."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from acsar_gym.config import RobotConfig
from acsar_gym.errors import BUSY_HINT, LateTicksError, LinkError
from acsar_gym.ros.node import ROS_ARGUMENTS
from acsar_gym.tools.cli.commands import command
from acsar_gym.tools.cli.options import (
    Count,
    EnvArg,
    GoalDistance,
    LidarArg,
    PageOptions,
    RecordOptions,
    ResultOptions,
    RobotArg,
    RosArgs,
    Worlds,
    check_stoppable,
    countdown,
    print_results,
    say,
)

if TYPE_CHECKING:
    from acsar_gym.tools.evaluation.runs import EvaluationRun
    from acsar_gym.tools.policies import FilePolicy


@dataclass(frozen=True)
class PolicyOptions:
    """The policy."""

    policy: str = "point_goal"
    """ONNX file, packaged, or mine.py:act."""
    trust: bool = False
    """Allow a stable-baselines3 zip, which can run code: only zips from people you trust."""
    env: EnvArg = ""
    """Env, such as barn or mine:mine/Park-v0."""
    anyway: bool = False
    """Drive a robot that it wasn't trained for."""

    def load(self) -> FilePolicy:
        """Load the policy."""
        from acsar_gym.tools.evaluation import runs

        policy = runs.load_policy(self.policy, trust=self.trust, env=self.env)
        policy.anyway = self.anyway
        return policy


@dataclass(frozen=True)
class RobotOptions(RecordOptions):
    """The robot and its devices, recording, and which drives count."""

    link: str = "bullet"
    """bullet, planar, mujoco, a serial device, or ros2."""
    robot: RobotArg = None
    """Preset or config file."""
    lidar: LidarArg = None
    """LiDAR: ld06:///dev/ttyUSB1, module:Class."""
    late_share: float = 0.01
    """Largest share of late ticks on hardware."""
    ros_args: RosArgs = ()
    """Arguments of ROS, as -r /tf:=/robot1/tf."""


@dataclass(frozen=True)
class EvaluationOptions(PageOptions, RobotOptions, PolicyOptions):
    """Policy, robot, episodes, worlds and output."""

    episodes: int = 100
    """Number of episodes."""
    seed: int = 0
    """Seed of the first episode. The next seeds count up."""
    worlds: Worlds = ()
    """barn:1000-1099, a file, a folder, ..."""
    difficulty: float | None = None
    """Difficulty of generated worlds, 0 to 1."""
    workers: Count = None
    """Processes that drive in parallel. Default: one."""


@command("evaluate", drives=True)
def evaluate_policy(evaluation: EvaluationOptions) -> int:
    """Evaluate a policy over some episodes on any link, and print its metrics."""
    from acsar_gym.tools.evaluation import report, runs
    from acsar_gym.worlds.sets import name_sources

    evaluation.check()
    check_stoppable(evaluation.link)
    ROS_ARGUMENTS.set(evaluation.ros_args)
    seeds = runs.seed_range(evaluation.seed, evaluation.episodes)
    policy = evaluation.load()
    recorder = evaluation.recorder("evaluate", link=evaluation.link, policy=policy.about)
    run = runs.evaluate_policy(
        policy,
        evaluation.link,
        evaluation.robot,
        seeds,
        late_share=evaluation.late_share,
        workers=evaluation.workers,
        worlds=name_sources(evaluation.worlds),
        difficulty=evaluation.difficulty,
        lidar=evaluation.lidar,
        record=recorder,
    )
    title = f"{evaluation.policy}, seeds {seeds[0]} to {seeds[-1]}, worlds: {run.worlds}"
    if evaluation.html is not None and run.results:
        report.write_evaluation_page(evaluation.html, title, run.summary, run.results)
    return report_run(title, evaluation.link, run, evaluation.json)


@command("run", drives=True)
def run_policy(
    goal: Annotated[tuple[float, float], tyro.conf.Positional, tyro.conf.arg(metavar="X Y")],
    policy: PolicyOptions,
    robot: RobotOptions,
    output: ResultOptions,
    yes: bool = False,
    goal_distance: GoalDistance = None,
) -> int:
    """Drive to one goal with a policy (x y, in m, relative to the robot's start).

    Args:
        goal: X and y in the odometry frame [m]: x forward, y to the left.
        policy: The policy.
        robot: Link, robot, LiDAR, and recording.
        output: Results in a file.
        yes: Drive a real robot without a countdown.
        goal_distance: How near and how far goals may be [m]. Default: as in training.
    """
    from acsar_gym.links.factory import is_device
    from acsar_gym.tools.evaluation import runs

    output.check()
    check_stoppable(robot.link)
    ROS_ARGUMENTS.set(robot.ros_args)
    loaded = policy.load()

    def ready() -> None:
        if is_device(robot.link):
            countdown(f"the robot on {robot.link} will drive", yes=yes)

    if misfit := RobotConfig.of(robot.robot).misfit:
        say(f"{robot.robot}: {misfit}")
    run = runs.drive_to_goal(
        loaded,
        robot.link,
        robot.robot,
        goal,
        ready=ready,
        late_share=robot.late_share,
        lidar=robot.lidar,
        record=robot.recorder("run", link=robot.link, policy=loaded.about),
        goal_distance=goal_distance,
    )
    title = f"{policy.policy} to ({goal[0]:g}, {goal[1]:g}), worlds: {run.worlds}"
    return report_run(title, robot.link, run, output.json, to_goal=True)


def report_run(
    title: str, link: str, run: EvaluationRun, json: Path | None, *, to_goal: bool = False
) -> int:
    """Print and write the results of an evaluation, then raise what ended it early.

    Returns:
        The exit code: 1 if a drive `to_goal` didn't reach a goal.

    Raises:
        LinkError: A fault ended an episode.
        LateTicksError: Episodes are invalid.
    """
    from acsar_gym.tools.evaluation import report

    tables = []
    if run.results:
        tables.append(report.summary_table(title, [(link, run.summary)], run.notes))
    print_results(*tables, json=json, data=run.as_dict())
    if run.ended is not None:
        raise run.ended
    if run.faults:
        raise LinkError(run.faults[0])
    if to_goal and not all(episode.success for episode in run.results):
        return 1
    if run.late and not link.startswith("replay:"):  # a recording stays as it is
        raise LateTicksError(
            f"too many late ticks in {run.late} of {len(run.results)} episodes: {BUSY_HINT}, or "
            "allow a larger --late-share"
        )
    return 0
