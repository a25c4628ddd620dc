"""The command `identify`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from acsar_gym.config import RobotConfig
from acsar_gym.errors import BUSY_HINT, ConfigError
from acsar_gym.streams import print_error
from acsar_gym.tools.cli.commands import command
from acsar_gym.tools.cli.options import (
    BagOptions,
    File,
    RecordOptions,
    RobotArg,
    check_stoppable,
    check_writable,
    countdown,
    print_results,
    say,
)

if TYPE_CHECKING:
    from acsar_gym.tools.sysid.identify import Identification

Sources = Annotated[
    tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="DEVICE | LOG [LOG ...]")
]
DURATION = 20.0
"""Usual duration of the manoeuvre [s]."""
LATE_MANOEUVRE = 1.1
"""A manoeuvre that takes longer than this, as a share of its length, is worth a warning."""


@dataclass(frozen=True)
class FoundRobotOptions(RecordOptions):
    """The robot of which something is found, and recording."""

    robot: RobotArg = None
    """Preset or config file with what is known. Default: that of the recording, or acsar."""
    twin: RobotArg = None
    """Simulation: the robot that is driven, a hidden robot to be found."""

    def driven(self, config: RobotConfig, device: str) -> RobotConfig:
        """Return the robot that is driven, which is the twin in a simulation that has one."""
        if self.twin is None:
            return config
        from acsar_gym.physics.bodies import BODIES

        if device not in BODIES:
            raise ConfigError(f"--twin is for simulated robots: {' or '.join(BODIES)}")
        return RobotConfig.of(self.twin)

    def check_recorded(self, *, has_duration: bool = False) -> None:
        """Refuse options for driving a robot, because recordings are read."""
        options = {"twin": self.twin, "record": self.record, "duration": has_duration}
        for name, value in options.items():
            if value:
                raise ConfigError(f"--{name} is for driving a robot; recordings are only read")


@dataclass(frozen=True)
class FoundRobotOutputs:
    """Results."""

    out: File = None
    """Write what was found into this robot's file, to be used as --robot. If it exists, its
    comments stay, and what was not found."""
    json: File = None
    """Also write the findings to this file."""

    def write(self, robot: RobotConfig) -> None:
        """Write a robot to `out`, if a file is named."""
        if self.out is not None:
            robot.save(self.out)
            say(f"written: {self.out}; use it with --robot {self.out}")


@command("identify", drives=True)
def identify_robot(
    sources: Sources,
    setup: FoundRobotOptions,
    output: FoundRobotOutputs,
    bag: BagOptions,
    logs: Annotated[tuple[str, ...], tyro.conf.arg(name="from", metavar="LOG [LOG ...]")] = (),
    duration: float = DURATION,
    yes: bool = False,
    anyway: bool = False,
) -> int:
    """Find how motors and board respond, by the wire only, and write it to a robot's file.

    With a device, the wheels turn for 20 s with steps, slow staircases and a pause without
    commands: lift the robot! With recordings, all their drives are used. A parameter that the log
    doesn't narrow keeps its value, and the table names the missing manoeuvre. If the model of
    motors and board doesn't describe what was recorded, a file is written only with --anyway.

    Args:
        sources: Serial device, planar, bullet, mujoco, or recordings of one robot, made with
            --record, or ROS 2 bags of it.
        setup: Robot and recording.
        output: Results.
        bag: Options of ROS 2 bags.
        logs: Recordings or ROS 2 bags, instead of a device.
        duration: Duration of the manoeuvre [s].
        yes: Don't ask before the wheels turn.
        anyway: Write the file even if the model doesn't fit: without intervals, and with a remark.
    """
    from acsar_gym.tools.sysid import identify

    check_writable(output.json, robot=output.out)
    if recordings := _list_logs(sources, logs):
        setup.check_recorded(has_duration=duration != DURATION)
        known = None if setup.robot is None else RobotConfig.of(setup.robot)
        paths = [bag.open(path, setup.robot) for path in recordings]
        result = identify.identify_files(paths, known)
    else:
        result = _drive_and_identify(sources[0], setup, duration, yes=yes)

    print_results(identify.identification_table(result), json=output.json, data=result.as_dict())
    result.check(anyway=anyway)
    if result.dead:
        names = ", ".join(result.dead)
        say(f"{names} never turned: nothing of it was found; check motor and encoder")
    if output.out is not None:
        robot = result.robot()
        output.write(robot)
        if robot.misfit:
            say(robot.misfit)
    return 0


def _drive_and_identify(
    device: str, setup: FoundRobotOptions, duration: float, *, yes: bool
) -> Identification:
    from acsar_gym.links import open_link
    from acsar_gym.tools.sysid import identify

    config = RobotConfig.of(setup.robot)
    link = open_link(device, setup.driven(config, device))
    if link.is_real:
        check_stoppable(device)
        what = f"{device}: the wheels will turn for {duration:g} s in both directions"
        countdown(f"{what}; lift the robot, so that they turn freely", yes=yes)

    result = identify.identify_device(link, config, duration, setup.recorder("identify"))
    if result.duration > LATE_MANOEUVRE * duration:
        print_error(
            f"acsar-gym: the manoeuvre took {result.duration:.1f} s instead of {duration:g}: this "
            f"computer was late, and the figures are worse for it; {BUSY_HINT}, and drive again"
        )
    return result


def _list_logs(sources: Sequence[str], logs: Sequence[str]) -> list[Path]:
    """List the recordings and bags that are named. Empty if a device is named."""
    if logs and sources:
        raise ConfigError("--from: give a device, or recordings with --from, not both")
    paths = [Path(source) for source in (*sources, *logs)]
    if not paths:
        raise ConfigError("identify needs a device, or recordings made with --record")
    are_files = [
        path.suffix in (".mcap", ".db3") or path.is_file() or path.is_dir() for path in paths
    ]
    if not (logs or any(are_files) or len(sources) > 1):
        return []
    if not all(are_files):
        other = paths[are_files.index(False)]
        raise ConfigError(f"{other}: isn't a recording; give one device, or recordings only")
    return paths
