"""Compares the planar robot with PyBullet's: same commands, same emulated firmware."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError, require_extra
from acsar_gym.links import open_link
from acsar_gym.links.simulated import SimulatedLink
from acsar_gym.protocol import ZERO, Speeds, encode
from acsar_gym.worlds import Pose, Scene

DRIVE_SECONDS = 10.0

WheelCommand = Callable[[float], Speeds]


def _slalom(now: float) -> Speeds:
    """Commanded wheel speeds of the slalom."""
    swing = 3.0 * math.sin(2.0 * now)
    return (6.0 + swing, 6.0 - swing, 6.0 - swing, 6.0 + swing)


COMPARED_DRIVES: dict[str, WheelCommand] = {
    "straight": lambda _: (8.0, 8.0, 8.0, 8.0),
    "arc": lambda _: (8.0, 5.0, 5.0, 8.0),
    "spin": lambda _: (4.0, -4.0, -4.0, 4.0),
    "slalom": _slalom,
    "stop": lambda now: (7.0, 4.0, 4.0, 7.0) if now < 5.0 else ZERO,
    "saturated": lambda _: (99.0, 20.0, 20.0, 99.0),
    "saturated spin": lambda _: (99.0, -99.0, -99.0, 99.0),
}
"""Commanded wheel speeds [rad/s] as functions of time [s], by name."""


@dataclass(frozen=True, slots=True)
class DriveTrace:
    """Poses and wheel speeds of a drive, one per tick."""

    poses: list[Pose]
    wheels: list[Speeds]


def record_trace(link_name: str, drive: WheelCommand, config: RobotConfig) -> DriveTrace:
    """Drive a simulated robot for SECONDS."""
    link = open_link(link_name, config)
    if not isinstance(link, SimulatedLink):
        raise ConfigError(f"link {link_name!r}: only simulated robots can be compared")
    poses, wheels = [], []
    link.reset(Scene())
    for tick in range(round(DRIVE_SECONDS * config.control_rate)):
        link.write(encode(drive(tick * config.period)))
        link.advance(config.period)
        poses.append(link.truth.pose)
        wheels.append(link.body.wheel_speeds if link.body else ZERO)
    link.close()
    return DriveTrace(poses, wheels)


def plot_drives(folder: Path, config: RobotConfig) -> list[Path]:
    """Plot paths and headings of both robots, one PNG per drive.

    Returns:
        The files written.

    Raises:
        MissingExtraError: matplotlib isn't installed.
    """
    with require_extra("drawing plots", "plot"):
        import matplotlib.pyplot as plt  # noqa: PLC0415 - optional
    folder.mkdir(parents=True, exist_ok=True)
    files = []
    for name, drive in COMPARED_DRIVES.items():
        figure, axes = plt.subplots(1, 2, figsize=(9.0, 4.0), layout="constrained")
        for link, style in (("bullet", "-"), ("planar", "--")):
            drawn = record_trace(link, drive, config)
            x, y, theta = zip(*drawn.poses, strict=True)
            axes[0].plot(x, y, style, label=link)
            times = [tick * config.period for tick in range(len(theta))]
            axes[1].plot(times, theta, style, label=link)
        axes[0].set(xlabel="x [m]", ylabel="y [m]", aspect="equal", adjustable="datalim")
        axes[1].set(xlabel="time [s]", ylabel="heading [rad]")
        for axis in axes:
            axis.grid(visible=True, alpha=0.3)
            axis.legend()
        figure.suptitle(f"{name}: PyBullet against the planar robot, {DRIVE_SECONDS:g} s")
        files.append(folder / f"{name.replace(' ', '_')}.png")
        figure.savefig(files[-1], dpi=110)
        plt.close(figure)
    return files
