"""The command `acsar-gym worlds`: show, check or convert worlds."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import tyro

from acsar_gym.cli.options import Json, OutFile, RobotArg
from acsar_gym.errors import printable

Source = Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="KIND|PATH")]


def show(
    source: Source,
    out: Path = Path("worlds.png"),
    columns: int = 4,
    size: int = 320,
    difficulty: float | None = None,
    robot: RobotArg = None,
) -> int:
    """Draw a world, or a sheet of several, as a PNG file.

    Args:
        source: kind of generated worlds (clutter:12, mine.module:halls:0-9), file or folder.
        out: the picture.
        columns: worlds side by side.
        size: width and height of each world [pixels].
        difficulty: difficulty of generated worlds, 0 to 1.
        robot: preset or config file; generated worlds fit its footprint.
    """
    from acsar_gym.evaluation import atlas  # noqa: PLC0415

    most = atlas.most_drawn(columns, size, out)
    atlas.draw(atlas.raw(source, difficulty, robot, 12, most), columns, size, out)
    print(printable(f"drawn: {out}"))
    return 0


def check(
    source: Source, difficulty: float | None = None, robot: RobotArg = None, json: Json = None
) -> int:
    """Check whether the robot can cross worlds; print path lengths and BARN's difficulty.

    Args:
        source: kind of generated worlds (clutter:12, mine.module:halls:0-9), file or folder.
        difficulty: of generated worlds, 0 to 1.
        robot: preset or config file, for its footprint.
        json: also write the findings to this file.
    """
    from acsar_gym.evaluation import atlas, report  # noqa: PLC0415

    report.check_writable(json)
    findings = atlas.check(atlas.raw(source, difficulty, robot, 12), robot)
    told = atlas.told(source, 12)
    report.show(atlas.table(str(told["source"]), findings))
    report.write_json(json, told | {"worlds": [finding.as_dict() for finding in findings]})
    return int(any(finding.fault for finding in findings))


def convert(
    source: Source, out: OutFile, difficulty: float | None = None, robot: RobotArg = None
) -> int:
    """Write a world to a file of this project's format, .json or .yaml.

    Args:
        source: a .world file, the YAML of a ROS map, or a generated world like barn:7-7.
        out: .json or .yaml file.
        difficulty: difficulty of generated worlds, 0 to 1.
        robot: preset or config file; generated worlds fit its footprint.
    """
    from acsar_gym.evaluation import atlas  # noqa: PLC0415

    atlas.convert(source, out, difficulty, robot)
    print(printable(f"written: {out}"))
    return 0


WORLDS: dict[str, Callable[..., Any]] = {"show": show, "check": check, "convert": convert}


def worlds() -> int:
    """Draw, check or convert worlds: acsar-gym worlds show|check|convert SOURCE."""
    return int(
        tyro.extras.subcommand_cli_from_dict(WORLDS, prog="acsar-gym worlds", args=sys.argv[2:])
    )
