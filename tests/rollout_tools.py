"""Recordings made in memory: robots driven on a planar twin whose parameters a test knows."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from typing import Any

import numpy as np

from acsar_gym import Robot, RobotConfig
from acsar_gym.links import open_link
from acsar_gym.links.base import Link, LinkWrapper
from acsar_gym.protocol import Speeds
from acsar_gym.recording.blocks import Head
from acsar_gym.recording.events import Tables
from acsar_gym.recording.types import Episode, Recording, Scans, WireLog
from acsar_gym.worlds import Scene

SLICES = 20
"""Parts of a tick whose bytes have stamps of their own."""
HIDDEN: dict[str, Any] = {"motor": {"time_constant": 0.14}, "body": {"friction": 0.7}}
"""Changes that make a robot whose default twin is wrong."""


class Tap(LinkWrapper):
    """Forwards to a simulated link, and keeps the bytes with their times.

    Args:
        link: Simulated link.
        phase: Time from the board's start to the first stamp [s].
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
        columns: list[Any] = []
        for pieces in (self.sent, self.got):
            stamps, data = zip(*pieces, strict=True)
            columns += [np.array(stamps), data]
        return WireLog(*columns)


def random_steps(seed: int, duration: float, config: RobotConfig) -> list[Speeds]:
    """Wheel speeds for each tick: a new straight line or turn every 0.3 to 0.9 s, or a stop."""
    rng = np.random.default_rng(seed)
    ticks: list[Speeds] = []
    while len(ticks) < duration * config.control_rate:
        right_speed, left_speed = rng.uniform(-9.0, 9.0, 2) if rng.random() < 0.75 else (0.0, 0.0)
        ticks += [(right_speed, left_speed, left_speed, right_speed)] * int(
            rng.uniform(0.3, 0.9) * config.control_rate
        )
    return ticks[: int(duration * config.control_rate)]


def driven(config: RobotConfig, ticks: Iterable[Speeds], *, phase: float = 0.0) -> Episode:
    """Drive a twin of `config` open-loop, and return the episode."""
    tap = Tap(open_link("planar", config), phase)
    robot = Robot(tap, config)
    robot.reset(Scene())
    rows = []
    for command in ticks:
        robot.tick(command)
        odometry = robot.odometry
        assert tap.truth is not None
        rows.append((tap.now(), odometry.pose, odometry.twist, robot.speeds, tap.truth.pose))
    robot.close()

    stamps, poses, twists, speeds, truth = (np.array(column) for column in zip(*rows, strict=True))
    count = len(stamps)
    return Episode(
        Head(info={}),
        Tables(),
        wire=tap.log,
        stamps=stamps,
        poses=poses,
        twists=twists,
        speeds=speeds,
        truth=truth,
        terminated=False,
        step_stamps=np.zeros(0),
        asked=twists,
        sent=twists,
        reasons=np.zeros(count, np.int64),
        lateness=np.full(count, np.nan),
        observations=np.zeros((0, 0), np.float32),
        actions=np.zeros((0, 2), np.float32),
        rewards=np.zeros(0),
        scans=Scans(np.zeros(0), np.zeros((0, 0)), np.zeros(0, np.int64)),
    )


def recording(config: RobotConfig, *episodes: Episode, name: str = "") -> Recording:
    """Make a recording, whose hash is that of `name`."""
    sha256 = hashlib.sha256(name.encode()).hexdigest()[:16]
    return Recording(header={}, sha256=sha256, config=config, episodes=episodes)
