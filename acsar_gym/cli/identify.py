"""Command identify: motors, board and delays, from the wire alone."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from acsar_gym.cli import asking
from acsar_gym.cli.options import File, Json, RobotArg, check_out
from acsar_gym.cli.recording import RecordArgs
from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError, printable

if TYPE_CHECKING:
    from acsar_gym.identification.identified import Identified

Sources = Annotated[
    tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="DEVICE | LOG [LOG ...]")
]
SIMULATED = ("planar", "bullet")
LATE = 1.1
"""A manoeuvre that takes longer than this, as a share of its length, is worth a warning."""


def identify(
    sources: Sources,
    recording: RecordArgs,
    robot: RobotArg = None,
    out: File = None,
    duration: float = 20.0,
    yes: bool = False,
    twin: RobotArg = None,
    json: Json = None,
) -> int:
    """Find how motors and board answer, from what the wire carries, and write it to a robot's file.

    With a device, the wheels turn for 20 s with steps, slow staircases and a pause without
    commands: lift the robot! With recordings, whatever they hold is used. Either way it says
    first which parameters the log can't tell, and which manoeuvre is missing.

    Args:
        sources: serial device, planar, bullet; or recordings of one robot, made with --record.
        recording: recording of the manoeuvre.
        robot: preset or config file: what is known so far. Default: the one recorded, or acsar.
        out: write the robot's file with what was found, to be used as --robot.
        duration: of the manoeuvre [s].
        yes: don't ask before the wheels turn.
        twin: simulation only: the robot that is driven, a hidden one to be found.
        json: also write the findings to this file.
    """
    from acsar_gym.evaluation import report  # noqa: PLC0415

    check_out(out)
    report.check_writable(json)
    if not sources:
        raise ConfigError("identify needs a device, or recordings made with --record")
    if _are_files(sources):
        found = _from_files(sources, robot)
    else:
        found = _from_device(sources[0], robot, twin, duration, recording, yes=yes)
        _warn(lateness(found.duration, duration, sources[0]))
    return _finish(found, out, json)


def _are_files(sources: tuple[str, ...]) -> bool:
    """Whether recordings are given, instead of one device."""
    files = [Path(source).suffix == ".mcap" or Path(source).is_file() for source in sources]
    if not any(files) and len(sources) == 1:
        return False
    if not all(files):
        other = sources[files.index(False)]
        raise ConfigError(f"{other}: isn't a recording; give one device, or recordings only")
    return True


def _from_files(sources: tuple[str, ...], robot: str | None) -> Identified:
    """Identify from recordings."""
    from acsar_gym.identification import sources as logs  # noqa: PLC0415

    config = None if robot is None else RobotConfig.of(robot)
    return logs.from_files([Path(source) for source in sources], config)


def _from_device(
    device: str,
    robot: str | None,
    twin: str | None,
    duration: float,
    recording: RecordArgs,
    *,
    yes: bool,
) -> Identified:
    """Ask, drive the manoeuvre, and identify."""
    from acsar_gym.identification import sources as logs  # noqa: PLC0415
    from acsar_gym.links import open_link  # noqa: PLC0415

    config, simulated = RobotConfig.of(robot), device in SIMULATED
    if twin is not None and not simulated:
        raise ConfigError("--twin is for simulated robots: planar or bullet")
    link = open_link(device, config if twin is None else RobotConfig.of(twin))
    if not simulated:
        what = f"{device}: the wheels will turn for {duration:g} s in both directions"
        asking.countdown(f"{what}; lift the robot, so that they turn freely", yes=yes)
    return logs.from_device(link, config, duration, recording.recorder("identify"))


def lateness(took: float, asked: float, device: str) -> str:
    """Say that a manoeuvre took longer than it should have, as this computer was too busy.

    Args:
        took: length of the log [s].
        asked: length of the manoeuvre [s].
        device: that was driven.

    Returns:
        One line; empty where it was in time.
    """
    if took <= LATE * asked:
        return ""
    return (
        f"the manoeuvre took {took:.1f} s instead of {asked:g}: this computer was late, and the "
        f"figures are worse for it; stop other programs, see 'acsar-gym doctor {device} --timing', "
        "and drive again"
    )


def _warn(line: str) -> None:
    """Print a warning, if there is one."""
    if line:
        print(f"acsar-gym: {printable(line)}", file=sys.stderr)


def _finish(found: Identified, out: Path | None, json: Path | None) -> int:
    """Print and write; returns the exit code."""
    from acsar_gym.evaluation import report  # noqa: PLC0415
    from acsar_gym.identification.report import table  # noqa: PLC0415

    report.show(table(found))
    report.write_json(json, found.as_dict())
    found.check()
    if found.dead:
        names = ", ".join(found.dead)
        print(f"{names} never turned: nothing of it was found; check motor and encoder")
    if out is not None:
        found.robot().save(out)
        print(printable(f"written: {out}; use it with --robot {out}"))
    return 0
