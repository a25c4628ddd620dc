"""Look into recordings, or convert them: acsar-gym record info|export FILE."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import tyro

from acsar_gym.tools.cli.commands import command
from acsar_gym.tools.cli.options import (
    File,
    check_writable,
    print_results,
    say,
)

Recorded = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE")]


@command("record info", "recordings")
def describe_recording(file: Recorded, json: File = None) -> int:
    """Tell what a recording holds.

    Args:
        file: the recording.
        json: also write it to this file.
    """
    from acsar_gym.recording.reader import summarize, summary_lines  # noqa: PLC0415

    check_writable(json)
    found = summarize(file)
    for line in summary_lines(found):
        say(line)
    print_results(json=json, data=found)
    return 0


@command("record export", "recordings")
def export_recording(
    file: Recorded,
    to: Literal["parquet", "csv", "minari"],
    out: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")] = None,
) -> int:
    """Convert a recording to tables, or to a data set for offline learning.

    Args:
        file: the recording.
        to: parquet or csv, one table for each kind of data; or minari, a data set.
        out: folder to write; default: beside the recording, with its name.
    """
    from acsar_gym.recording import export as exports  # noqa: PLC0415

    for written in exports.export_recording(file, to, out or file.with_suffix("")):
        say(f"written: {written}")
    return 0
