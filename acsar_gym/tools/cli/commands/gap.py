"""The commands `gap` and `compare`: recordings against a twin, and simulation against hardware."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError
from acsar_gym.tools.cli.commands import command
from acsar_gym.tools.cli.options import (
    BagOptions,
    File,
    Force,
    check_writable,
    print_results,
    say,
)

if TYPE_CHECKING:
    from rich.table import Table

    from acsar_gym.recording import Recording

Logs = Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="LOG [LOG ...]")]
Files = Annotated[tuple[Path, ...], tyro.conf.arg(metavar="FILE [FILE ...]")]
Limits = Annotated[tuple[str, ...], tyro.conf.arg(metavar="METRIC=VALUE [...]")]
First = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SIM")]
Second = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="REAL")]
UnfittedRobot = Annotated[str, tyro.conf.arg(metavar="PRESET|FILE|recorded")]
RobotFile = Annotated[str, tyro.conf.arg(metavar="PRESET|FILE")]


@dataclass(frozen=True)
class GapOutputs:
    """What is written, and the limits that must be kept."""

    fail_over: Limits = ()
    """Limits in SI units; exit code 1 where one isn't kept. For gap such as wheel_speed_rms=0.5
    end_pose=0.05, for compare of the paired differences, such as success_rate=0.05."""
    json: File = None
    """Also write the figures to this file."""
    html: File = None
    """Also write a report with plots to this file."""
    force: Force = False

    def prepare(self, metrics: Sequence[str]) -> Any:
        """Check before the work begins that all can be written; returns the limits of metrics."""
        from acsar_gym.tools.evaluation import page  # noqa: PLC0415
        from acsar_gym.tools.sysid import twin_gap  # noqa: PLC0415

        limits = twin_gap.parse_limits(self.fail_over, metrics)
        check_writable(self.json, self.html, force=self.force)
        if self.html is not None:
            page.check_report_extra()
        return limits

    def write(self, table: Sequence[Table], lines: Sequence[str], data: Any, page: Any) -> None:
        """Print tables and lines, and write what is asked for; `page` makes the report."""
        print_results(*table, json=self.json, data=data)
        for line in lines:
            say(line)
        if self.html is not None:
            page().write(self.html)


@command("gap", "recordings")
def measure_gap(
    logs: Logs,
    robot: RobotFile,
    outputs: GapOutputs,
    bag: BagOptions,
    before: UnfittedRobot = "acsar",
    body: str = "planar",
    truth: File = None,
) -> int:
    """Replay recorded commands through the twin, before and after fitting, and measure its gap.

    Figures are over the logs that the robot wasn't fitted to, if there are any.

    Args:
        logs: recordings of one robot, made with --record, or ROS 2 bags of it.
        robot: the fitted robot, such as the file that identify wrote.
        outputs: files and limits.
        bag: of ROS 2.
        before: the unfitted robot; a preset gets the wiring, the baud rate and the comma of the
            first recording; "recorded" is the robot in each recording.
        body: physics of the twins, planar, bullet or mujoco.
        truth: log of the emulator that was recorded (emulate --log), with its true poses.
    """
    from acsar_gym.tools.sysid import pages, tracks, twin_gap  # noqa: PLC0415

    limits = outputs.prepare(twin_gap.LIMIT_NAMES)
    after = Path(robot).name, RobotConfig.of(robot)
    recordings = _read_logs([bag.open(log, robot) for log in logs])
    if truth is not None:
        recordings = [(name, tracks.add_truth(log, truth)) for name, log in recordings]
    recorded, unfitted = recordings[0][1].config, None
    if before != "recorded":
        unfitted = RobotConfig.of(before)
        if not (Path(before).suffix or "/" in before):  # a preset
            wire = "wheels", "baud_rate", "trailing_comma"
            unfitted = unfitted.with_(**{field: getattr(recorded, field) for field in wire})
    found = twin_gap.measure_gap(recordings, after, (Path(before).name, unfitted), body)
    lines = [*twin_gap.conclude_gap(found), *found.notes]
    tables, data = twin_gap.gap_tables(found), twin_gap.format_gap(found)
    outputs.write(tables, lines, data, lambda: pages.gap_page(found))
    return _judge_limits(twin_gap.find_exceeded(limits, twin_gap.limit_sizes(found)))


@command("compare", "recordings")
def compare_runs(
    first: First,
    second: Second,
    outputs: GapOutputs,
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
    from acsar_gym.tools.sysid import pages, sim_real, twin_gap  # noqa: PLC0415

    limits = outputs.prepare((*sim_real.EPISODE_METRICS, "delay"))
    found = sim_real.compare_sides(_read_logs((first, *sim)), _read_logs((second, *real)))
    lines = [*sim_real.conclude_comparison(found), *found.notes]
    tables, data = [sim_real.comparison_table(found)], sim_real.format_comparison(found)
    outputs.write(tables, lines, data, lambda: pages.compare_page(found))
    return _judge_limits(twin_gap.find_exceeded(limits, sim_real.difference_sizes(found)))


def _read_logs(paths: Sequence[Path]) -> list[tuple[str, Recording]]:
    """Read recordings; ConfigError if one can't be read, or is named twice."""
    from acsar_gym.recording import read  # noqa: PLC0415

    if not paths:
        raise ConfigError("no recording is named: make one with --record FILE")
    logs = [(path.name, read(path)) for path in paths]
    seen: dict[str, str] = {}
    for name, log in logs:
        begun = str((log.header["created"], log.header.get("cut")))  # tells a cut copy, too
        if begun in seen:
            raise ConfigError(f"{name}: is the same recording as {seen[begun]}")
        seen[begun] = name
    return logs


def _judge_limits(failures: Sequence[str]) -> int:
    """Print limits that aren't kept; returns the exit code."""
    for line in failures:
        print(f"acsar-gym: {line}", file=sys.stderr)
    return 1 if failures else 0
