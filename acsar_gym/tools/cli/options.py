"""Options that several commands share, their output, and the countdown before wheels turn."""

from __future__ import annotations

import contextlib
import os
import select
import shlex
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from acsar_gym.errors import (
    CancelledError,
    ConfigError,
    LinkError,
    escape_unprintable,
    require_extra,
)
from acsar_gym.reading import check_replaceable, describe_origin
from acsar_gym.streams import print_error

if TYPE_CHECKING:
    from rich.table import Table

    from acsar_gym.recording import Recorder

COUNTDOWN = 3.0
"""Usual length of a countdown [s]."""

File = Annotated[Path | None, tyro.conf.arg(metavar="FILE")]
Seconds = Annotated[float | None, tyro.conf.arg(metavar="SECONDS")]
OutFile = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]
WorldName = Annotated[str | None, tyro.conf.arg(metavar="KIND|PATH")]
Worlds = Annotated[tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="KIND|PATH")]
"""Worlds of one or several sets: the option may be repeated."""
LidarArg = Annotated[str | None, tyro.conf.arg(metavar="URL")]
EnvArg = Annotated[str, tyro.conf.arg(metavar="NAME|ID")]
Force = Annotated[bool, tyro.conf.arg(help="Replace files that this command didn't write, too.")]
RobotArg = Annotated[str | None, tyro.conf.arg(metavar="PRESET|FILE")]
RosArgs = Annotated[
    tuple[str, ...],
    tyro.constructors.PrimitiveConstructorSpec(
        nargs=1,
        metavar="ARGUMENT [ARGUMENT ...]",
        instance_from_str=lambda words: tuple(shlex.split(words[0])),
        is_instance=lambda value: isinstance(value, tuple),
        str_from_instance=lambda value: [shlex.join(value)],
    ),
]
"""Arguments of ROS, which `app.join_ros_arguments` has joined to one word."""


@dataclass(frozen=True)
class WorldFileOptions:
    """What a Gazebo world or a ROS map doesn't say."""

    start: Annotated[str | None, tyro.conf.arg(metavar="X,Y,THETA")] = None
    """Where the robot starts in a world of a file [m, rad], as in --start -2,3,1.57; without theta
    it faces any way."""
    goal: Annotated[str | None, tyro.conf.arg(metavar="X,Y")] = None
    """Where the goal is in a world of a file [m]."""

    def place(self, *worlds: str) -> Any:
        """Return what an env takes as `worlds=`: the names alone, or a file with these options."""
        from acsar_gym.worlds.sets import place_worlds  # noqa: PLC0415

        return place_worlds(worlds, self.start, self.goal)


def say(text: str) -> None:
    """Print a line at once, with control characters escaped."""
    print(escape_unprintable(text), flush=True)


def print_results(
    *tables: Table, json: Path | None = None, data: Mapping[str, Any] | None = None
) -> None:
    """Print tables, and write the figures to a JSON file, if one is named."""
    from acsar_gym.tools.evaluation import report  # noqa: PLC0415

    try:
        report.print_tables(*tables)
    finally:  # also where nobody reads the tables
        if json is not None:
            report.write_json(json, {"origin": describe_origin(), **(data or {})})


def check_writable(
    *paths: Path | None, robot: Path | None = None, force: bool = False, mark: str | None = None
) -> None:
    """Check before the work that results can be written, and replace nothing that others wrote."""
    from acsar_gym.config import RobotConfig, saving  # noqa: PLC0415
    from acsar_gym.tools.evaluation import report  # noqa: PLC0415

    if robot is not None:
        saving.check_target(robot, RobotConfig, force=force)
        report.check_writable(robot)
    for path in filter(None, paths):
        report.check_writable(path)
        check_replaceable(path, mark, force=force)


@dataclass(frozen=True)
class ResultOptions:
    """Results in a file."""

    json: File = None
    """Also write the figures to this file."""
    force: Force = False

    def check(self) -> None:
        """Check before the work as `check_writable` does."""
        check_writable(self.json, force=self.force)


@dataclass(frozen=True)
class PageOptions(ResultOptions):
    """Results in files."""

    html: File = None
    """Also write an HTML page with tables and plots."""

    def check(self) -> None:
        """Check before the work as `check_writable` does, and that a page can be made."""
        super().check()
        check_writable(self.html, force=self.force)
        if self.html is not None:
            from acsar_gym.tools.page import check_report_extra  # noqa: PLC0415

            check_report_extra()


def countdown(what: str, seconds: float = COUNTDOWN, *, yes: bool = False) -> None:
    """Say what is about to move, and count down; any key ends it."""
    if yes:
        return
    if not sys.stdin.isatty():
        raise ConfigError(f"{what}: no terminal to ask on; add --yes if that is safe")
    say(f"{what}. Any key cancels.")
    with _single_keys() as pressed:
        while seconds > 0.0:
            print(f"\r{seconds:.0f} ", end="", flush=True)
            if pressed(min(seconds, 1.0)):
                raise CancelledError("cancelled by a key; nothing has moved")
            seconds -= 1.0


@contextlib.contextmanager
def _single_keys() -> Iterator[Callable[[float], bool]]:
    """Read single keys; yields a function that waits so long [s] and says whether one came.

    Whether standard output is a terminal doesn't matter: it may be piped into a file.
    """
    try:
        import termios  # noqa: PLC0415
        import tty  # noqa: PLC0415
    except ImportError:
        yield _windows_key
        return
    number = sys.stdin.fileno()
    before = termios.tcgetattr(number)
    try:
        tty.setcbreak(number, termios.TCSANOW)
        yield lambda wait: bool(select.select([number], [], [], wait)[0])
    finally:
        termios.tcsetattr(number, termios.TCSAFLUSH, before)  # the key isn't for the shell
        print(flush=True)


def _windows_key(wait: float) -> bool:
    """Wait for a key on Windows [s]."""
    import msvcrt  # noqa: PLC0415

    pressed: Callable[[], bool] = getattr(msvcrt, "kbhit")  # noqa: B009 - unknown on Linux
    deadline = time.monotonic() + wait
    while not pressed() and time.monotonic() < deadline:
        time.sleep(0.02)
    return pressed()


@dataclass(frozen=True)
class RecordOptions:
    """Recording of what the robot does."""

    record: File = None
    """Record to this MCAP file, for ROS 2, Foxglove and --link replay:FILE; an older recording of
    that name is kept, as FILE.1.mcap."""

    view: bool = False
    """Show the drive in Rerun's viewer while it goes on."""

    def recorder(self, command: str, **about: Any) -> Recorder | None:
        """Make the recorder for `record` and `view`; None if neither was given."""
        if self.record is None and not self.view:
            return None
        from acsar_gym.recording import Recorder  # noqa: PLC0415
        from acsar_gym.recording.writer import check_target  # noqa: PLC0415

        sinks = []
        if self.record is not None:
            check_target(self.record)
        if self.view:
            os.environ.setdefault("RUST_LOG", "off")  # Rerun would report a viewer that was closed
            with require_extra("the viewer", "view"):
                from acsar_gym.tools.view import show  # noqa: PLC0415
            sinks.append(show.show_live())
        made = Recorder(self.record, {"command": command, **about}, sinks=sinks)
        _command_recorders.append(made)
        return made


@dataclass(frozen=True)
class BagOptions:
    """Where a recording is a ROS 2 bag: an MCAP file, a .db3 file, or a folder of rosbag2."""

    topics: Annotated[tuple[str, ...], tyro.conf.arg(metavar="TOPIC [TOPIC ...]")] = ()
    """Topics of the bag that are used, or namespaces, such as /robot1; default: all."""

    def open(self, path: Path, robot: str | None) -> Path:
        """Return the recording, made of the bag where it is one; see `recording.bags`."""
        from acsar_gym.config import RobotConfig  # noqa: PLC0415
        from acsar_gym.recording.bags import open_recording  # noqa: PLC0415

        return open_recording(path, None if robot is None else RobotConfig.of(robot), self.topics)


def check_not_given(options: Iterable[tuple[str, Any]]) -> None:
    """Check options that are only for driving, where recordings are read."""
    for option, value in options:
        if value:
            raise ConfigError(f"{option} is for driving a robot; recordings are only read")


_command_recorders: list[Recorder] = []
"""The recorders of this command."""


def report_broken() -> bool:
    """Tell on stderr which recordings of this command aren't whole; whether there are any."""
    broken = [recorder.path for recorder in _command_recorders if recorder.problem is not None]
    _command_recorders.clear()
    for name in broken:
        print_error(escape_unprintable(f"acsar-gym: {name}: the recording isn't whole"))
    return bool(broken)


@dataclass(frozen=True)
class HostOptions:
    """Process priority and cores, and whether the emergency stop may be missing."""

    realtime: Annotated[int | None, tyro.conf.arg(metavar="PRIORITY")] = None
    """Real-time priority (SCHED_FIFO), 1 to 98."""
    cores: Annotated[tuple[int, ...] | None, tyro.conf.arg(metavar="N [N ...]")] = None
    """Numbers of the cores to run on."""
    without_estop: bool = False
    """Drive real wheels even where 'acsar-gym estop' couldn't stop them."""

    def prepare(self, drives: str | None = None) -> None:
        """Set priority and cores, and check that a real robot can be stopped."""
        from acsar_gym.guard.estop import check_available  # noqa: PLC0415
        from acsar_gym.links.factory import is_device  # noqa: PLC0415
        from acsar_gym.tools.commission import host  # noqa: PLC0415

        if drives is not None and not self.without_estop and is_device(drives):
            try:
                check_available(drives)
            except LinkError as error:
                fix = f"{error.fix}; or drive without an emergency stop: --without-estop"
                raise LinkError(error.found, fix) from error
        host.prepare_realtime(self.realtime, self.cores)
