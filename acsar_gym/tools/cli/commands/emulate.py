"""The command `emulate`: a board on a pseudo-terminal."""

from __future__ import annotations

import signal
from typing import TYPE_CHECKING, Annotated

import tyro

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError, explain_error
from acsar_gym.tools.cli.commands import command
from acsar_gym.tools.cli.options import File, RobotArg, Seconds, check_writable

if TYPE_CHECKING:
    from acsar_gym.tools.emulation.board import Emulator


@command("emulate")
def emulate_board(
    robot: RobotArg = None,
    body: str = "planar",
    world: Annotated[str | None, tyro.conf.arg(metavar="KIND|PATH")] = None,
    key: float = 0.0,
    duration: Seconds = None,
    lidar: bool = False,
    silent: bool = False,
    log: File = None,
    name: File = None,
) -> int:
    """Run an emulated board on a pseudo-terminal and print its device path.

    SIGUSR1 unplugs the cable, SIGUSR2 plugs it in again as another device.

    Args:
        robot: Preset or config file of the emulated robot.
        body: Physics, planar, bullet or mujoco.
        world: World with the robot at its start: a file, or a generated world like clutter:7-7.
        key: The episode's draw, 0 to 1, on which the world's movers depend.
        duration: Seconds to run. Default: until Ctrl-C.
        lidar: Also emulate an RPLIDAR, on its own pseudo-terminal.
        silent: Never answer, as a board without power.
        log: Write commands and true poses to this file, one JSON line each.
        name: Symbolic link that always points to the current device.
    """
    from acsar_gym.tools.emulation.board import LOG_MARK, Emulator
    from acsar_gym.worlds import Scene
    from acsar_gym.worlds.pool import Pool
    from acsar_gym.worlds.search import footprint_radius, lidar_height

    check_writable(log, mark=LOG_MARK)
    config = RobotConfig.of(robot)
    scene = None
    if world is not None:
        height = lidar_height(config)
        pool = Pool.of(world, None, footprint_radius(config), alone="1", height=height)
        place = next(iter(pool))
        start = (place.start.x, place.start.y, place.start.theta or 0.0)
        scene = Scene(start, world=place, key=key)

    try:
        with Emulator(
            config, body=body, log=log, silent=silent, scene=scene, sees=lidar, name=name
        ) as emulator:
            _serve(emulator, duration)
    except OSError as error:  # such as a full disk
        raise ConfigError(f"{log}: can't be written: {explain_error(error)}") from error
    return 0


def _serve(emulator: Emulator, duration: float | None) -> None:
    """Run a board until a signal ends it."""
    # A list, because an exception that is raised in a signal handler can be lost.
    signals: list[int] = []
    signal.signal(signal.SIGTERM, lambda number, _: signals.append(number))
    # Shells let background programs of a script ignore SIGINT, which an emulator obeys there, too.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    for number, plugged in ((signal.SIGUSR1, False), (signal.SIGUSR2, True)):
        signal.signal(number, lambda *_, to=plugged: setattr(emulator, "plugged", to))

    print(f"serving a robot on {emulator.device}", flush=True)
    if emulator.lidar_device:
        print(f"serving a LiDAR on {emulator.lidar_device}", flush=True)
    emulator.run(duration, until=lambda: bool(signals))
    if emulator.lost:
        print(f"stood still for {emulator.lost:.1f} s in all: this computer was too busy")
