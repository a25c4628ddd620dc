"""The command `identify`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import tyro

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError, escape_unprintable
from acsar_gym.tools.cli.commands import command
from acsar_gym.tools.cli.options import (
    File,
    RecordOptions,
    RobotArg,
    check_writable,
    countdown,
    print_results,
    say,
)

Sources = Annotated[
    tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="DEVICE | LOG [LOG ...]")
]
LATE_MANOEUVRE = 1.1
"""A manoeuvre that takes longer than this, as a share of its length, is worth a warning."""


@command("identify", "robots", drives=True)
def identify_robot(
    sources: Sources,
    recording: RecordOptions,
    robot: RobotArg = None,
    out: File = None,
    duration: float = 20.0,
    yes: bool = False,
    twin: RobotArg = None,
    json: File = None,
) -> int:
    """Find how motors and board answer, from what the wire carries, and write it to a robot's file.

    With a device, the wheels turn for 20 s with steps, slow staircases and a pause without
    commands: lift the robot! With recordings, whatever they hold is used. Either way it says
    first which parameters the log can't tell, and which manoeuvre is missing.

    Args:
        sources: serial device, planar, bullet, mujoco; or recordings of one robot, made with
            --record.
        recording: recording of the manoeuvre.
        robot: preset or config file: what is known so far. Default: the one recorded, or acsar.
        out: write the robot's file with what was found, to be used as --robot.
        duration: of the manoeuvre [s].
        yes: don't ask before the wheels turn.
        twin: simulation only: the robot that is driven, a hidden one to be found.
        json: also write the findings to this file.
    """
    from acsar_gym.links import open_link  # noqa: PLC0415
    from acsar_gym.physics.bodies import BODIES  # noqa: PLC0415
    from acsar_gym.tools.sysid import identify  # noqa: PLC0415

    check_writable(json, robot=out)
    if not sources:
        raise ConfigError("identify needs a device, or recordings made with --record")
    files = [Path(source).suffix == ".mcap" or Path(source).is_file() for source in sources]
    device = sources[0]
    if any(files) or len(sources) > 1:
        if not all(files):
            other = sources[files.index(False)]
            raise ConfigError(f"{other}: isn't a recording; give one device, or recordings only")
        known = None if robot is None else RobotConfig.of(robot)
        found = identify.identify_files([Path(source) for source in sources], known)
    else:
        config, simulated = RobotConfig.of(robot), device in BODIES
        if twin is not None and not simulated:
            raise ConfigError(f"--twin is for simulated robots: {' or '.join(BODIES)}")
        link = open_link(device, config if twin is None else RobotConfig.of(twin))
        if not simulated:
            what = f"{device}: the wheels will turn for {duration:g} s in both directions"
            countdown(f"{what}; lift the robot, so that they turn freely", yes=yes)
        recorder = recording.recorder("identify")
        found = identify.identify_device(link, config, duration, recorder)
        if found.duration > LATE_MANOEUVRE * duration:
            late = (
                f"acsar-gym: the manoeuvre took {found.duration:.1f} s instead of {duration:g}: "
                "this computer was late, and the figures are worse for it; stop other programs, "
                f"see 'acsar-gym doctor {device} --timing', and drive again"
            )
            print(escape_unprintable(late), file=sys.stderr)
    print_results(identify.identification_table(found), json=json, data=found.as_dict())
    found.check()
    if found.dead:
        names = ", ".join(found.dead)
        say(f"{names} never turned: nothing of it was found; check motor and encoder")
    if out is not None:
        found.robot().save(out)
        say(f"written: {out}; use it with --robot {out}")
    return 0
