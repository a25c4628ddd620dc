"""Options and commands for recordings: --record, --view, record info, record export, view."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from acsar_gym.errors import escape_unprintable

Source = Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="FILE|LINK")]


def view_run(source: Source, port: int = 8050) -> int:
    """Show a run as a page in a browser, recorded or while it is driven; with a stop button.

    Args:
        source: a recording, also while it is being written; or the device of a robot that a
            program on this computer drives with --record FILE.
        port: port of the page, on this computer only; 0 takes any free one.
    """
    from acsar_gym.tools.view.server import (  # noqa: PLC0415
        find_recording,
        serve_page,
    )

    path = find_recording(source)
    with serve_page(path, port) as server:
        print(
            escape_unprintable(
                f"{path}: open http://127.0.0.1:{server.port} in a browser; Ctrl-C ends it"
            ),
            flush=True,
        )
        with contextlib.suppress(KeyboardInterrupt):
            server.serve_forever()
    return 0


if TYPE_CHECKING:
    from acsar_gym.recording import Recorder

Recorded = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE")]


@dataclass(frozen=True)
class RecordOptions:
    """Recording of what the robot does."""

    record: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Record to this MCAP file, for ROS 2, Foxglove and --link replay:FILE; an older recording of
    that name is kept, as FILE.1.mcap."""
    view: bool = False
    """Show it live to Foxglove, on this computer only; prints the address."""

    def recorder(self, command: str, **about: Any) -> Recorder | None:
        """Make the recorder that is asked for.

        Args:
            command: what records.
            **about: what the header says besides, ready for JSON.

        Returns:
            A recorder, which the robot or env that it is given to closes; None if nothing is asked
            for.

        Raises:
            ConfigError, MissingExtraError: it can't record or show.
        """
        if self.record is None and not self.view:
            return None
        from acsar_gym.recording import Recorder  # noqa: PLC0415
        from acsar_gym.recording.sinks import LiveView, check_target  # noqa: PLC0415

        if self.record is not None:
            check_target(self.record)
        sinks = []
        if self.view:
            sinks.append(LiveView())
            print(f"live view: open {sinks[0].url} in Foxglove", flush=True)
        made = Recorder(self.record, {"command": command, **about}, sinks)
        _command_recorders.append(made)
        return made


_command_recorders: list[Recorder] = []
"""The recorders of this command."""


def report_broken() -> bool:
    """Tell on stderr which recordings of this command aren't whole; whether there are any."""
    broken = [
        recorder.path or "live view"
        for recorder in _command_recorders
        if recorder.problem is not None
    ]
    _command_recorders.clear()
    for name in broken:
        print(escape_unprintable(f"acsar-gym: {name}: the recording isn't whole"), file=sys.stderr)
    return bool(broken)


RecordArgs = Annotated[RecordOptions, tyro.conf.arg(name="")]


def run_record_group() -> int:
    """Look into recordings, or convert them: acsar-gym record info|export FILE."""
    return int(
        tyro.extras.subcommand_cli_from_dict(
            RECORD_COMMANDS, prog="acsar-gym record", args=sys.argv[2:]
        )
    )


def describe_recording(
    file: Recorded, json: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
) -> int:
    """Tell what a recording holds.

    Args:
        file: the recording.
        json: also write it to this file.
    """
    from acsar_gym.recording import reader  # noqa: PLC0415
    from acsar_gym.tools.evaluation import report  # noqa: PLC0415

    report.check_writable(json)
    found = reader.summarize(file)
    print("\n".join(map(escape_unprintable, reader.summary_lines(found))))
    report.write_json(json, found)
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

    folder = out or file.with_suffix("")
    for written in exports.export_recording(file, to, folder):
        print(escape_unprintable(f"written: {written}"))
    return 0


RECORD_COMMANDS: dict[str, Callable[..., Any]] = {
    "info": describe_recording,
    "export": export_recording,
}
