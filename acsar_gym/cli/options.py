"""Options that several commands have, and how they are shown in the help."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

Json = Annotated[Path | None, tyro.conf.arg(metavar="FILE")]
File = Json
Seconds = Annotated[float | None, tyro.conf.arg(metavar="SECONDS")]
OutFile = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]
Worlds = Annotated[str | None, tyro.conf.arg(metavar="KIND|PATH")]
LidarArg = Annotated[str | None, tyro.conf.arg(metavar="URL")]
EnvArg = Annotated[str, tyro.conf.arg(metavar="NAME|ID")]
RobotArg = Annotated[str | None, tyro.conf.arg(metavar="PRESET|FILE")]


@dataclass(frozen=True)
class HostOptions:
    """How this computer runs the program."""

    realtime: Annotated[int | None, tyro.conf.arg(metavar="PRIORITY")] = None
    """SCHED_FIFO priority, 1 to 98."""
    cores: Annotated[tuple[int, ...] | None, tyro.conf.arg(metavar="N [N ...]")] = None
    """Numbers of the cores to run on."""

    def prepare(self) -> None:
        """Set priority and cores. Raises ConfigError where that isn't allowed."""
        from acsar_gym.doctor import host  # noqa: PLC0415

        host.prepare(self.realtime, self.cores)


@dataclass(frozen=True)
class PolicyOptions:
    """What decides."""

    policy: str = "point_goal"
    """ONNX file, the name of a policy that comes along, or a function: mine.py:act."""
    trust: bool = False
    """Let a stable-baselines3 zip as policy run its code: your own, or whose you trust."""
    env: EnvArg = ""
    """Instead of the env that the policy names: point_goal, ..., or mine.module:mine/Task-v0."""


@dataclass(frozen=True)
class RobotOptions:
    """What is robot."""

    link: str = "bullet"
    """bullet, planar, or a serial device."""
    robot: RobotArg = None
    """Preset or config file."""
    lidar: LidarArg = None
    """rplidar:///dev/ttyUSB1 on hardware, for a policy that needs one."""


@dataclass(frozen=True)
class WorldOptions:
    """Where it is evaluated."""

    worlds: Worlds = None
    """Instead of the test split: rooms:test, barn:1000-1099, ..., a file, or a folder."""
    in_order: bool = False
    """Every world once, instead of drawing them: a benchmark on a folder of worlds."""
    difficulty: float | None = None
    """Of generated worlds, 0 to 1."""


@dataclass(frozen=True)
class TimingOptions:
    """Of the control loop."""

    timing: bool = False
    """How late the control loop's ticks are, against a bare loop, and what to change."""
    duration: float = 10.0
    """Of the timing [s]."""


@dataclass(frozen=True)
class StoppingOptions:
    """Of an emulated robot."""

    stopping: bool = False
    """How soon an emulated robot is commanded to stop, whatever happens to its policy."""
    trials: int = 100
    """Of each kind of fault, for --stopping."""
    kinds: Annotated[tuple[str, ...] | None, tyro.conf.arg(metavar="KIND [KIND ...]")] = None
    """Of faults, for --stopping: all unless some are named, as kill, stop, watchdog."""


_flat = tyro.conf.arg(name="")
"""The fields are options of the command itself, without a prefix."""
HostArgs = Annotated[HostOptions, _flat]
PolicyArgs = Annotated[PolicyOptions, _flat]
RobotArgs = Annotated[RobotOptions, _flat]
WorldArgs = Annotated[WorldOptions, _flat]
TimingArgs = Annotated[TimingOptions, _flat]
StoppingArgs = Annotated[StoppingOptions, _flat]
