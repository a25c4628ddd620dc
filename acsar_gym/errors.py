"""Exceptions and warnings. Every message reports what happened, where, and what to do next.

AcsarError
  ConfigError            a parameter, option, file or name
    WorldError
  CommandError           a speed that must not be sent
  LinkError              robot or LiDAR
    PortBusyError
    BoardSilentError
      BoardGarbledError
    LinkLostError, LidarError, WheelError, EmergencyStopError
  MissingExtraError, PolicyError
  LateTicksError, CancelledError

AcsarWarning
  SafetyWarning, RecordingWarning

Example:
    >>> from acsar_gym import RobotConfig, errors
    >>> try:
    ...     RobotConfig.preset("no_such_robot")
    ... except errors.ConfigError as error:
    ...     error.exit_code
    2
"""

from __future__ import annotations

import contextlib
import copyreg
import difflib
import errno
import os
import reprlib
from collections.abc import Callable, Iterable, Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

BUSY_HINT = "stop other programs, or put this one ahead of them with 'chrt --fifo 10 acsar-gym ...'"
"""What to do on a busy computer."""
MORE_FILES_ADVICE = "close some, or allow more with 'ulimit -n'"
"""What to do about too many open files."""
TOO_MANY_FILES = (errno.EMFILE, errno.ENFILE)
"""Numbers of such errors."""
_PACKAGE = f"{Path(__file__).parent}{os.sep}"


class AcsarError(Exception):
    """Base class of the exceptions that this package raises on purpose.

    Attributes:
        exit_code: Exit code of the command line.

    Example:
        >>> from acsar_gym import RobotConfig
        >>> from acsar_gym.errors import AcsarError
        >>> try:
        ...     RobotConfig(wheel_radius=-1.0)
        ... except AcsarError as error:
        ...     "wheel_radius" in str(error)
        True
    """

    exit_code = 1

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the message, because the constructors of subclasses take other arguments."""
        return copyreg.__newobj__, (type(self), *self.args), self.__dict__  # type: ignore[attr-defined]


class ConfigError(AcsarError):
    """A parameter, option, file, name or task can't be used as it is."""

    exit_code = 2


class WorldError(ConfigError):
    """A world is broken, can't be crossed, or has its start inside an obstacle."""


class CommandError(AcsarError):
    """A wheel speed, twist or action must not be sent to a robot, for example NaN."""

    exit_code = 2


class MissingExtraError(AcsarError):
    """A feature needs an optional dependency that isn't installed.

    Args:
        feature: What needs the dependency.
        extra: Name of the extra that installs it.
    """

    exit_code = 2

    def __init__(self, feature: str, extra: str) -> None:
        command = f"pip install --constraint constraints.txt '.[{extra}]'"
        super().__init__(f"{feature} needs an extra, in the checkout: {command}")


class PolicyError(AcsarError):
    """A policy file is missing, broken, or made for another observation."""

    exit_code = 2


class LateTicksError(AcsarError):
    """Too many ticks were late for the results to be valid."""

    exit_code = 4


class CancelledError(AcsarError):
    """The user cancelled before anything moved."""

    exit_code = 130


class LinkError(AcsarError):
    """The robot, its LiDAR or a cluster can't be reached, or the connection was lost.

    Args:
        found: What happened and where.
        fix: What to do. The message consists of both.
    """

    exit_code = 3
    fault = 5.0
    """The number of the class in info's `fault`, in which 0 means no fault."""

    def __init__(self, found: str, fix: str = "") -> None:
        super().__init__(f"{found}: {fix}" if fix else found)
        self.found = found
        self.fix = fix


class PortBusyError(LinkError):
    """Another process holds the serial device."""


class BoardSilentError(LinkError):
    """The port is open, but no valid feedback line arrives."""

    fault = 1.0


class BoardGarbledError(BoardSilentError):
    """Bytes arrive, but none of them form a valid line: most likely a wrong baud rate."""

    fault = 2.0


class LinkLostError(LinkError):
    """The device disappeared while it was in use."""

    fault = 3.0


class LidarError(LinkError):
    """The LiDAR can't be opened, isn't a LiDAR, or stopped answering."""

    fault = 4.0


class WheelError(LinkError):
    """A wheel is dead, blocked, reversed or swapped: its speed contradicts its commands.

    Args:
        found: What happened.
        fix: What to do.
        wheel: Name of the wheel, such as "front_left".
    """

    fault = 6.0

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


class AcsarWarning(UserWarning):
    """Something isn't as expected. The message contains its name and value."""


class SafetyWarning(AcsarWarning):
    """The robot is driven without a protection. The message names it and what to do."""


class RecordingWarning(AcsarWarning):
    """A recording isn't complete: writing it failed, or its file was cut."""


@contextlib.contextmanager
def require_extra(feature: str, extra: str) -> Iterator[None]:
    """Name the extra if an import inside the block fails.

    Raises:
        MissingExtraError: A module isn't installed.
    """
    try:
        yield
    except ImportError as error:
        raise MissingExtraError(feature, extra) from error


def check_extra(feature: str, extra: str, *modules: str) -> None:
    """Raise MissingExtraError if one of the modules isn't installed. Imports none of them."""
    for module in modules:
        try:
            spec = find_spec(module)
        except (ImportError, ValueError):
            spec = None
        if spec is None:
            raise MissingExtraError(feature, extra)


class TranslatedErrors:
    """Turn an exception of a user's code into an error that names the task or sensor and the line.

    An AcsarError passes, with the name as a note. It is a class, because every step enters several
    of these blocks, and those of `contextlib` take longer.

    Args:
        kind: Class of the error.
        source: Returns the name of the task or sensor.

    Raises:
        AcsarError: An error of that class.
    """

    def __init__(self, kind: type[AcsarError], source: Callable[[], str]) -> None:
        self._kind = kind
        self._source = source

    def __enter__(self) -> None:
        """Nothing has to be prepared."""

    def __exit__(self, _kind: object, error: BaseException | None, _frames: object) -> None:
        """Translate the error, if there is one."""
        if isinstance(error, AcsarError):
            error.add_note(self._source())
            return
        if not isinstance(error, Exception):
            return
        import traceback  # noqa: PLC0415 - 'acsar-gym estop' starts without it

        # Name the last line in the user's own file, and not a line in a library that it calls.
        frames = traceback.extract_tb(error.__traceback__)
        users = [frame for frame in frames if not frame.filename.startswith(_PACKAGE)]
        message = format_error(error)
        if users:
            file = users[0].filename
            line = [frame.lineno for frame in users if frame.filename == file][-1]
            message = f"{users[0].name}() raised {message} ({file}:{line})"
        raise self._kind(f"{self._source()}: {message}") from error


def show_value(value: object) -> str:
    """Return a value's repr(), shortened and on one line."""
    try:
        # A value of a file may be a list of thousands.
        return " ".join(reprlib.repr(value).split())
    except ValueError:  # Python refuses to print integers of thousands of digits
        return "a very long number"


def explain_error(error: BaseException) -> str:
    """Return the message of an exception, shortened and on one line."""
    return getattr(error, "strerror", None) or " ".join(str(error).split())[:300]


def format_error(error: BaseException) -> str:
    """Return the class and the message of an exception, shortened and on one line."""
    return " ".join(f"{type(error).__name__}: {error}".split())[:300]


def escape_unprintable(text: str, limit: int = 1_000) -> str:
    """Return untrusted text made safe for a terminal: shortened, control characters escaped."""
    # Names come from bags, boards and maps, and may be of any length.
    if len(text) > limit:
        text = f"{text[:limit]}..."
    if text.isprintable():
        return text
    characters = (c if c.isprintable() else repr(c)[1:-1] for c in text)
    return "".join(characters)


def suggest_name(name: str, known: Iterable[str]) -> str:
    """Return the end of an error message about an unknown name.

    It suggests the most similar name, or lists all names if none is similar.
    """
    names = sorted(known)
    # A lower cutoff suggests names that share only a few letters.
    similar = difflib.get_close_matches(name, names, n=1, cutoff=0.5)
    return f"; did you mean {similar[0]!r}?" if similar else f"; known: {', '.join(names)}"
