"""The commands `record info`, `record export` and `view`."""

from __future__ import annotations

import contextlib
import os
import signal
from pathlib import Path
from typing import Annotated, Literal

import tyro

from acsar_gym.errors import ConfigError, require_extra
from acsar_gym.tools.cli.commands import command
from acsar_gym.tools.cli.options import (
    BagOptions,
    EnvArg,
    File,
    Goal,
    ResultOptions,
    RobotArg,
    check_writable,
    say,
)

Recorded = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE")]


@command("record info")
def describe_recording(
    file: Recorded, bag: BagOptions, output: ResultOptions, robot: RobotArg = None
) -> int:
    """Describe what a recording contains.

    Args:
        file: The recording, or a ROS 2 bag.
        bag: Options of ROS 2 bags.
        output: Results in a file.
        robot: ROS 2 bags: preset or file of the robot.
    """
    from acsar_gym.recording.reader import summarize, summary_lines

    output.check()
    summary = summarize(bag.open(file, robot)) | {"file": str(file)}
    for line in summary_lines(summary):
        say(line)
    output.print(data=summary)
    return 0


@command("record export")
def export_recording(
    files: Annotated[
        tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="FILE [FILE ...]")
    ],
    to: Literal["parquet", "csv", "minari", "lerobot"],
    bag: BagOptions,
    out: File = None,
    env: EnvArg = "",
    goal: Goal = None,
    robot: RobotArg = None,
) -> int:
    """Convert a recording to tables, or recordings to a data set for offline learning.

    Args:
        files: The recording, or a ROS 2 bag. A data set may be made of several.
        to: Parquet or csv, one table for each kind of data, or minari or lerobot, a data set of
            what an agent would have seen and done.
        bag: Options of ROS 2 bags.
        out: Folder to write. Default: next to the first recording, with its name.
        env: Data sets: the env whose observations are wanted. Default: the env that recorded, or
            point_goal if a person drove.
        goal: Data sets: x and y in the odometry frame [m]. Default: the recorded goal, or the
            end of the drive.
        robot: ROS 2 bags: preset or file of the robot.
    """
    from acsar_gym.recording import export
    from acsar_gym.tools import datasets

    if not files:
        raise ConfigError("record export needs a recording")
    # The name comes from the user's file, not from the recording that is made of a bag.
    folder = out
    if folder is None:
        is_folder = files[0].is_dir()
        folder = Path(f"{files[0]}.tables") if is_folder else files[0].with_suffix("")
    files = tuple(bag.open(file, robot) for file in files)
    if to in ("minari", "lerobot"):
        written, data = datasets.write_dataset(files, to, folder, env, goal)
        count = len(data.episodes)
        say(f"written: {written}: {count} episode{'s' * (count != 1)}, {data.steps} steps")
        return 0

    if len(files) > 1 or env or goal is not None:
        option = "several recordings" if len(files) > 1 else "--env" if env else "--goal"
        raise ConfigError(f"{option}: for --to minari and lerobot only, not {to}")
    for table in export.export_recording(files[0], to, folder):
        say(f"written: {table}")
    return 0


@command("view")
def view_run(source: Recorded, bag: BagOptions, save: File = None, robot: RobotArg = None) -> int:
    """Show a recorded run in Rerun's viewer. Drive with --view to watch a robot live.

    Args:
        source: A recording, or a ROS 2 bag.
        bag: Options of ROS 2 bags.
        save: Write an .rrd file instead of opening a viewer.
        robot: For ROS 2 bags: preset or file of the robot.
    """
    os.environ.setdefault("RUST_LOG", "off")  # Rerun would report that its viewer was closed
    with require_extra("the viewer", "view"):
        from acsar_gym.tools.view import show

    check_writable(save, mark="RRF")
    path = bag.open(source, robot)
    if save is not None:
        count = show.save_recording(path, save)
        say(f"{save}: {count} episode{'s' * (count != 1)}, for Rerun's viewer")
        return 0
    for number in (signal.SIGINT, signal.SIGTERM):  # Rerun's program ends with this one
        signal.signal(number, signal.default_int_handler)
    with contextlib.suppress(KeyboardInterrupt):
        show.show_recording(path)
    return 0
