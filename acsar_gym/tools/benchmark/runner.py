"""Runs a plan: the cells that aren't finished yet, in parallel, each result kept at once.

A job drives the scenes of a cell in a simulation of its process; or over a serial device: the
emulated board, and its LiDAR, on pseudo-terminals. The emulator runs PyBullet in another process
and in real time. There the driver knows odometry alone; what only a simulator knows is taken from
the emulator's log: length driven, distance to obstacles, and whether the robot touched one or
somebody, which ends no episode but makes it a failure. A robot in ROS 2 is put into each scene by
its driver, and what only a simulator knows stays unknown.
"""

from __future__ import annotations

import contextlib
import math
import tempfile
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.utils import seeding

from acsar_gym.config import RobotConfig
from acsar_gym.errors import CancelledError, PolicyError
from acsar_gym.tasks.episode import RunningEpisode, draw_in_world
from acsar_gym.tasks.goal import GoalTask
from acsar_gym.tasks.navigation import BARN_SCORES
from acsar_gym.tasks.task import says_shortest_path
from acsar_gym.tools.benchmark.cells import CellResult, Store
from acsar_gym.tools.benchmark.figures import Scoring, score_episode
from acsar_gym.tools.benchmark.plan import (
    CONDITIONS,
    PLANAR,
    PORT,
    ROS2,
    BenchmarkJob,
    BenchmarkPlan,
)
from acsar_gym.tools.emulation.board import PATIENCE, run_emulator
from acsar_gym.tools.evaluation import episodes, report, runs
from acsar_gym.tools.evaluation.episode import (
    Episode,
    footprint_clearance,
    odometry_errors,
    read_person_contact,
    read_true_poses,
)
from acsar_gym.tools.jobs import completed
from acsar_gym.tools.policies import FilePolicy
from acsar_gym.worlds import Region, World, files
from acsar_gym.worlds.crowd import NO_HIT, ROBOT_HIT
from acsar_gym.worlds.pool import Pool
from acsar_gym.worlds.search import footprint_radius, path_length, remaining_distance
from acsar_gym.worlds.world import point_in_world

PORT_TOUCH_DISTANCE = 0.003
"""A footprint nearer to an obstacle than this touched it [m]: bodies in PyBullet stop each other
before they overlap."""
POSE_STRIDE = 20  # every so many true poses of the log, which are 200 a second, count for lengths


def run_plan(
    plan: BenchmarkPlan, store: Store, *, workers: int | None = None, address: str | None = None
) -> list[CellResult]:
    """Drive the cells that aren't finished, and keep each as soon as it is; returns all in order.

    Raises CancelledError after Ctrl-C, which says how much is finished.
    """
    plan.check()
    jobs = list(plan.jobs())
    if ROS2 in plan.links:
        workers = 1  # there is one robot
    # Nobody knows whether the robot in ROS is the same as before.
    stored = {job.cell: store.find(job.key) for job in jobs if job.cell.link != ROS2}
    done = {cell: result for cell, result in stored.items() if result is not None}
    waiting = [job for job in jobs if job.cell not in done]
    running = completed(run_job, waiting, workers=workers, address=address)
    try:
        with contextlib.closing(running):
            for number, result in report.watch_progress("cells", running, len(waiting)):
                done[result.cell] = store.add(waiting[number].key, result)
    except KeyboardInterrupt as error:
        raise CancelledError(
            f"interrupted: {len(done)} of {len(jobs)} cells are kept in {store.folder}; the same "
            "command drives the others"
        ) from error
    return [done[job.cell] for job in jobs]


def run_job(job: BenchmarkJob) -> CellResult:
    """Drive the scenes of a cell; or say why the agent can't drive there at all.

    Raises AcsarError where it can't be driven this time: a file, a package or a port is missing.
    """
    begin, cell, scenes = time.process_time(), job.cell, job.scenes
    over_port, condition = cell.link == PORT, CONDITIONS[job.cell.condition]
    if why := condition.impossible(cell.link):
        return CellResult(cell, refused=why)
    policy, config = job.policy.load(), scenes.config.with_(**condition.changes)
    if over_port and policy.privileged:
        why = f"{cell.agent}: knows what only a simulator does: use --links planar, or another"
        return CellResult(cell, refused=why)
    try:  # for the port in a simulation that checks whether the policy fits
        env: Any = runs.make_env(
            policy,
            PLANAR if over_port else cell.link,
            config,
            condition.options(scenes, config),
        )
    except PolicyError as error:
        return _refuse_cell(job, policy, error)
    with contextlib.closing(env):
        try:
            if over_port:
                runs.refuse_outside(policy)
        except PolicyError as error:
            return _refuse_cell(job, policy, error)
        task = env.unwrapped.task
        scoring = Scoring(scenes.score, config.max_linear, task.goal_tolerance)
        scoring.check(task)
        resets = [scenes.reset(place) for place in range(job.count)]
        if over_port:
            driven = [_drive_over_port(job, policy, config, *reset) for reset in resets]
        else:
            driven = list(episodes.run_resets(env, policy, resets))
    scored = [replace(episode, score=score_episode(episode, scoring)) for episode in driven]
    return CellResult(cell, scored, round(time.process_time() - begin, 3))


def _refuse_cell(job: BenchmarkJob, policy: FilePolicy, error: PolicyError) -> CellResult:
    """The cell of an agent that can't drive there; names no folder of this machine."""
    why = str(error).replace(str(policy.path), Path(job.policy.name).name)
    return CellResult(job.cell, refused=why)


def _drive_over_port(
    job: BenchmarkJob,
    policy: FilePolicy,
    config: RobotConfig,
    seed: int,
    reset: Mapping[str, Any],
) -> Episode:
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
            scene = draw_in_world(pool, seeding.np_random(seed)[0], reset)
            world = scene.world or World()
            if world.obstacles or world.movers:
                files.save_world(world, folder / "world.json")
                around = ["--world", str(folder / "world.json"), "--lidar", f"--key={scene.key}"]
        given = ("--body", "bullet", "--robot", str(folder / "robot.yaml"), "--log", str(log))
        with run_emulator(*given, *around) as devices:
            if devices.lidar:
                options["lidar"] = f"rplidar://{devices.lidar}"
            env = runs.make_env(policy, devices.robot, config.with_(**PATIENCE), options)
            inner: Any = env.unwrapped
            with contextlib.closing(env):
                (result,) = episodes.run_resets(env, policy, [(seed, reset)])
                episode = inner.episode
        return add_emulator_truth(result, episode, config, log)


def add_emulator_truth(
    result: Episode, episode: RunningEpisode, config: RobotConfig, log: Path
) -> Episode:
    """Complete a result with what the emulator's log knows."""
    stamps, poses = read_true_poses(log)
    assignment = episode.assignment
    world, ended, person_contact = assignment.world, result.ended, math.nan
    if world is not None and world.movers:  # a simulation would have ended with the first contact
        ended, person_contact = read_person_contact(log, result.started, result.ended)
    first, last = np.searchsorted(stamps, (result.started, ended), side="right")
    track = np.array(poses[max(0, first - 1) : last])
    length = path_length(np.concatenate([track[:-1:POSE_STRIDE], track[-1:]])[:, :2])
    (error,) = odometry_errors([result], log)
    result = replace(result, driven=length, odometry_error=error)
    if world is None or not (world.obstacles or world.movers):
        return result
    clearance = math.nan
    if world.obstacles:
        clearance = max(0.0, footprint_clearance(track, config.outline, world))
    touched = clearance < PORT_TOUCH_DISTANCE
    if touched and world.movers:
        person_contact = NO_HIT
    has_ended = touched or person_contact > NO_HIT
    shortest = left = math.nan
    if isinstance(episode.task, GoalTask) and says_shortest_path(episode.task):
        goal = Region(*point_in_world(assignment.start, assignment.goal))
        shortest, left = (
            remaining_distance(world, footprint_radius(config), Region(*end[:2]), goal)
            for end in (track[0], track[-1])
        )
    return replace(
        result,
        success=result.success and not has_ended,
        collision=touched or person_contact == ROBOT_HIT,
        person_contact=person_contact,
        clearance=clearance,
        shortest=shortest,
        left=left,
        told=result.told
        | (dict.fromkeys(result.told.keys() & {*BARN_SCORES}, 0.0) if has_ended else {}),
    )
