"""Recordings made in memory: robots driven on a planar twin whose parameters a test knows."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from typing import Any

import gymnasium
import numpy as np

from acsar_gym import Robot, RobotConfig
from acsar_gym.links import open_link
from acsar_gym.links.base import Link, LinkWrapper
from acsar_gym.protocol import Speeds
from acsar_gym.recording.blocks import Head
from acsar_gym.recording.events import Tables
from acsar_gym.recording.types import Episode, Recording, Scans, WireLog
from acsar_gym.worlds import Pose, Scene

SLICES = 20
"""Parts of a tick whose bytes have stamps of their own."""
HIDDEN: dict[str, Any] = {"motor": {"time_constant": 0.14}, "body": {"friction": 0.7}}
"""Changes that make a robot whose default twin is wrong."""


class Tap(LinkWrapper):
    """Forwards to a simulated link, and keeps the bytes with their times.

    Args:
        link: the simulated link.
        phase: time from the board's start to the log's first stamp [s].
    """

    def __init__(self, link: Link, phase: float = 0.0) -> None:
        super().__init__(link)
        self._phase = phase
        self.sent: list[tuple[float, bytes]] = []
        self.got: list[tuple[float, bytes]] = []

    def reset(self, scene: Scene) -> None:
        self.inner.reset(scene)
        if self._phase:
            self.inner.advance(self._phase)
        self.sent, self.got = [], []

    def write(self, data: bytes) -> None:
        self.inner.write(data)
        self.sent.append((self.now(), data))

    def advance(self, period: float) -> bytes:
        arrived = b""
        for _ in range(SLICES):
            data = self.inner.advance(period / SLICES)
            if data:
                self.got.append((self.now(), data))
            arrived += data
        return arrived

    @property
    def log(self) -> WireLog:
        sent, got = self.sent, self.got
        return WireLog(
            np.array([t for t, _ in sent]),
            tuple(data for _, data in sent),
            np.array([t for t, _ in got]),
            tuple(data for _, data in got),
        )


def random_steps(seed: int, duration: float, config: RobotConfig) -> list[Speeds]:
    """Wheel speeds for each tick: a new straight line or turn every 0.3 to 0.9 s, or a stop."""
    rng = np.random.default_rng(seed)
    ticks: list[Speeds] = []
    while len(ticks) < duration * config.control_rate:
        right, left = rng.uniform(-9.0, 9.0, 2) if rng.random() < 0.75 else (0.0, 0.0)
        ticks += [(right, left, left, right)] * int(rng.uniform(0.3, 0.9) * config.control_rate)
    return ticks[: int(duration * config.control_rate)]


def true_pose(link: Link) -> Pose:
    assert link.truth is not None
    return link.truth.pose


def driven(
    config: RobotConfig,
    ticks: Iterable[Speeds],
    *,
    phase: float = 0.0,
    info: Mapping[str, Any] | None = None,
    start: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Episode:
    """Drive a twin of `config` open-loop, and return the episode."""
    tap = Tap(open_link("planar", config), phase)
    robot = Robot(tap, config)
    robot.reset(Scene(start))
    rows: list[Any] = []
    for speeds in ticks:
        robot.tick(speeds)
        rows.append((tap.now(), robot.odometry.pose, robot.odometry.twist, robot.speeds))
        rows[-1] += (true_pose(tap),)
    episode = of_rows(tap.log, rows, dict(info or {}))
    robot.close()
    return episode


def rollouts(config: RobotConfig, seeds: Iterable[int], **header: Any) -> Recording:
    """Let a simple controller drive PointGoal with these seeds, and record it."""
    tap = Tap(open_link("planar", config))
    env: Any = gymnasium.make("acsar_gym/PointGoal-v0", link=tap, robot=config)
    episodes = [_rollout(env, tap, seed) for seed in seeds]
    env.close()
    about = {"env": {"id": "acsar_gym/PointGoal-v0"}}
    return recording(config, *episodes, **({"about": about} | header))


def _rollout(env: Any, tap: Tap, seed: int) -> Episode:
    observation, info = env.reset(seed=seed)
    robot, done = env.unwrapped.robot, False
    rows: list[Any] = []
    seen, acted, rewards = [observation], [], []
    while not done:
        _, cosine, sine = observation[:3]
        acted.append(np.array([0.8 * max(cosine, 0.0), sine], np.float32))
        observation, reward, terminated, truncated, info = env.step(acted[-1])
        done = terminated or truncated
        seen.append(observation)
        rewards.append(reward)
        pose = robot.odometry.pose
        rows.append((tap.now(), pose, robot.odometry.twist, robot.speeds, true_pose(tap)))
    arrays = {"observations": np.array(seen), "actions": np.array(acted)}
    arrays |= {"rewards": np.array(rewards), "success": info["is_success"] == 1.0}
    return of_rows(tap.log, rows, {"seed": seed}, **arrays)


def of_rows(log: WireLog, rows: list[Any], info: Mapping[str, Any], **arrays: Any) -> Episode:
    """Make an episode of rows (stamp, pose, twist, speeds, true pose), one for each tick."""
    stamps, poses, twists, speeds, truth = (np.array(column) for column in zip(*rows, strict=True))
    n = len(stamps)
    nothing: dict[str, Any] = {
        "terminated": False,
        "step_stamps": np.zeros(0),
        "asked": twists,
        "sent": twists,
        "reasons": np.zeros(n, np.int64),
        "lateness": np.full(n, np.nan),
        "observations": np.zeros((0, 0), np.float32),
        "actions": np.zeros((0, 2), np.float32),
        "rewards": np.zeros(0),
        "scans": Scans(np.zeros(0), np.zeros((0, 0)), np.zeros(0, np.int64)),
    }
    return Episode(
        Head(info=dict(info)),
        Tables(),
        wire=log,
        stamps=stamps,
        poses=poses,
        twists=twists,
        speeds=speeds,
        truth=truth,
        **(nothing | arrays),
    )


def recording(config: RobotConfig, *episodes: Episode, name: str = "", **header: Any) -> Recording:
    """Make a recording; its hash is that of `name`."""
    sha256 = hashlib.sha256(name.encode()).hexdigest()[:16]
    return Recording(header=header, sha256=sha256, config=config, episodes=episodes)
