"""The command `gap`: recordings against a twin."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError
from acsar_gym.tools.cli.commands import command
from acsar_gym.tools.cli.options import BagOptions, File, ResultOptions, print_results, say

if TYPE_CHECKING:
    from acsar_gym.recording import Recording

Logs = Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="LOG [LOG ...]")]
RobotFile = Annotated[str, tyro.conf.arg(metavar="PRESET|FILE")]


@command("gap")
def measure_gap(
    logs: Logs,
    robot: RobotFile,
    bag: BagOptions,
    output: ResultOptions,
    before: RobotFile = "acsar",
    body: str = "planar",
    truth: File = None,
) -> int:
    """Replay recorded commands through the twin, before and after fitting, and measure its gap.

    Figures are over the logs that the robot wasn't fitted to, if there are any.

    Args:
        logs: Recordings of one robot, made with --record, or ROS 2 bags of it.
        robot: The fitted robot, such as the file that identify wrote.
        bag: Options of ROS 2 bags.
        output: Results in a file.
        before: The unfitted robot. A preset gets the wiring, the baud rate and the comma of the
            first recording.
        body: Physics of the twins, planar, bullet or mujoco.
        truth: Log of the emulator that was recorded (emulate --log), with its true poses.
    """
    from acsar_gym.tools.sysid import tracks, twin_gap

    output.check()
    fitted = (Path(robot).name, RobotConfig.of(robot))
    recordings = _read_logs([bag.open(log, robot) for log in logs])
    if truth is not None:
        recordings = [(name, tracks.add_truth(log, truth)) for name, log in recordings]

    unfitted = RobotConfig.of(before)
    if not (Path(before).suffix or "/" in before):  # a preset
        recorded = recordings[0][1].config
        wire = ("wheels", "baud_rate", "trailing_comma")
        unfitted = unfitted.with_(**{field: getattr(recorded, field) for field in wire})
    gap = twin_gap.measure_gap(recordings, fitted, (Path(before).name, unfitted), body)
    print_results(*twin_gap.gap_tables(gap), json=output.json, data=twin_gap.format_gap(gap))
    for line in (twin_gap.conclude_gap(gap), *gap.notes):
        say(line)
    return 0


def _read_logs(paths: Sequence[Path]) -> list[tuple[str, Recording]]:
    """Read recordings. ConfigError if a recording can't be read, or is named twice."""
    from acsar_gym.recording import read

    if not paths:
        raise ConfigError("no recording is named: make one with --record FILE")
    logs = [(path.name, read(path)) for path in paths]
    names: dict[str, str] = {}
    for name, log in logs:
        created = str(log.header["created"])
        if created in names:
            raise ConfigError(f"{name}: is the same recording as {names[created]}")
        names[created] = name
    return logs
