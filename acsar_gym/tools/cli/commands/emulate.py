"""The command `emulate`: a board on a pseudo-terminal."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError, explain_error
from acsar_gym.tools.cli.commands import command
from acsar_gym.tools.cli.options import (
    File,
    Force,
    RobotArg,
    Seconds,
    WorldFileOptions,
    WorldName,
    check_writable,
)


@dataclass(frozen=True)
class EmulatedWorld(WorldFileOptions):
    """The world around the robot."""

    world: WorldName = None
    """World with the robot at its start: a file, or a generated world like clutter:7-7."""
    key: float = 0.0
    """The episode's draw, 0 to 1, on which the world's movers depend."""


@dataclass(frozen=True)
class EmulatorFiles:
    """Files of an emulator."""

    log: File = None
    """Write commands and true poses to this file, one JSON line each."""
    name: File = None
    """Symbolic link that always points to the current device."""
    force: Force = False


@contextlib.contextmanager
def _name_write_errors(log: Path | None) -> Iterator[None]:
    """Turn an OSError inside the block, for example of a full disk, into a ConfigError."""
    try:
        yield
    except OSError as error:
        raise ConfigError(f"{log}: can't be written: {explain_error(error)}") from error


@command("emulate", "robots")
def emulate_board(
    place: EmulatedWorld,
    files: EmulatorFiles,
    robot: RobotArg = None,
    body: str = "planar",
    duration: Seconds = None,
    lidar: bool = False,
    silent: bool = False,
) -> int:
    """Run an emulated board on a pseudo-terminal and print its device path.

    SIGUSR1 unplugs the cable, SIGUSR2 plugs it in again as another device.

    Args:
        place: the world around the robot.
        files: log and link.
        robot: preset or config file of the emulated robot.
        body: physics, planar, bullet or mujoco.
        duration: seconds to run; default: until Ctrl-C.
        lidar: also emulate an RPLIDAR, on a pseudo-terminal of its own.
        silent: never answer, as a board without power.
    """
    from acsar_gym.tools.emulation.board import LOG_MARK, Emulator  # noqa: PLC0415
    from acsar_gym.worlds import Scene  # noqa: PLC0415
    from acsar_gym.worlds.pool import Pool  # noqa: PLC0415
    from acsar_gym.worlds.search import footprint_radius, lidar_height  # noqa: PLC0415

    check_writable(files.log, force=files.force, mark=LOG_MARK)
    config, scene = RobotConfig.of(robot), None
    source = place.place(*filter(None, [place.world]))
    if source is not None:
        radius, height = footprint_radius(config), lidar_height(config)
        world = next(iter(Pool.of(source, None, radius, alone="1", height=height)))
        start = world.start.x, world.start.y, world.start.theta or 0.0
        scene = Scene(start, world=world, key=place.key)
    with (
        _name_write_errors(files.log),
        Emulator(
            config,
            body=body,
            log=files.log,
            silent=silent,
            scene=scene,
            sees=lidar,
            name=files.name,
        ) as emulator,
    ):
        # A list, because an exception that is raised in a signal handler can be lost.
        ended: list[int] = []
        signal.signal(signal.SIGTERM, lambda number, _: ended.append(number))
        # Shells let background programs of a script ignore SIGINT; an emulator obeys it there, too.
        signal.signal(signal.SIGINT, signal.default_int_handler)
        for number, plugged in ((signal.SIGUSR1, False), (signal.SIGUSR2, True)):
            signal.signal(number, lambda *_, to=plugged: setattr(emulator, "plugged", to))
        print(f"serving a robot on {emulator.device}", flush=True)
        if emulator.lidar_device:
            print(f"serving a LiDAR on {emulator.lidar_device}", flush=True)
        emulator.run(duration, until=lambda: bool(ended))
        if emulator.lost:
            print(f"stood still for {emulator.lost:.1f} s in all: this computer was too busy")
    return 0
