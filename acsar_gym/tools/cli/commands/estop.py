"""The command `estop`; `acsar_gym.__main__` runs it without this file, which has its help."""

from __future__ import annotations

from typing import Annotated

import tyro

from acsar_gym.tools.cli.commands import command


@command("estop", "robots")
def stop_robots(
    name: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="[NAME]")] = "",
    list: bool = False,  # noqa: A002 - the option's name
    release: bool = False,
) -> int:
    """Stop the real robots that programs of yours on this computer are driving, or one of them.

    They stay stopped, whatever their programs do, until --release.

    Args:
        name: device (/dev/ttyUSB0 or ttyUSB0), name in the robot's file, or process id; default:
            all robots.
        list: only list who drives which robot, and since when.
        release: let them drive again, after their programs' next reset.
    """
    from acsar_gym.safety import estop  # noqa: PLC0415

    return estop.run_command(name, listing=list, release=release)
