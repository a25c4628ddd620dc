"""Runs a plan: the jobs that aren't finished yet, in parallel, each result kept at once."""

from __future__ import annotations

import contextlib
import tempfile
import time
from collections.abc import Generator, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn
from rich.progress import TimeElapsedColumn as Elapsed
from rich.progress import TimeRemainingColumn as Remaining

from acsar_gym.config import RobotConfig
from acsar_gym.errors import CancelledError, PolicyError
from acsar_gym.tasks.episode import Assignment
from acsar_gym.tools.benchmark.figures import Scoring, record_episode
from acsar_gym.tools.benchmark.plan import CONDITIONS, PLANAR, PORT, BenchmarkJob, BenchmarkPlan
from acsar_gym.tools.benchmark.scenes import PUBLISHED, SceneSet
from acsar_gym.tools.benchmark.store import Cell, Part, Store
from acsar_gym.tools.emulation.board import EmulatedDevices, run_emulator
from acsar_gym.tools.evaluation import episodes, report, runs
from acsar_gym.tools.evaluation import episodes as evaluation
from acsar_gym.tools.evaluation.episodes import EpisodeResult
from acsar_gym.tools.jobs import completed
from acsar_gym.tools.policies import FilePolicy
from acsar_gym.worlds import Region, World, files
from acsar_gym.worlds.cache import keep_worlds
from acsar_gym.worlds.pool import Pool
from acsar_gym.worlds.search import footprint_radius, path_length, remaining_distance
from acsar_gym.worlds.world import point_in_world

if TYPE_CHECKING:
    from acsar_gym.tools.benchmark.plan import BenchmarkJob

PORT_TOUCH_DISTANCE = 0.003
"""A footprint nearer to an obstacle than this touched it [m]: bodies in PyBullet stop each other
before they overlap."""
POSE_STRIDE = 20
"""Every so many true poses of the log, which are 200 a second, count for lengths."""


def drive_over_port(job: BenchmarkJob, env: Any, policy: FilePolicy) -> Iterator[EpisodeResult]:
    """Drive the scenes of a job, each with an emulator of its own.

    Args:
        job: what to drive.
        env: a simulated env of the same kind, for whose robot and worlds the policy was checked.
        policy: drives.

    Raises:
        LinkError: the emulator didn't start, or its port can't be opened.
    """
    config = env.unwrapped.robot.config
    options = CONDITIONS[job.cell.condition].options(config, job.scenes.source)
    options["worlds"] = job.scenes.worlds
    for place in range(job.first, job.first + job.count):
        with tempfile.TemporaryDirectory() as folder:
            yield _driven(policy, config, options, job.scenes.reset(place), Path(folder))


def _driven(
    policy: FilePolicy,
    config: RobotConfig,
    options: Mapping[str, Any],
    scene: tuple[int, dict[str, Any]],
    folder: Path,
) -> EpisodeResult:
    """Drive one scene; `scene` is the seed and the options of its reset."""
    seed, reset = scene
    world, log = _world(config, options, reset.get("world")), folder / "log.jsonl"
    with _emulated(config, world, log) as devices:
        sees = {"lidar": f"rplidar://{devices.lidar}"} if devices.lidar else {}
        env = runs.make_env(policy, devices.robot, config, {**options, **sees})
        inner: Any = env.unwrapped
        try:
            (result,) = evaluation.run_episodes(env, policy, 1, seed, **reset)
            assignment = inner.episode.assignment
        finally:
            env.close()
    return add_emulator_truth(result, assignment, config, log)


def _world(config: RobotConfig, options: Mapping[str, Any], number: int | None) -> World | None:
    """Return the obstacles around the robot; None where there are none."""
    source = options["worlds"]
    if source is None or number is None:
        return None
    world = Pool.of(source, options.get("difficulty"), footprint_radius(config))[number]
    return world if world.obstacles else None


@contextlib.contextmanager
def _emulated(config: RobotConfig, world: World | None, log: Path) -> Iterator[EmulatedDevices]:
    """Run an emulator; with a LiDAR where there are obstacles."""
    robot = log.with_name("robot.yaml")
    config.save(robot)
    around: list[str] = []
    if world is not None:
        files.save_world(world, log.with_name("world.json"))
        around = ["--world", str(log.with_name("world.json")), "--lidar"]
    given = ("--body", "bullet", "--robot", str(robot), "--log", str(log), *around)
    with run_emulator(*given) as devices:
        yield devices


def add_emulator_truth(
    result: EpisodeResult, assignment: Assignment, config: RobotConfig, log: Path
) -> EpisodeResult:
    """Complete a result with what the emulator's log knows.

    Args:
        result: of an episode over the port.
        assignment: its world, start and goal.
        config: of the robot.
        log: of the emulator.

    Raises:
        ConfigError: the log holds no true poses.
    """
    stamps, poses = evaluation.read_true_poses(log)
    first, last = np.searchsorted(stamps, (result.started, result.ended), side="right")
    track = np.array(poses[max(0, first - 1) : last])
    length = path_length(np.concatenate([track[:-1:POSE_STRIDE], track[-1:]])[:, :2])
    (error,) = evaluation.odometry_errors([result], log)
    result = replace(result, driven=length, odometry_error=error)
    world = assignment.world
    if world is None or not world.obstacles:
        return result
    clearance = episodes.footprint_clearance(track, config.outline, world)
    touched = clearance < PORT_TOUCH_DISTANCE
    goal = Region(*point_in_world(assignment.start, assignment.goal))
    shortest, left = (
        remaining_distance(world, footprint_radius(config), Region(*end[:2]), goal)
        for end in (track[0], track[-1])
    )
    return replace(
        result,
        success=result.success and not touched,
        collision=touched,
        clearance=max(0.0, clearance),
        shortest=shortest,
        left=left,
        scores=tuple(0.0 * each for each in result.scores) if touched else result.scores,
    )


def run_job(job: BenchmarkJob) -> Part:
    """Drive the scenes of a job.

    Args:
        job: what to drive.

    Returns:
        The episodes; or why the agent can't drive there at all, such as another observation.

    Raises:
        AcsarError: this time it can't be driven: a file, a package or a port is missing, ...
    """
    begin = time.process_time()
    if why := _impossible(job):
        return Part(job.cell, job.first, refused=why)
    policy = job.policy.load()
    try:
        env = _made(policy, _simulation(job), job.cell.condition, job.scenes)
    except PolicyError as error:
        own = Path(job.policy.name).name
        return Part(job.cell, job.first, refused=str(error).replace(str(policy.path), own))
    scoring = Scoring(
        job.cell.id, env.unwrapped.robot.config.max_linear, env.unwrapped.task.goal_tolerance
    )
    drive = drive_over_port if job.cell.link == PORT else _simulated
    with keep_worlds():
        results = list(drive(job, env, policy))
    places = range(job.first, job.first + job.count)
    told = [
        record_episode(result, job.scenes.numbers[place], scoring)
        for result, place in zip(results, places, strict=True)
    ]
    return Part(job.cell, job.first, told, round(time.process_time() - begin, 3))


def _impossible(job: BenchmarkJob) -> str:
    """Why the job's condition can't be had there, whoever drives; empty if it can."""
    return CONDITIONS[job.cell.condition].impossible(
        simulated=job.cell.link != PORT, published=job.scenes.name == PUBLISHED
    )


def _simulation(job: BenchmarkJob) -> str:
    """The simulation that a job needs; for the port one that checks whether the policy fits."""
    return PLANAR if job.cell.link == PORT else job.cell.link


def _simulated(job: BenchmarkJob, env: Any, policy: FilePolicy) -> Iterator[EpisodeResult]:
    """Drive in a simulation of this process."""
    for place in range(job.first, job.first + job.count):
        seed, options = job.scenes.reset(place)
        yield from evaluation.run_episodes(env, policy, 1, seed, **options)


@lru_cache(maxsize=1)
def _made(policy: FilePolicy, link: str, condition: str, scenes: SceneSet) -> Any:
    """Make an env for a policy; kept for the next job of the same cell."""
    config = CONDITIONS[condition].config
    options = CONDITIONS[condition].options(config, scenes.source)
    return runs.make_env(policy, link, config, {"worlds": scenes.worlds, **options})


PartKey = tuple[Cell, int]


def run_plan(
    plan: BenchmarkPlan, store: Store, *, workers: int | None = None, address: str | None = None
) -> list[Part]:
    """Run what isn't finished, and keep every part as soon as it is.

    Args:
        plan: what to measure.
        store: where results are kept; goes on where an earlier run with this plan ended.
        workers: most jobs at a time.
        address: of a Ray cluster.

    Returns:
        All parts, those of earlier runs too.

    Raises:
        CancelledError: after Ctrl-C; the message says how much is finished.
        ConfigError: the scenes or the folder can't be used, or the disk is full.
        LinkError, JobError, ClusterError: a job can't be run.
    """
    plan.check()
    done = {(part.cell, part.first): part for part in store.open(plan.as_dict())}
    every = list(plan.jobs())
    waiting = [job for job in every if (job.cell, job.first) not in done]
    running = completed(run_job, waiting, workers=workers, address=address)
    try:
        with _progress(every, waiting) as advance, contextlib.closing(_generator(running)) as parts:
            for number, part in parts:
                done[part.cell, part.first] = store.add(part)
                advance(waiting[number])
    except KeyboardInterrupt:
        raise CancelledError(
            f"interrupted: {len(done)} of {len(every)} parts are kept in {store.folder}; the same "
            "command goes on with the others"
        ) from None
    return _in_order(every, done)


def _generator(running: Iterator[tuple[int, Part]]) -> Generator[tuple[int, Part], None, None]:
    """Wrap an iterator, so that closing it ends the running jobs."""
    yield from running


def _in_order(every: Sequence[BenchmarkJob], done: dict[PartKey, Part]) -> list[Part]:
    """The finished parts in the order of the plan, however they were finished."""
    return [done[job.cell, job.first] for job in every if (job.cell, job.first) in done]


class _Advance:
    """Moves a progress bar on by the episodes of a job."""

    def __init__(self, progress: Progress, total: int, done: int) -> None:
        self._progress = progress
        self._task = progress.add_task("", total=total, completed=done)

    def __call__(self, job: BenchmarkJob) -> None:
        """Note that a job is done."""
        cell = job.cell
        seed = "" if cell.training_seed is None else f" {cell.training_seed}"
        told = f"{cell.id} {cell.link} {cell.condition} {cell.agent}{seed}"
        self._progress.update(self._task, advance=job.count, description=report.escape_text(told))


@contextlib.contextmanager
def _progress(every: Sequence[BenchmarkJob], waiting: Sequence[BenchmarkJob]) -> Iterator[_Advance]:
    """Show a progress bar on stderr, in episodes."""
    total = sum(job.count for job in every)
    columns = (
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("episodes"),
        Elapsed(),
        Remaining(),
        TextColumn("{task.description}"),
    )
    with Progress(*columns, console=report.SafeConsole(stderr=True)) as progress:
        yield _Advance(progress, total, total - sum(job.count for job in waiting))
