"""Drives scenes over a serial device: the emulated board, and its LiDAR, on pseudo-terminals.

The emulator runs PyBullet in another process and in real time. The driver knows odometry alone;
what only a simulator knows is taken from the emulator's log: length driven, distance to obstacles,
and whether the robot touched one, which ends no episode here but makes it a failure.
"""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from acsar_gym.benchmark.conditions import CONDITIONS
from acsar_gym.config import RobotConfig
from acsar_gym.emulation.process import Devices, emulator
from acsar_gym.evaluation import driven, runs
from acsar_gym.evaluation import episodes as evaluation
from acsar_gym.evaluation.episodes import EpisodeResult
from acsar_gym.policies import FilePolicy
from acsar_gym.tasks.spawn import Assignment
from acsar_gym.worlds import Region, World, files
from acsar_gym.worlds.pool import Pool
from acsar_gym.worlds.scene import point_in_world
from acsar_gym.worlds.search import footprint_radius, path_length, way_left

if TYPE_CHECKING:
    from acsar_gym.benchmark.plan import Job

TOUCH = 0.003
"""A footprint nearer to an obstacle than this touched it [m]: bodies in PyBullet stop each other
before they overlap."""
THINNED = 20
"""Every so many true poses of the log, which are 200 a second, count for lengths."""


def results(job: Job, env: Any, policy: FilePolicy) -> Iterator[EpisodeResult]:
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
        env = runs.made(policy, devices.robot, config, {**options, **sees})
        inner: Any = env.unwrapped
        try:
            (result,) = evaluation.episodes(env, policy, 1, seed, **reset)
            assignment = inner.episode.assignment
        finally:
            env.close()
    return with_truth(result, assignment, config, log)


def _world(config: RobotConfig, options: Mapping[str, Any], number: int | None) -> World | None:
    """Return the obstacles around the robot; None where there are none."""
    source = options["worlds"]
    if source is None or number is None:
        return None
    world = Pool.of(source, options.get("difficulty"), footprint_radius(config))[number]
    return world if world.obstacles else None


@contextlib.contextmanager
def _emulated(config: RobotConfig, world: World | None, log: Path) -> Iterator[Devices]:
    """Run an emulator; with a LiDAR where there are obstacles."""
    robot = log.with_name("robot.yaml")
    config.save(robot)
    around: list[str] = []
    if world is not None:
        files.save(world, log.with_name("world.json"))
        around = ["--world", str(log.with_name("world.json")), "--lidar"]
    given = ("--body", "bullet", "--robot", str(robot), "--log", str(log), *around)
    with emulator(*given) as devices:
        yield devices


def with_truth(
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
    stamps, poses = evaluation.true_poses(log)
    first, last = np.searchsorted(stamps, (result.started, result.ended), side="right")
    track = np.array(poses[max(0, first - 1) : last])
    length = path_length(np.concatenate([track[:-1:THINNED], track[-1:]])[:, :2])
    (error,) = evaluation.odometry_errors([result], log)
    result = replace(result, driven=length, odometry_error=error)
    world = assignment.world
    if world is None or not world.obstacles:
        return result
    clearance = driven.footprint_clearance(track, config.outline, world)
    touched = clearance < TOUCH
    goal = Region(*point_in_world(assignment.start, assignment.goal))
    shortest, left = (
        way_left(world, footprint_radius(config), Region(*end[:2]), goal)
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
