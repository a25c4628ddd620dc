"""Options and commands for recordings: --record, --view, record info, record export."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from acsar_gym.errors import printable

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
        from acsar_gym.recording import Recorder, target  # noqa: PLC0415

        if self.record is not None:
            target.check(self.record)
        sinks = []
        if self.view:
            from acsar_gym.recording.live import LiveView  # noqa: PLC0415 - optional

            sinks.append(LiveView())
            print(f"live view: open {sinks[0].url} in Foxglove", flush=True)
        made = Recorder(self.record, {"command": command, **about}, sinks)
        _made.append(made)
        return made


_made: list[Recorder] = []
"""The recorders of this command."""


def failed() -> bool:
    """Tell on stderr which recordings of this command aren't whole; whether there are any."""
    broken = [recorder.path or "live view" for recorder in _made if recorder.problem is not None]
    _made.clear()
    for name in broken:
        print(printable(f"acsar-gym: {name}: the recording isn't whole"), file=sys.stderr)
    return bool(broken)


RecordArgs = Annotated[RecordOptions, tyro.conf.arg(name="")]


def record() -> int:
    """Look into recordings, or convert them: acsar-gym record info|export FILE."""
    return int(
        tyro.extras.subcommand_cli_from_dict(RECORD, prog="acsar-gym record", args=sys.argv[2:])
    )


def info(file: Recorded, json: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None) -> int:
    """Tell what a recording holds.

    Args:
        file: the recording.
        json: also write it to this file.
    """
    from acsar_gym.evaluation import report  # noqa: PLC0415
    from acsar_gym.recording import summary  # noqa: PLC0415

    report.check_writable(json)
    found = summary.of(file)
    print("\n".join(map(printable, summary.lines(found))))
    report.write_json(json, found)
    return 0


def export(
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
    for written in exports.export(file, to, folder):
        print(printable(f"written: {written}"))
    return 0


RECORD: dict[str, Callable[..., Any]] = {"info": info, "export": export}
