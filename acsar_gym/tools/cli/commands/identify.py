"""The command `identify`."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from acsar_gym.config import RobotConfig
from acsar_gym.errors import BUSY_HINT, ConfigError, escape_unprintable
from acsar_gym.tools.cli.commands import command
from acsar_gym.tools.cli.options import (
    BagOptions,
    File,
    Force,
    HostOptions,
    RecordOptions,
    RobotArg,
    check_not_given,
    check_writable,
    countdown,
    print_results,
    say,
)

Sources = Annotated[
    tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="DEVICE | LOG [LOG ...]")
]
DURATION = 20.0
"""Of the manoeuvre, unless asked otherwise [s]."""
LATE_MANOEUVRE = 1.1
"""A manoeuvre that takes longer than this, as a share of its length, is worth a warning."""


@dataclass(frozen=True)
class FoundRobotOptions(RecordOptions):
    """The robot that something is found of, and recording."""

    robot: RobotArg = None
    """Preset or config file: what is known so far. Default: the one recorded, or acsar."""
    twin: RobotArg = None
    """Simulation: the robot that is driven, a hidden one to be found."""

    def driven(self, config: RobotConfig, device: str) -> RobotConfig:
        """The robot that is driven, which isn't what is known of it where there is a twin."""
        if self.twin is None:
            return config
        from acsar_gym.physics.bodies import BODIES  # noqa: PLC0415

        if device not in BODIES:
            raise ConfigError(f"--twin is for simulated robots: {' or '.join(BODIES)}")
        return RobotConfig.of(self.twin)


@dataclass(frozen=True)
class FoundRobotOutputs:
    """Results."""

    out: File = None
    """Write what was found into this robot's file, to be used as --robot; if it exists, its
    comments stay, and what was not found."""
    json: File = None
    """Also write the findings to this file."""
    force: Force = False


@dataclass(frozen=True)
class IdentifyOutputs(FoundRobotOutputs):
    """Results."""

    anyway: bool = False
    """Write it even where the model doesn't fit: without intervals, and the file says so."""


@command("identify", "robots", drives=True)
def identify_robot(
    sources: Sources,
    setup: FoundRobotOptions,
    host: HostOptions,
    output: IdentifyOutputs,
    bag: BagOptions,
    logs: Annotated[tuple[str, ...], tyro.conf.arg(name="from", metavar="LOG [LOG ...]")] = (),
    duration: float = DURATION,
    yes: bool = False,
) -> int:
    """Find how motors and board respond, by the wire alone, and write it to a robot's file.

    With a device, the wheels turn for 20 s with steps, slow staircases and a pause without
    commands: lift the robot! With recordings, all their drives are used. A parameter that the log
    doesn't narrow keeps its value, and the table names the missing manoeuvre. If the model of
    motors and board doesn't describe what was recorded, a file is written only with --anyway.

    Args:
        sources: serial device, planar, bullet, mujoco; or recordings of one robot, made with
            --record, or ROS 2 bags of it.
        setup: robot and recording.
        host: process priority and cores; whether the emergency stop may be missing.
        output: results.
        bag: of ROS 2.
        logs: recordings or ROS 2 bags, instead of a device.
        duration: of the manoeuvre [s].
        yes: don't ask before the wheels turn.
    """
    from acsar_gym.links import open_link  # noqa: PLC0415
    from acsar_gym.physics.bodies import BODIES  # noqa: PLC0415
    from acsar_gym.tools.sysid import identify  # noqa: PLC0415

    check_writable(output.json, robot=output.out, force=output.force)
    recorded = _list_logs(sources, logs)
    robot = setup.robot
    if recorded:
        driving = (setup.twin, setup.record, duration != DURATION)
        options = ("--twin", "--record", "--duration")
        check_not_given(zip(options, driving, strict=True))
        known = None if robot is None else RobotConfig.of(robot)
        found = identify.identify_files([bag.open(path, robot) for path in recorded], known)
    else:
        device = sources[0]
        config = RobotConfig.of(robot)
        link = open_link(device, setup.driven(config, device))
        if device in BODIES:
            host.prepare()
        else:
            host.prepare(device)
            what = f"{device}: the wheels will turn for {duration:g} s in both directions"
            countdown(f"{what}; lift the robot, so that they turn freely", yes=yes)
        recorder = setup.recorder("identify")
        found = identify.identify_device(link, config, duration, recorder)
        if found.duration > LATE_MANOEUVRE * duration:
            late = (
                f"acsar-gym: the manoeuvre took {found.duration:.1f} s instead of {duration:g}: "
                f"this computer was late, and the figures are worse for it; {BUSY_HINT}, and drive "
                "again"
            )
            print(escape_unprintable(late), file=sys.stderr)
    print_results(identify.identification_table(found), json=output.json, data=found.as_dict())
    found.check(anyway=output.anyway)
    if found.dead:
        names = ", ".join(found.dead)
        say(f"{names} never turned: nothing of it was found; check motor and encoder")
    if output.out is not None:
        written = found.robot()
        written.save(output.out, force=output.force)
        say(f"written: {output.out}; use it with --robot {output.out}")
        if written.misfit:
            say(written.misfit)
    return 0


def _list_logs(sources: Sequence[str], logs: Sequence[str]) -> list[Path]:
    """List the recordings and bags that are named; none where a device is."""
    if logs and sources:
        raise ConfigError("--from: give a device, or recordings with --from, not both")
    paths = [Path(source) for source in (*sources, *logs)]
    if not paths:
        raise ConfigError("identify needs a device, or recordings made with --record")
    files = [path.suffix in (".mcap", ".db3") or path.is_file() or path.is_dir() for path in paths]
    if not (logs or any(files) or len(sources) > 1):
        return []
    if not all(files):
        other = paths[files.index(False)]
        raise ConfigError(f"{other}: isn't a recording; give one device, or recordings only")
    return paths
