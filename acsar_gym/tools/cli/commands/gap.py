"""The command `gap`: recordings against a twin."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

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
    from acsar_gym.recording import Recording

Logs = Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="LOG [LOG ...]")]
RobotFile = Annotated[str, tyro.conf.arg(metavar="PRESET|FILE")]


@command("gap", "recordings")
def measure_gap(
    logs: Logs,
    robot: RobotFile,
    bag: BagOptions,
    before: RobotFile = "acsar",
    body: str = "planar",
    truth: File = None,
    json: File = None,
    force: Force = False,
) -> int:
    """Replay recorded commands through the twin, before and after fitting, and measure its gap.

    Figures are over the logs that the robot wasn't fitted to, if there are any.

    Args:
        logs: recordings of one robot, made with --record, or ROS 2 bags of it.
        robot: the fitted robot, such as the file that identify wrote.
        bag: of ROS 2.
        before: the unfitted robot; a preset gets the wiring, the baud rate and the comma of the
            first recording.
        body: physics of the twins, planar, bullet or mujoco.
        truth: log of the emulator that was recorded (emulate --log), with its true poses.
        json: also write the figures to this file.
        force: overwrite the file.
    """
    from acsar_gym.tools.sysid import tracks, twin_gap  # noqa: PLC0415

    check_writable(json, force=force)
    fitted = (Path(robot).name, RobotConfig.of(robot))
    recordings = _read_logs([bag.open(log, robot) for log in logs])
    if truth is not None:
        recordings = [(name, tracks.add_truth(log, truth)) for name, log in recordings]
    unfitted = RobotConfig.of(before)
    if not (Path(before).suffix or "/" in before):  # a preset
        recorded = recordings[0][1].config
        wire = "wheels", "baud_rate", "trailing_comma"
        unfitted = unfitted.with_(**{field: getattr(recorded, field) for field in wire})
    gap = twin_gap.measure_gap(recordings, fitted, (Path(before).name, unfitted), body)
    print_results(*twin_gap.gap_tables(gap), json=json, data=twin_gap.format_gap(gap))
    for line in (twin_gap.conclude_gap(gap), *gap.notes):
        say(line)
    return 0


def _read_logs(paths: Sequence[Path]) -> list[tuple[str, Recording]]:
    """Read recordings; ConfigError if one can't be read, or is named twice."""
    from acsar_gym.recording import read  # noqa: PLC0415

    if not paths:
        raise ConfigError("no recording is named: make one with --record FILE")
    logs = [(path.name, read(path)) for path in paths]
    names: dict[str, str] = {}
    for name, log in logs:
        begun = str((log.header["created"], log.header.get("cut")))  # tells a cut copy, too
        if begun in names:
            raise ConfigError(f"{name}: is the same recording as {names[begun]}")
        names[begun] = name
    return logs
