"""Options that several commands share, their output, and the countdown before wheels turn."""

from __future__ import annotations

import contextlib
import os
import select
import shlex
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from acsar_gym.errors import CancelledError, ConfigError, escape_unprintable, require_extra
from acsar_gym.reading import COMMAND, check_replaceable, describe_origin
from acsar_gym.streams import print_error

if TYPE_CHECKING:
    from rich.table import Table

    from acsar_gym.recording import Recorder

COUNTDOWN = 3.0
"""Usual length of a countdown [s]."""
File = Annotated[Path | None, tyro.conf.arg(metavar="FILE")]
Seconds = Annotated[float | None, tyro.conf.arg(metavar="SECONDS")]
Count = Annotated[int | None, tyro.conf.arg(metavar="N")]
Names = Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME [NAME ...]")]
Worlds = Annotated[tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="KIND|PATH")]
"""Worlds of one or several sets: the option may be repeated."""
Source = Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="KIND|PATH")]
LidarArg = Annotated[str | None, tyro.conf.arg(metavar="URL")]
EnvArg = Annotated[str, tyro.conf.arg(metavar="NAME|ID")]
RobotArg = Annotated[str | None, tyro.conf.arg(metavar="PRESET|FILE")]
Goal = Annotated[tuple[float, float] | None, tyro.conf.arg(metavar="X Y")]
GoalDistance = Annotated[tuple[float, float] | None, tyro.conf.arg(metavar="NEAREST FARTHEST")]
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


def say(text: str) -> None:
    """Print a line at once, with control characters escaped."""
    print(escape_unprintable(text), flush=True)


def check_writable(*paths: Path | None, robot: Path | None = None, mark: str | None = None) -> None:
    """Check before the work that results can be written, and replace no file of other programs.

    Args:
        *paths: Files of results.
        robot: A robot's file, which is changed in place.
        mark: As for `reading.check_replaceable`.
    """
    from acsar_gym.config import RobotConfig, saving
    from acsar_gym.tools.evaluation import report

    # A robot's file is changed in place, so it needn't be this command's.
    if robot is not None:
        saving.check_target(robot, RobotConfig)
    for path in (*paths, robot):
        report.check_writable(path)
    for path in filter(None, paths):
        check_replaceable(path, mark)


@dataclass(frozen=True)
class ResultOptions:
    """Results in a file."""

    json: File = None
    """Also write the figures to this file."""

    def check(self) -> None:
        """Check before the work that the files can be written, as `check_writable` does."""
        check_writable(self.json)

    def print(self, *tables: Table, data: Mapping[str, Any]) -> None:
        """Print tables, and write the figures to the JSON file, if one is named."""
        from acsar_gym.tools.evaluation import report

        try:
            report.print_tables(*tables)
        finally:  # also if nothing reads the tables
            if self.json is not None:
                report.write_json(self.json, {"origin": describe_origin(), **data})


def check_page(path: Path | None) -> None:
    """Check before the work that an HTML page can be made, if one is named."""
    check_writable(path)
    if path is not None:
        from acsar_gym.tools.page import check_report_extra

        check_report_extra()


def check_stoppable(link: str) -> None:
    """Raise LinkError if 'acsar-gym estop' couldn't stop a real robot."""
    from acsar_gym.guard.estop import check_available
    from acsar_gym.links.factory import is_device

    if is_device(link):
        check_available(link)


def countdown(what: str, seconds: float = COUNTDOWN, *, yes: bool = False) -> None:
    """Announce what is about to move, and count down. Any key cancels."""
    if yes:
        return
    # Without a terminal no key could cancel.
    if not sys.stdin.isatty():
        raise ConfigError(f"{what}: no terminal to ask on; add --yes if that is safe")
    say(f"{what}. Any key cancels.")
    with _single_keys() as is_pressed:
        while seconds > 0.0:
            print(f"\r{seconds:.0f} ", end="", flush=True)
            if is_pressed(min(seconds, 1.0)):
                raise CancelledError("cancelled by a key; nothing has moved")
            seconds -= 1.0


@contextlib.contextmanager
def _single_keys() -> Iterator[Callable[[float], bool]]:
    """Read single keys, also if the output is piped into a file.

    Yields:
        A function that waits for a key, at most for a time [s]. Whether there was a key.
    """
    try:
        import termios
        import tty
    except ImportError:
        yield _wait_for_windows_key
        return
    number = sys.stdin.fileno()
    settings = termios.tcgetattr(number)
    try:
        tty.setcbreak(number, termios.TCSANOW)
        yield lambda wait: bool(select.select([number], [], [], wait)[0])
    finally:
        termios.tcsetattr(number, termios.TCSAFLUSH, settings)  # the key isn't for the shell
        print(flush=True)


def _wait_for_windows_key(seconds: float) -> bool:
    """Wait for a key on Windows. Returns whether there was a key."""
    import msvcrt

    # Looked up by name, because type checkers on other systems don't know it.
    is_pressed: Callable[[], bool] = getattr(msvcrt, "kbhit")  # noqa: B009
    deadline = time.monotonic() + seconds
    while not is_pressed() and time.monotonic() < deadline:
        time.sleep(0.02)
    return is_pressed()


@dataclass(frozen=True)
class RecordOptions:
    """Recording and viewer."""

    record: File = None
    """Record to this MCAP file. An older recording is kept, as FILE.1.mcap."""
    view: bool = False
    """Show the drive in Rerun's viewer."""

    def recorder(self, **about: Any) -> Recorder | None:
        """Make the recorder for `record` and `view`. None if neither was given."""
        if self.record is None and not self.view:
            return None
        from acsar_gym.recording import Recorder
        from acsar_gym.recording.writer import check_target

        # The recorder opens its file later, so a wrong path is refused here.
        sinks = []
        if self.record is not None:
            check_target(self.record)
        if self.view:
            os.environ.setdefault("RUST_LOG", "off")  # Rerun would report a viewer that was closed
            with require_extra("the viewer", "view"):
                from acsar_gym.tools.view import show
            sinks.append(show.show_live())
        recorder = Recorder(self.record, {"command": COMMAND.get(), **about}, sinks=sinks)
        _recorders.append(recorder)
        return recorder


_recorders: list[Recorder] = []
"""The recorders of this command."""


def report_broken() -> bool:
    """Report recordings of this command that aren't complete. Returns whether there are any."""
    broken = [recorder.path or "viewer" for recorder in _recorders if recorder.problem is not None]
    _recorders.clear()
    for name in broken:
        print_error(escape_unprintable(f"acsar-gym: {name}: the recording isn't whole"))
    return bool(broken)


@dataclass(frozen=True)
class BagOptions:
    """If a recording is a ROS 2 bag: an MCAP file, a .db3 file, or a folder of rosbag2."""

    topics: Annotated[tuple[str, ...], tyro.conf.arg(metavar="TOPIC [TOPIC ...]")] = ()
    """Topics of the bag that are used, or namespaces, such as /robot1. Default: all."""

    def open(self, path: Path, robot: str | None) -> Path:
        """Return the recording, which is made of the bag if it is one. See `recording.bags`."""
        from acsar_gym.config import RobotConfig
        from acsar_gym.recording.bags import open_recording

        return open_recording(path, None if robot is None else RobotConfig.of(robot), self.topics)
