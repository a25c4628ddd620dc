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
    from acsar_gym.tools.policies import FilePolicy


@dataclass(frozen=True)
class PolicyOptions:
    """The policy."""

    policy: str = "point_goal"
    """ONNX file, packaged policy, or Python function such as mine.py:act."""
    trust: bool = False
    """Allow a stable-baselines3 zip, which can run code."""
    env: EnvArg = ""
    """Overrides the env that the policy names: barn, mine.module:mine/Task-v0."""
    anyway: bool = False
    """Drive a real robot of another size or speed than in the training."""

    def load(self) -> FilePolicy:
        """Load the policy."""
        from acsar_gym.tools.evaluation import runs  # noqa: PLC0415

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
    """LiDAR on hardware: rplidar:///dev/ttyUSB1, ld06:///dev/ttyUSB1, module:Class."""
    late_share: float = 0.01
    """Largest share of late ticks in a valid episode, on hardware."""
    ros_args: RosArgs = ()
    """Arguments of ROS, up to the end or to --: -r /tf:=/robot1/tf."""


@dataclass(frozen=True)
class EvaluationOptions(PageOptions, WorldFileOptions, RobotOptions, PolicyOptions):
    """Policy, robot, episodes, worlds and output."""

    episodes: int = 100
    """Number of episodes."""
    seed: int = 0
    """Seed of the first episode; the next seeds count up."""
    worlds: Worlds = ()
    """Instead of the test split: barn:1000-1099, ..., a file, or a folder."""
    difficulty: float | None = None
    """Difficulty of generated worlds, 0 to 1."""
    workers: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Processes that drive in parallel; default: one."""


@command("evaluate", "policies", drives=True)
def evaluate_policy(evaluation: EvaluationOptions) -> int:
    """Evaluate a policy over some episodes on any link, and print its metrics."""
    from acsar_gym.guard.estop import check_available  # noqa: PLC0415
    from acsar_gym.links.factory import is_device  # noqa: PLC0415
    from acsar_gym.tools.evaluation import report, runs  # noqa: PLC0415

    evaluation.check()
    if is_device(evaluation.link):
        check_available(evaluation.link)
    ROS_ARGUMENTS.set(evaluation.ros_args)
    seeds = runs.seed_range(evaluation.seed, evaluation.episodes)
    loaded = evaluation.load()
    done = runs.evaluate_policy(
        loaded,
        evaluation.link,
        evaluation.robot,
        seeds,
        late_share=evaluation.late_share,
        workers=evaluation.workers,
        worlds=evaluation.place(*evaluation.worlds),
        difficulty=evaluation.difficulty,
        lidar=evaluation.lidar,
        record=evaluation.recorder("evaluate", link=evaluation.link, policy=loaded.about),
    )
    title = f"{evaluation.policy}, seeds {seeds[0]} to {seeds[-1]}, worlds: {done.worlds}"
    if evaluation.html is not None and done.results:
        report.write_evaluation_page(evaluation.html, title, done.summary, done.results)
    return report_run(title, evaluation.link, done, evaluation.json)


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
    loaded = policy.load()

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
    done = runs.drive_to_goal(
        loaded,
        robot.link,
        robot.robot,
        goal,
        ready=ready,
        late_share=robot.late_share,
        **options,
    )
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

    tables = []
    if done.results:
        tables.append(report.summary_table(title, [(link, done.summary)], done.notes))
    print_results(*tables, json=json, data=done.as_dict())
    if done.ended is not None:
        raise done.ended
    if done.faults:
        raise LinkError(done.faults[0])
    if to_goal and not all(episode.success for episode in done.results):
        return 1
    hint = BUSY_HINT if to_goal else "stop other programs"
    if done.late and not link.startswith("replay:"):  # a recording stays as it is
        raise LateTicksError(
            f"too many late ticks in {done.late} of {len(done.results)} episodes: {hint}, or "
            "allow a larger --late-share"
        )
    return 0
