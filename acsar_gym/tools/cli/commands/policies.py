"""The commands `demo`, `train`, `evaluate`, `run`, `policy` and `benchmark`."""

from __future__ import annotations

import signal
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from acsar_gym.config import RobotConfig
from acsar_gym.errors import BUSY_HINT, ConfigError, LateTicksError, LinkError, check_extra
from acsar_gym.reading import describe_origin
from acsar_gym.ros.node import ROS_ARGUMENTS
from acsar_gym.tools.cli.commands import command
from acsar_gym.tools.cli.options import (
    Count,
    EnvArg,
    File,
    GoalDistance,
    LidarArg,
    Names,
    RecordOptions,
    ResultOptions,
    RobotArg,
    RosArgs,
    Worlds,
    check_page,
    check_stoppable,
    check_writable,
    countdown,
    say,
)
from acsar_gym.tools.training.options import TrainingOptions

if TYPE_CHECKING:
    from acsar_gym.tools.evaluation.runs import EvaluationRun
    from acsar_gym.tools.policies import FilePolicy


@command("demo")
def show_demo(
    output: ResultOptions,
    steps: int = 150_000,
    episodes: int = 100,
    serial_episodes: int = 6,
    out: File = None,
) -> int:
    """Train a policy, run it in PyBullet, then over a serial device. Print one table.

    Args:
        output: Results in a file.
        steps: Env steps of the training.
        episodes: Episodes in PyBullet.
        serial_episodes: Episodes over the emulator's pseudo-terminal, in real time.
        out: New or empty folder for the policy and the logs. Default: runs/demo/1, 2, ...
    """
    from acsar_gym.tools.demo import run_demo
    from acsar_gym.tools.evaluation import report
    from acsar_gym.tools.evaluation.runs import seed_range
    from acsar_gym.tools.training.folders import make_folder

    # Report wrong numbers before anything is compiled.
    TrainingOptions(steps=steps)
    output.check()
    for count in (episodes, serial_episodes):
        seed_range(0, count)

    folder = make_folder(out, "demo")
    runs = run_demo(steps, episodes, serial_episodes, folder)
    rows = [(name, run.summary) for name, run in runs]
    title = f"One policy file, {folder / 'policy.onnx'}, worlds: {runs[0][1].worlds}"
    data = {name: run.as_dict() for name, run in runs}
    output.print(report.summary_table(title, rows), data=data)
    return 0 if all(summary.success_rate >= 0.95 for _, summary in rows) else 1


@command("train")
def train_policy(training: TrainingOptions) -> int:
    """Train a policy on one of the environments and export it as an ONNX file.

    Ctrl-C and SIGTERM end it early, and save the model.

    Args:
        training: The training.
    """
    if training.warm_up:
        from acsar_gym.tools.warm_up import warm_env

        warmed = warm_env(training.env, training.robot)
        print(
            f"{training.env}: {warmed.functions} functions compiled, {warmed.worlds} worlds at "
            f"hand, {warmed.seconds:.1f} s"
        )
        return 0
    from acsar_gym.tools.training.run import train
    from acsar_gym.tools.training.seeds import train_seeds

    try:
        if training.seeds is None:
            train(training)
        else:
            train_seeds(training)
    except KeyboardInterrupt as end:
        # Services distinguish a program that was ended from one that was interrupted.
        if end.args == (signal.SIGTERM.name,):
            return 128 + signal.SIGTERM
        raise
    return 0


@dataclass(frozen=True)
class PolicyOptions:
    """The policy."""

    policy: str = "point_goal"
    """ONNX file, packaged policy, or mine.py:act."""
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
class EvaluationOptions(ResultOptions, RobotOptions, PolicyOptions):
    """Policy, robot, episodes, worlds and output."""

    html: File = None
    """Also write an HTML page with tables and plots."""
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
    check_page(evaluation.html)
    check_stoppable(evaluation.link)
    ROS_ARGUMENTS.set(evaluation.ros_args)
    seeds = runs.seed_range(evaluation.seed, evaluation.episodes)
    policy = evaluation.load()
    recorder = evaluation.recorder(link=evaluation.link, policy=policy.about)
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
    # An evaluation that ended early has a page and figures of its finished episodes.
    title = f"{evaluation.policy}, seeds {seeds[0]} to {seeds[-1]}, worlds: {run.worlds}"
    if evaluation.html is not None and run.results:
        report.write_evaluation_page(
            evaluation.html, title, evaluation.link, run.summary, run.results
        )
    return report_run(title, evaluation.link, run, evaluation)


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

    # The countdown comes after all checks, right before the wheels turn.
    def ready() -> None:
        if is_device(robot.link):
            countdown(f"the robot on {robot.link} will drive", yes=yes)

    # A robot's file may be written of a fit that was refused: see 'identify --anyway'.
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
        record=robot.recorder(link=robot.link, policy=loaded.about),
        goal_distance=goal_distance,
    )
    title = f"{policy.policy} to ({goal[0]:g}, {goal[1]:g}), worlds: {run.worlds}"
    return report_run(title, robot.link, run, output, to_goal=True)


def report_run(
    title: str, link: str, run: EvaluationRun, output: ResultOptions, *, to_goal: bool = False
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
    output.print(*tables, data=run.as_dict())

    # What ended it is reported after the results, as the last line.
    if run.ended is not None:
        raise run.ended
    if run.faults:
        raise LinkError(run.faults[0])
    # A missed goal has precedence over late ticks: exit code 1, not 4.
    if to_goal and not all(episode.success for episode in run.results):
        return 1
    if run.late and not link.startswith("replay:"):  # a recording stays as it is
        raise LateTicksError(
            f"too many late ticks in {run.late} of {len(run.results)} episodes: {BUSY_HINT}, or "
            "allow a larger --late-share"
        )
    return 0


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
            Default: the file next to the zip.
    """
    from acsar_gym.envs.ids import find_id
    from acsar_gym.tools.evaluation import report
    from acsar_gym.tools.policies import OnnxPolicy, ZipPolicy, resolve

    output.check()
    check_writable(out, mark="")
    # Only a zip needs trust: the metadata of an ONNX file is text.
    policy: OnnxPolicy
    if resolve(file).suffix == ".zip":
        env_id = find_id(env) if env else ""
        policy = ZipPolicy(file, trust=trust, env_id=env_id, robot=robot, vecnormalize=vecnormalize)
    else:
        policy = OnnxPolicy(file)
    table = report.fact_table(str(policy.path), policy.document.rows())
    output.print(table, data=policy.document.model_dump(mode="json"))
    if out is not None:
        policy.save(out)
        say(f"written: {out}")
    return 0


Folder = Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")]


@dataclass(frozen=True)
class BenchmarkChoice:
    """What is compared."""

    sets: Names = ()
    """Sets of scenes: crowd, barn-fast, clutter, clutter/husky, ... Default: crowd and barn-fast,
    or all of --env."""
    env: Names = ()
    """Ids: barn, crowd, ..., mine.module:mine/Task-v0."""
    robots: Names = ()
    """Robots that drive instead of those of the sets: presets or config files."""
    agents: Names = ()
    """Agents: packaged, baselines such as dwa, names in --trained, and your own policies:
    mine.onnx, mine.py:act, mine.planner:Planner. Default: all but your own, and those that know
    the simulator's truth (orca_true)."""
    trained: Folder = None
    """Trained policies, NAME/SEED/policy.onnx."""
    seeds: int = 5
    """Most training seeds of each trained agent."""
    links: Names = ("planar", "bullet")
    """planar, bullet, mujoco, or ros2: a simulation of 'acsar-gym ros driver', in real time."""
    scenes: int = 200
    """Scenes of every set, at most 1,000."""
    conditions: Names = ("nominal",)
    """Conditions: nominal, randomization-1 to -3, dropped-2, ... A wrong name lists all."""
    barn: Folder = None
    """Folder of the published BARN worlds, in which barn and barn-fast are driven as well."""


@dataclass(frozen=True)
class BenchmarkOutputs(ResultOptions):
    """Where it runs, and what it writes."""

    out: Folder = None
    """New folder of the results, in which benchmark.json has every episode. Default:
    runs/benchmark/NUMBER."""
    resume: Folder = None
    """Continue an interrupted benchmark in its folder."""
    html: File = None
    """Also write an HTML page with tables and plots."""
    csv: File = None
    """Also write the table as CSV."""
    latex: File = None
    """Also write the table for LaTeX."""
    figure: File = None
    """Also draw scores, intervals and training seeds, as FILE.svg or FILE.pdf."""
    workers: Count = None
    """Processes at a time. Default: 1, on a cluster one per CPU."""
    address: str | None = None
    """Ray cluster: auto, local, host:port or ray://host:port."""

    def check(self) -> None:
        """Check before the work that the files can be written, and are of a known kind."""
        from acsar_gym.tools.benchmark import report

        # A benchmark takes hours: every file is checked before it starts.
        super().check()
        report.check_figure(self.figure, self.html)
        check_page(self.html)
        check_writable(self.latex)
        check_writable(self.csv, mark=report.CSV_MARK)
        if self.figure is not None:
            check_writable(self.figure, mark=report.FIGURE_MARKS[self.figure.suffix])
        if self.out is not None and self.resume is not None:
            raise ConfigError("--resume: continues in its own folder: leave out --out")


@command("benchmark")
def run_benchmark(what: BenchmarkChoice, how: BenchmarkOutputs) -> int:
    """Compare agents over fixed scenes: success, scores and intervals.

    Args:
        what: Ids, agents, links, scenes and conditions.
        how: Folder, processes and output.
    """
    from acsar_gym.tools.benchmark import plan, report, runner, scenes
    from acsar_gym.tools.evaluation.report import print_tables, write_json

    # What is compared.
    how.check()
    check_extra("a benchmark", "scipy", "scipy")  # before the first episode, not after the last
    sets = scenes.choose_sets(what.env, what.sets, what.robots)
    if what.barn is not None:
        sets += scenes.published_sets(sets, what.barn)
    chosen = plan.Plan(
        agents=tuple(plan.choose_agents(what.agents, sets, what.trained, what.seeds)),
        sets=tuple(sets),
        # A link that is named twice would be driven twice.
        links=tuple(dict.fromkeys(what.links)),
        conditions=tuple(dict.fromkeys(what.conditions)),
        count=what.scenes,
    )

    # The episodes, in their own folder.
    folder = runner.open_folder(chosen, how.out, how.resume)
    cells = runner.run_plan(chosen, folder, workers=how.workers, address=how.address)

    # The results.
    result = report.make_result(chosen.as_dict(), cells)
    file = folder / runner.RESULT_FILE
    for path in (file, how.json):
        write_json(path, {"origin": describe_origin(), **result}, indent=None)
    for path, write in (
        (how.html, report.write_benchmark_page),
        (how.csv, report.write_csv),
        (how.latex, report.write_latex),
        (how.figure, report.write_figure),
    ):
        if path is not None:
            write(path, result)
    print_tables(report.result_table(result))
    for refusal in report.list_refusals(result):
        say(refusal)
    files = (file, how.json, how.html, how.csv, how.latex, how.figure)
    say(f"written: {', '.join(str(path) for path in files if path is not None)}")
    return 0
