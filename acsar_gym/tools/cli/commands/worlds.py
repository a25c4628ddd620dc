"""Draw, check or convert worlds: acsar-gym worlds show|check|convert SOURCE."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import tyro

from acsar_gym.tools.cli.commands import command
from acsar_gym.tools.cli.options import (
    ResultOptions,
    RobotArg,
    Source,
    check_writable,
    say,
)


@command("worlds show")
def show_worlds(
    source: Source,
    out: Path = Path("worlds.png"),
    difficulty: float | None = None,
    robot: RobotArg = None,
) -> int:
    """Draw a world, or a sheet of several, as a PNG file.

    Args:
        source: Kind of generated worlds (clutter:12, mine.module:halls:0-9), file or folder.
        out: The picture.
        difficulty: Difficulty of generated worlds, 0 to 1.
        robot: Preset or config file. Generated worlds fit its footprint.
    """
    from acsar_gym.render.top_view import check_picture_name
    from acsar_gym.tools import atlas

    check_picture_name(out)
    check_writable(out)
    _, worlds = atlas.collect_worlds(source, difficulty, robot, 12, atlas.MAX_DRAWN)
    atlas.draw_worlds(worlds, out, robot)
    say(f"drawn: {out}")
    return 0


@command("worlds check")
def check_worlds(
    source: Source,
    output: ResultOptions,
    difficulty: float | None = None,
    robot: RobotArg = None,
) -> int:
    """Check whether the robot can cross worlds. Print path lengths.

    Args:
        source: Kind of generated worlds (clutter:12, mine.module:halls:0-9), file or folder.
        output: Results in a file.
        difficulty: Difficulty of generated worlds, 0 to 1.
        robot: Preset or config file, for its footprint.
    """
    from acsar_gym.tools import atlas

    output.check()
    world_set, worlds = atlas.collect_worlds(source, difficulty, robot, 12)
    findings = atlas.check_worlds(worlds, robot)
    title = source if world_set.worlds else str(world_set)
    data = {"source": title, "split": world_set.split or None, "worlds": findings}
    output.print(atlas.findings_table(title, findings), data=data)
    return int(any(finding["fault"] for finding in findings))


@command("worlds convert")
def convert_world(
    source: Source,
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")],
    start: Annotated[str | None, tyro.conf.arg(metavar="X,Y,THETA")] = None,
    goal: Annotated[str | None, tyro.conf.arg(metavar="X,Y")] = None,
    difficulty: float | None = None,
    robot: RobotArg = None,
) -> int:
    """Write a world to a file of this project's format, .json or .yaml.

    Args:
        source: A .world file, the YAML of a ROS map, or a generated world like barn:7-7.
        out: .json or .yaml file.
        start: Start in a world of a file [m, rad], such as 2,3,1.57. Without theta, the robot
            faces any direction.
        goal: Goal in a world of a file [m].
        difficulty: Difficulty of generated worlds, 0 to 1.
        robot: Preset or config file. Generated worlds fit its footprint.
    """
    from acsar_gym.tools import atlas
    from acsar_gym.worlds import files

    # A world of a file may lack both. Generated worlds refuse them.
    ends = {"start": start, "goal": goal}
    placement = {name: text for name, text in ends.items() if text is not None}
    place = {"path": source, **placement} if placement else source
    _, (world,) = atlas.collect_worlds(place, difficulty, robot, count=1, most=1)

    # A script may run again, but people edit worlds: only an equal file isn't refused.
    is_readable = out.is_file() and os.access(out, os.R_OK)
    if not is_readable or out.read_bytes() != files.format_world(world, out.suffix):
        check_writable(out, mark="")
        files.save_world(world, out)
    say(f"written: {out}")
    return 0
