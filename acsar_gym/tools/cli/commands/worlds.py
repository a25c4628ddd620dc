"""Draw, check or convert worlds: acsar-gym worlds show|check|convert SOURCE."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from acsar_gym.tools.cli.commands import command
from acsar_gym.tools.cli.options import (
    Force,
    OutFile,
    ResultOptions,
    RobotArg,
    WorldFileOptions,
    check_writable,
    print_results,
    say,
)

Source = Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="KIND|PATH")]


@command("worlds show", "worlds")
def show_worlds(
    source: Source,
    file: WorldFileOptions,
    out: Path = Path("worlds.png"),
    columns: int = 4,
    size: int = 320,
    difficulty: float | None = None,
    robot: RobotArg = None,
    force: Force = False,
) -> int:
    """Draw a world, or a sheet of several, as a PNG file.

    Args:
        source: kind of generated worlds (clutter:12, mine.module:halls:0-9), file or folder.
        file: of the worlds.
        out: the picture.
        columns: worlds side by side.
        size: width and height of each world [pixels].
        difficulty: difficulty of generated worlds, 0 to 1.
        robot: preset or config file; generated worlds fit its footprint.
        force: replace a file that this command didn't write, too.
    """
    from acsar_gym.tools import atlas  # noqa: PLC0415

    check_writable(out, force=force)
    most = atlas.max_drawn(columns, size, out)
    _, worlds = atlas.collect_worlds(file.place(source), difficulty, robot, 12, most)
    atlas.draw_worlds(worlds, columns, size, out)
    if movers := atlas.describe_movers(worlds):
        say(movers)
    say(f"drawn: {out}")
    return 0


@command("worlds check", "worlds")
def check_worlds(
    source: Source,
    file: WorldFileOptions,
    output: ResultOptions,
    difficulty: float | None = None,
    robot: RobotArg = None,
) -> int:
    """Check whether the robot can cross worlds; print path lengths.

    Args:
        source: kind of generated worlds (clutter:12, mine.module:halls:0-9), file or folder.
        file: of the worlds.
        output: results in a file.
        difficulty: of generated worlds, 0 to 1.
        robot: preset or config file, for its footprint.
    """
    from acsar_gym.tools import atlas  # noqa: PLC0415
    from acsar_gym.tools.evaluation.metrics import replace_nonfinite  # noqa: PLC0415

    output.check()
    world_set, worlds = atlas.collect_worlds(file.place(source), difficulty, robot, 12)
    findings = atlas.check_worlds(worlds, robot)
    title = source if world_set.worlds else str(world_set)
    table = atlas.findings_table(title, findings)
    data = {
        "source": title,
        "split": world_set.split or None,
        "worlds": replace_nonfinite(findings),
    }
    print_results(table, json=output.json, data=data)
    return int(any(finding["fault"] for finding in findings))


@command("worlds convert", "worlds")
def convert_world(
    source: Source,
    out: OutFile,
    file: WorldFileOptions,
    difficulty: float | None = None,
    robot: RobotArg = None,
    force: Force = False,
) -> int:
    """Write a world to a file of this project's format, .json or .yaml.

    Args:
        source: a .world file, the YAML of a ROS map, or a generated world like barn:7-7.
        out: .json or .yaml file.
        file: of the world.
        difficulty: difficulty of generated worlds, 0 to 1.
        robot: preset or config file; generated worlds fit its footprint.
        force: replace another file that exists.
    """
    from acsar_gym.tools import atlas  # noqa: PLC0415

    atlas.convert_world(file.place(source), out, difficulty, robot, force=force)
    say(f"written: {out}")
    return 0
