"""Exceptions and warnings. Every message says what happened, where, and what to do next.

AcsarError
  ConfigError                a parameter, option, file or name
    WorldError, TaskError
  CommandError               a speed that must not be sent
  LinkError                  robot or LiDAR
    PortNotFoundError, PortPermissionError, PortBusyError
    BoardSilentError
      BoardGarbledError
    LinkLostError, LidarError, WheelError, EmergencyStopError
  SensorError, PolicyError, RenderError, MissingExtraError
  IdentificationError, LateTicksError, CancelledError
  JobError, ClusterError
"""

from __future__ import annotations

import contextlib
import copyreg
import difflib
import os
import re
import reprlib
from collections.abc import Callable, Iterable, Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

BUSY_HINT = "stop other programs, or put the control loop ahead of them with --realtime 10"
"""What to do on a busy computer."""
MORE_FILES_ADVICE = "close some, or allow more with 'ulimit -n'"  # for too many open files


class AcsarError(Exception):
    """Base class of the exceptions that this package raises on purpose.

    Attributes:
        exit_code: exit code of the command line.
    """

    exit_code = 1

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle it with its message, as constructors may take other arguments."""
        return copyreg.__newobj__, (type(self), *self.args), self.__dict__  # type: ignore[attr-defined]


class ConfigError(AcsarError):
    """A parameter, option, file or name that can't be used as given."""

    exit_code = 2


class WorldError(ConfigError):
    """A world is broken, can't be crossed, or has its start inside an obstacle."""


class TaskError(ConfigError):
    """A task's method raised an error, or returned what can't be used, such as NaN."""


class CommandError(AcsarError):
    """A wheel speed, twist or action that must not be sent to a robot, such as NaN."""

    exit_code = 2


class IdentificationError(AcsarError):
    """A log that doesn't say how a robot's motors answer, or says that it is miswired."""


class CancelledError(AcsarError):
    """The user cancelled before anything moved."""

    exit_code = 130


class MissingExtraError(AcsarError):
    """A feature whose optional dependency isn't installed.

    Args:
        feature: what needs it.
        extra: name of the extra that installs it.
    """

    exit_code = 2

    def __init__(self, feature: str, extra: str) -> None:
        super().__init__(f"{feature} needs an extra: pip install 'acsar_gym[{extra}]'")


@contextlib.contextmanager
def require_extra(feature: str, extra: str) -> Iterator[None]:
    """Name the extra where an import inside the block fails.

    Raises:
        MissingExtraError: a module isn't installed.
    """
    try:
        yield
    except ImportError as error:
        raise MissingExtraError(feature, extra) from error


def check_extra(feature: str, extra: str, *modules: str) -> None:
    """Raise MissingExtraError where modules aren't installed; imports none of them."""
    for module in modules:
        try:
            is_missing = find_spec(module) is None
        except (ImportError, ValueError):
            is_missing = True
        if is_missing:
            raise MissingExtraError(feature, extra)


class JobError(AcsarError):
    """A job ended every process that ran it, or failed unexpectedly in another process."""


class ClusterError(AcsarError):
    """No Ray cluster answers, or its machines can't run the jobs.

    Args:
        found: what happened and where.
        fix: what to do.
    """

    exit_code = 3

    def __init__(self, found: str, fix: str) -> None:
        super().__init__(f"{found}: {fix}")


class RenderError(AcsarError):
    """A picture can't be drawn: there is no display, or this link has no camera."""

    exit_code = 2


class OffScreenWarning(UserWarning):
    """No window can be opened, so pictures are drawn but not displayed."""


class PolicyError(AcsarError):
    """A policy file that is missing, broken, or made for another observation."""

    exit_code = 2


class LinkError(AcsarError):
    """The robot or its LiDAR can't be reached, or the connection was lost.

    Args:
        found: what happened and where.
        fix: what to do; the message consists of both.
    """

    exit_code = 3

    def __init__(self, found: str, fix: str = "") -> None:
        super().__init__(f"{found}: {fix}" if fix else found)
        self.found = found
        self.fix = fix


class PortNotFoundError(LinkError):
    """There is no such serial device."""


class PortPermissionError(LinkError):
    """The user may not open the serial device."""


class PortBusyError(LinkError):
    """Another process holds the serial device."""


class BoardSilentError(LinkError):
    """The port is open, but no valid feedback line arrives."""


class BoardGarbledError(BoardSilentError):
    """Bytes arrive, but none of them form a valid line: most likely a wrong baud rate."""


class LinkLostError(LinkError):
    """The device disappeared while it was in use."""


class WheelError(LinkError):
    """A wheel is dead, blocked, reversed or swapped: its speed contradicts its commands.

    Args:
        found: what happened.
        fix: what to do.
        wheel: name of the wheel, such as "front_left".
    """

    def __init__(self, found: str, fix: str, wheel: str) -> None:
        super().__init__(found, fix)
        self.wheel = wheel


class EmergencyStopError(LinkError):
    """An emergency stop ended what the program was doing, or holds until it is released."""

    def __init__(self) -> None:
        super().__init__(
            "emergency stop",
            "look after the robot, then start again, or run 'acsar-gym estop --release'",
        )


class LateTicksError(AcsarError):
    """Episodes whose figures tell about the computer: too many of their ticks were late.

    Args:
        invalid: number of such episodes.
        episodes: number of all.
    """

    exit_code = 4

    def __init__(self, invalid: int, episodes: int) -> None:
        super().__init__(
            f"too many late ticks in {invalid} of {episodes} episodes: {BUSY_HINT}, or allow a "
            "larger --late-share"
        )


class SensorError(AcsarError):
    """A sensor raised an error, or its reading can't be used: wrong size, or NaN."""


_PACKAGE = f"{Path(__file__).parent}{os.sep}"


@contextlib.contextmanager
def translate_errors(kind: type[AcsarError], source: Callable[[], str]) -> Iterator[None]:
    """Name the task or sensor whose code raises inside the block, and the line that raised.

    Errors of this package pass, with the name as a note.

    Raises:
        AcsarError: of that kind.
    """
    try:
        yield
    except AcsarError as error:
        error.add_note(source())
        raise
    except Exception as error:
        import traceback  # noqa: PLC0415 - 'acsar-gym estop' starts without it

        calls = [(f.f_code, line) for f, line in traceback.walk_tb(error.__traceback__)]
        theirs = [call for call in calls if not call[0].co_filename.startswith(_PACKAGE)] or calls
        # The last line in the user's own file, not the one in a library that it calls.
        method, file = theirs[0][0].co_name, theirs[0][0].co_filename
        line = [line for code, line in theirs if code.co_filename == file][-1]
        said = shorten_text(" ".join(f"{type(error).__name__}: {error}".split()), 300)
        raise kind(f"{source()}: {method}() raised {said} ({file}:{line})") from error


class LidarError(LinkError):
    """The LiDAR can't be opened, isn't a LiDAR, or stopped answering."""


MAX_PRINTED = 1_000  # longest line that is printed [characters]
_UNPRINTABLE = re.compile(
    "[^\\x20-\\x7e\\xa1-\U0010ffff]|[\\u200e\\u200f\\u2028-\\u202e\\u2066-\\u2069]|[\\ud800-\\udfff]"
)
"""Control characters, bidirectional text controls, and unpaired surrogates."""


def shorten_text(text: str, most: int = MAX_PRINTED) -> str:
    """Return text, cut to `most` characters with "..." at the end."""
    return text if len(text) <= most else f"{text[:most]}..."


def show_value(value: object) -> str:
    """Return a value's repr(), shortened and on one line."""
    try:
        return " ".join(reprlib.repr(value).split())
    except ValueError:  # Python refuses to print integers of thousands of digits
        return "a very long number"


def escape_unprintable(text: str) -> str:
    """Return untrusted text made safe for a terminal: shortened, control characters escaped."""
    short = shorten_text(text)
    return _UNPRINTABLE.sub(lambda found: found[0].encode("unicode_escape").decode(), short)


class SafetyWarning(UserWarning):
    """The robot is driven without a protection; the message says which one and what to do."""


class WorldWarning(UserWarning):
    """Something in a world's file is otherwise here, such as a moving obstacle, which stands."""


class TaskWarning(UserWarning):
    """A task observed a number beyond the bounds that it declares; said once by each env."""


class PolicyWarning(UserWarning):
    """A policy drives a robot unlike those of its training; the message names the value."""


class RecordingWarning(UserWarning):
    """A recording isn't whole: it can't be written any more, or its file was cut."""


def suggest_name(name: str, known: Iterable[str]) -> str:
    """Suggest a name for an unknown one, for the end of an error message.

    Returns:
        "; did you mean X?" with the most similar name, or "; known: ..." with all of them.
    """
    names = sorted(known)
    near = difflib.get_close_matches(name, names, n=1, cutoff=0.5)
    return f"; did you mean {near[0]!r}?" if near else f"; known: {', '.join(names)}"
