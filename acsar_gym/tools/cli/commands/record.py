"""Look into recordings, or convert them: acsar-gym record info|export FILE."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import tyro

from acsar_gym.errors import ConfigError
from acsar_gym.tools.cli.commands import command
from acsar_gym.tools.cli.options import (
    ResultOptions,
    print_results,
    say,
)

Recorded = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE")]


@command("record info", "recordings")
def describe_recording(file: Recorded, output: ResultOptions) -> int:
    """Tell what a recording holds.

    Args:
        file: the recording.
        output: results in a file.
    """
    from acsar_gym.recording.reader import summarize, summary_lines  # noqa: PLC0415

    output.check()
    found = summarize(file)
    for line in summary_lines(found):
        say(line)
    print_results(json=output.json, data=found)
    return 0


@command("record export", "recordings")
def export_recording(
    files: Annotated[
        tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="FILE [FILE ...]")
    ],
    to: Literal["parquet", "csv", "minari", "lerobot"],
    out: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")] = None,
    env: str = "",
    goal: Annotated[tuple[float, float] | None, tyro.conf.arg(metavar="X Y")] = None,
) -> int:
    """Convert a recording to tables, or recordings to a data set for offline learning.

    Args:
        files: the recording; a data set may be made of several.
        to: parquet or csv, one table for each kind of data; or minari or lerobot, a data set of
            what an agent would have seen and done.
        out: folder to write; default: beside the first recording, with its name.
        env: data sets: the env whose observations are wanted; default: the one that recorded, or
            point_goal where a person drove.
        goal: data sets: x and y in the odometry frame [m]; default: the recorded goal, or the place
            where the drive ended.
    """
    if not files:
        raise ConfigError("record export needs a recording")
    folder = out or files[0].with_suffix("")
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
