"""Commands that compare recordings with twins, and with each other: gap, compare."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from acsar_gym.cli.options import File, Json
from acsar_gym.config import RobotConfig

if TYPE_CHECKING:
    from rich.table import Table

    from acsar_gym.recording.types import Recording

Logs = Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="LOG [LOG ...]")]
Files = Annotated[tuple[Path, ...], tyro.conf.arg(metavar="FILE [FILE ...]")]
Limits = Annotated[tuple[str, ...], tyro.conf.arg(metavar="METRIC=VALUE [...]")]
First = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SIM")]
Second = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="REAL")]
Source = Annotated[str, tyro.conf.arg(metavar="PRESET|FILE|recorded")]
RobotFile = Annotated[str, tyro.conf.arg(metavar="PRESET|FILE")]
RECORDED = "recorded"


@dataclass(frozen=True)
class Outputs:
    """What is written, and the limits that must be kept."""

    fail_over: Limits = ()
    """Limits in SI units; exit code 1 where one isn't kept. For gap such as wheel_speed_rms=0.5
    end_pose=0.05, for compare of the paired differences, such as success_rate=0.05."""
    json: Json = None
    """Also write the figures to this file."""
    html: File = None
    """Also write a report with plots to this file."""

    def check(self) -> None:
        """Check that everything can be written, before the work begins."""
        from acsar_gym.evaluation import report  # noqa: PLC0415
        from acsar_gym.evaluation.page import document  # noqa: PLC0415

        report.check_writable(self.json)
        report.check_writable(self.html)
        if self.html is not None:
            document.library()


OutputArgs = Annotated[Outputs, tyro.conf.arg(name="")]


def gap(
    logs: Logs,
    robot: RobotFile,
    outputs: OutputArgs,
    before: Source = "acsar",
    body: str = "planar",
    truth: File = None,
) -> int:
    """Replay recorded commands through the twin, before and after fitting, and measure its gap.

    Figures are over the logs that the robot wasn't fitted to, if there are any.

    Args:
        logs: recordings of one robot, made with --record.
        robot: the fitted robot, such as the file that identify wrote.
        outputs: files and limits.
        before: the unfitted robot; a preset gets the wiring, the baud rate and the comma of the
            first recording; "recorded" is the robot in each recording.
        body: physics of the twins, planar or bullet.
        truth: log of the emulator that was recorded (emulate --log), with its true poses.
    """
    from acsar_gym.gap import limits, measure, tables  # noqa: PLC0415
    from acsar_gym.gap.page import gap_page  # noqa: PLC0415

    known = limits.parsed(outputs.fail_over, tables.LIMITS)
    outputs.check()
    after = Path(robot).name, RobotConfig.of(robot)
    recordings = _with_truth(_read(logs), truth)
    unfitted = Path(before).name, _unfitted(before, recordings[0][1].config)
    found = measure.measure(recordings, after, unfitted, body)
    _show(tables.tables(found), [*measure.conclusion(found), *found.notes])
    _write(outputs.json, tables.as_dict(found))
    if outputs.html is not None:
        gap_page.page(found).write(outputs.html)
    return _judged(limits.exceeded(known, tables.sizes(found)))


def compare(
    first: First,
    second: Second,
    outputs: OutputArgs,
    sim: Files = (),
    real: Files = (),
) -> int:
    """Compare recordings of a task in simulation and on hardware, episodes paired by seed.

    Args:
        first: recording of the simulation.
        second: recording of the robot.
        outputs: files and limits.
        sim: more recordings of the simulation.
        real: more recordings of the robot.
    """
    from acsar_gym.gap import compare_tables, limits, sides  # noqa: PLC0415
    from acsar_gym.gap.page import compare_page  # noqa: PLC0415

    known = limits.parsed(outputs.fail_over, (*sides.VALUES, "delay"))
    outputs.check()
    found = sides.compare(_read((first, *sim)), _read((second, *real)))
    _show([compare_tables.table(found)], [*sides.conclusion(found), *found.notes])
    _write(outputs.json, compare_tables.as_dict(found))
    if outputs.html is not None:
        compare_page.page(found).write(outputs.html)
    return _judged(limits.exceeded(known, compare_tables.sizes(found)))


def _unfitted(name: str, recorded: RobotConfig) -> RobotConfig | None:
    """The robot before fitting, a preset on the recorded wire; None for the recorded one."""
    if name == RECORDED:
        return None
    config = RobotConfig.of(name)
    if Path(name).suffix or "/" in name:  # a file
        return config
    wire = {field: getattr(recorded, field) for field in ("wheels", "baud_rate", "trailing_comma")}
    return config.with_(**wire)


def _with_truth(
    logs: list[tuple[str, Recording]], truth: Path | None
) -> list[tuple[str, Recording]]:
    """Add the true poses of an emulator's log."""
    from acsar_gym.gap.truth import with_truth  # noqa: PLC0415

    return logs if truth is None else [(name, with_truth(log, truth)) for name, log in logs]


def _read(paths: Sequence[Path]) -> list[tuple[str, Recording]]:
    """Read recordings; ConfigError if one can't be read, or is named twice."""
    from acsar_gym.errors import ConfigError  # noqa: PLC0415
    from acsar_gym.recording import read  # noqa: PLC0415

    if not paths:
        raise ConfigError("no recording is named: make one with --record FILE")
    logs = [(path.name, read(path)) for path in paths]
    seen: dict[str, str] = {}
    for name, log in logs:
        begun = str(log.header["created"])  # tells a cut copy, too
        if begun in seen:
            raise ConfigError(f"{name}: is the same recording as {seen[begun]}")
        seen[begun] = name
    return logs


def _show(tables: Sequence[Table], lines: Sequence[str]) -> None:
    """Print tables, then lines."""
    from acsar_gym.errors import printable  # noqa: PLC0415
    from acsar_gym.evaluation import report  # noqa: PLC0415

    report.show(*tables)
    for line in lines:
        print(printable(line))


def _write(path: Path | None, data: Mapping[str, Any]) -> None:
    from acsar_gym.evaluation import report  # noqa: PLC0415

    report.write_json(path, data)


def _judged(failures: Sequence[str]) -> int:
    """Print limits that aren't kept; returns the exit code."""
    for line in failures:
        print(f"acsar-gym: {line}", file=sys.stderr)
    return 1 if failures else 0
