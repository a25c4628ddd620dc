"""Runs a plan: the jobs that aren't finished yet, in parallel, each result kept at once.

A job drives its scenes in a simulation of its process; or over a serial device: the emulated board,
and its LiDAR, on pseudo-terminals. The emulator runs PyBullet in another process and in real time.
There the driver knows odometry alone; what only a simulator knows is taken from the emulator's log:
length driven, distance to obstacles, and whether the robot touched one, which ends no episode but
makes it a failure.
"""

from __future__ import annotations

import atexit
import contextlib
import math
import tempfile
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from acsar_gym.config import RobotConfig
from acsar_gym.errors import CancelledError, PolicyError
from acsar_gym.tasks.episode import RunningEpisode
from acsar_gym.tasks.goal import GoalTask
from acsar_gym.tasks.task import says_shortest_path
from acsar_gym.tools.benchmark.figures import Scoring, record_episode
from acsar_gym.tools.benchmark.plan import CONDITIONS, PLANAR, PORT, BenchmarkJob, BenchmarkPlan
from acsar_gym.tools.benchmark.scenes import SceneSet
from acsar_gym.tools.benchmark.store import Part, Store
from acsar_gym.tools.emulation.board import PATIENCE, run_emulator
from acsar_gym.tools.evaluation import episodes, report, runs
from acsar_gym.tools.evaluation.episodes import EpisodeResult
from acsar_gym.tools.jobs import completed
from acsar_gym.tools.policies import FilePolicy
from acsar_gym.worlds import Region, files
from acsar_gym.worlds.pool import Pool
from acsar_gym.worlds.search import footprint_radius, path_length, remaining_distance
from acsar_gym.worlds.world import point_in_world

PORT_TOUCH_DISTANCE = 0.003
"""A footprint nearer to an obstacle than this touched it [m]: bodies in PyBullet stop each other
before they overlap."""
POSE_STRIDE = 20
"""Every so many true poses of the log, which are 200 a second, count for lengths."""


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
        All parts in the order of the plan, those of earlier runs too.

    Raises:
        CancelledError: after Ctrl-C; the message says how much is finished.
        ConfigError: the scenes or the folder can't be used, or the disk is full.
        LinkError, JobError, ClusterError: a job can't be run.
    """
    plan.check()
    done = {(part.cell, part.first): part for part in store.open(plan.as_dict())}
    every = list(plan.jobs())
    waiting = [job for job in every if (job.cell, job.first) not in done]
    columns = (
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("episodes"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.description}"),
    )
    total = sum(job.count for job in every)
    finished = total - sum(job.count for job in waiting)
    running = completed(run_job, waiting, workers=workers, address=address)
    try:
        with (
            Progress(*columns, console=report.SafeConsole(stderr=True)) as progress,
            contextlib.closing(running),
        ):
            task = progress.add_task("", total=total, completed=finished)
            for number, part in running:
                done[part.cell, part.first] = store.add(part)
                cell, job = part.cell, waiting[number]
                seed = "" if cell.training_seed is None else f" {cell.training_seed}"
                told = f"{cell.scenes} {cell.link} {cell.condition} {cell.agent}{seed}"
                progress.update(task, advance=job.count, description=report.escape_text(told))
    except KeyboardInterrupt as error:
        raise CancelledError(
            f"interrupted: {len(done)} of {len(every)} parts are kept in {store.folder}; the same "
            "command goes on with the others"
        ) from error
    finally:
        close_kept_env()
    return [done[job.cell, job.first] for job in every if (job.cell, job.first) in done]


def run_job(job: BenchmarkJob) -> Part:
    """Drive the scenes of a job.

    Args:
        job: what to drive.

    Returns:
        The episodes; or why the agent can't drive there at all, such as another observation.

    Raises:
        AcsarError: this time it can't be driven: a file, a package or a port is missing, ...
    """
    begin, cell = time.process_time(), job.cell
    simulated = cell.link != PORT
    why = CONDITIONS[cell.condition].impossible(simulated=simulated)
    if why:
        return Part(cell, job.first, refused=why)
    policy = job.policy.load()
    try:  # for the port in a simulation that checks whether the policy fits
        env = keep_env(policy, cell.link if simulated else PLANAR, cell.condition, job.scenes)
        if not simulated:
            runs.refuse_outside(policy)
    except PolicyError as error:
        own = Path(job.policy.name).name
        return Part(cell, job.first, refused=str(error).replace(str(policy.path), own))
    task, config = env.unwrapped.task, env.unwrapped.robot.config
    scoring = Scoring(job.scenes.score, config.max_linear, task.goal_tolerance)
    scoring.check(task)
    told = []
    for place in range(job.first, job.first + job.count):
        seed, options = job.scenes.reset(place)
        if simulated:
            (result,) = episodes.run_episodes(env, policy, 1, seed, **options)
        else:
            result = _drive_over_port(job, policy, config, seed, options)
        told.append(record_episode(result, job.scenes.numbers[place], scoring))
    return Part(cell, job.first, told, round(time.process_time() - begin, 3))


_KEPT: dict[tuple[FilePolicy, str, str, SceneSet], Any] = {}
"""The env of the last job of this process, by what it was made for."""


def keep_env(policy: FilePolicy, link: str, condition: str, scenes: SceneSet) -> Any:
    """Make an env for a policy; kept for the next job of the same cell, see `close_kept_env`."""
    wanted = policy, link, condition, scenes
    if wanted not in _KEPT:
        close_kept_env()
        under = CONDITIONS[condition]
        config = scenes.config.with_(**under.changes)
        _KEPT[wanted] = runs.make_env(policy, link, config, under.options(scenes, config))
    return _KEPT[wanted]


@atexit.register  # in the processes of the jobs
def close_kept_env() -> None:
    """Close the env that `keep_env` has kept, if there is one."""
    while _KEPT:
        _KEPT.popitem()[1].close()


def _drive_over_port(
    job: BenchmarkJob,
    policy: FilePolicy,
    config: RobotConfig,
    seed: int,
    reset: Mapping[str, Any],
) -> EpisodeResult:
    """Drive one scene with an emulator of its own, and a LiDAR where there are obstacles.

    Raises:
        LinkError: the emulator didn't start, or its port can't be opened.
    """
    options = CONDITIONS[job.cell.condition].options(job.scenes, config)
    source = job.scenes.worlds
    with tempfile.TemporaryDirectory() as name:
        folder, around = Path(name), []
        log = folder / "log.jsonl"
        config.save(folder / "robot.yaml")
        if source is not None and "world" in reset:
            pool = Pool.of(source, options.get("difficulty"), footprint_radius(config))
            world = pool[reset["world"]]
            if world.obstacles:
                files.save_world(world, folder / "world.json")
                around = ["--world", str(folder / "world.json"), "--lidar"]
        given = ("--body", "bullet", "--robot", str(folder / "robot.yaml"), "--log", str(log))
        with run_emulator(*given, *around) as devices:
            if devices.lidar:
                options["lidar"] = f"rplidar://{devices.lidar}"
            env = runs.make_env(policy, devices.robot, config.with_(**PATIENCE), options)
            inner: Any = env.unwrapped
            with contextlib.closing(env):
                (result,) = episodes.run_episodes(env, policy, 1, seed, **reset)
                episode = inner.episode
        return add_emulator_truth(result, episode, config, log)


def add_emulator_truth(
    result: EpisodeResult, episode: RunningEpisode, config: RobotConfig, log: Path
) -> EpisodeResult:
    """Complete a result with what the emulator's log knows.

    Args:
        result: of an episode over the port.
        episode: with its world, start and goal; of another task than those with a goal no shortest
            path is known.
        config: of the robot.
        log: of the emulator.

    Raises:
        ConfigError: the log holds no true poses.
    """
    stamps, poses = episodes.read_true_poses(log)
    first, last = np.searchsorted(stamps, (result.started, result.ended), side="right")
    track = np.array(poses[max(0, first - 1) : last])
    length = path_length(np.concatenate([track[:-1:POSE_STRIDE], track[-1:]])[:, :2])
    (error,) = episodes.odometry_errors([result], log)
    result = replace(result, driven=length, odometry_error=error)
    assignment = episode.assignment
    world = assignment.world
    if world is None or not world.obstacles:
        return result
    clearance = episodes.footprint_clearance(track, config.outline, world)
    touched = clearance < PORT_TOUCH_DISTANCE
    shortest = left = math.nan
    if isinstance(episode.task, GoalTask) and says_shortest_path(episode.task):
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
