"""Commands for recordings: view, record info, record export."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Annotated, Literal

import tyro

from acsar_gym.tools.cli.options import File, check_writable, print_results, say

Source = Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="FILE|LINK")]
Recorded = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE")]


def view_run(source: Source, port: int = 8050) -> int:
    """Show a run as a page in a browser, recorded or while it is driven; with a stop button.

    Args:
        source: a recording, also while it is being written; or the device of a robot that a
            program on this computer drives with --record FILE.
        port: port of the page, on this computer only; 0 takes any free one.
    """
    from acsar_gym.tools.view.server import find_recording, serve_page  # noqa: PLC0415

    path = find_recording(source)
    with serve_page(path, port) as server, contextlib.suppress(KeyboardInterrupt):
        say(f"{path}: open http://127.0.0.1:{server.port} in a browser; Ctrl-C ends it")
        server.serve_forever()
    return 0


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
