"""Look into recordings, or convert them: acsar-gym record info|export FILE."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import tyro

from acsar_gym.errors import ConfigError
from acsar_gym.tools.cli.commands import command
from acsar_gym.tools.cli.options import (
    BagOptions,
    ResultOptions,
    RobotArg,
    print_results,
    say,
)

Recorded = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE")]


@command("record info", "recordings")
def describe_recording(
    file: Recorded, bag: BagOptions, output: ResultOptions, robot: RobotArg = None
) -> int:
    """Tell what a recording holds.

    Args:
        file: the recording, or a ROS 2 bag.
        bag: of ROS 2.
        output: results in a file.
        robot: ROS 2 bags: preset or file of the robot that it is of.
    """
    from acsar_gym.recording.reader import summarize, summary_lines  # noqa: PLC0415

    output.check()
    summary = summarize(bag.open(file, robot)) | {"file": str(file)}
    for line in summary_lines(summary):
        say(line)
    print_results(json=output.json, data=summary)
    return 0


def make_folder_name(file: Path) -> Path:
    """Return the folder beside a recording, with its name."""
    return file.with_name(f"{file.name}.tables") if file.is_dir() else file.with_suffix("")


@command("record export", "recordings")
def export_recording(
    files: Annotated[
        tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="FILE [FILE ...]")
    ],
    to: Literal["parquet", "csv", "minari", "lerobot"],
    bag: BagOptions,
    out: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")] = None,
    env: str = "",
    goal: Annotated[tuple[float, float] | None, tyro.conf.arg(metavar="X Y")] = None,
    robot: RobotArg = None,
) -> int:
    """Convert a recording to tables, or recordings to a data set for offline learning.

    Args:
        files: the recording, or a ROS 2 bag; a data set may be made of several.
        to: parquet or csv, one table for each kind of data; or minari or lerobot, a data set of
            what an agent would have seen and done.
        bag: of ROS 2.
        out: folder to write; default: beside the first recording, with its name.
        env: data sets: the env whose observations are wanted; default: the one that recorded, or
            point_goal where a person drove.
        goal: data sets: x and y in the odometry frame [m]; default: the recorded goal, or the place
            where the drive ended.
        robot: ROS 2 bags: preset or file of the robot that it is of.
    """
    if not files:
        raise ConfigError("record export needs a recording")
    folder = out or make_folder_name(files[0])
    files = tuple(bag.open(file, robot) for file in files)
    if to in ("minari", "lerobot"):
        from acsar_gym.tools import datasets  # noqa: PLC0415

        written, data = datasets.write_dataset(files, to, folder, env, goal)
        count = len(data.episodes)
        say(f"written: {written}: {count} episode{'s' * (count != 1)}, {data.steps} steps")
        return 0
    if len(files) > 1 or env or goal is not None:
        what = "several recordings" if len(files) > 1 else "--env" if env else "--goal"
        raise ConfigError(f"{what}: for --to minari and lerobot only, not {to}")
    from acsar_gym.recording import export as exports  # noqa: PLC0415

    for table in exports.export_recording(files[0], to, folder):
        say(f"written: {table}")
    return 0
