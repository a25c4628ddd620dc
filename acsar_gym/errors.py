"""One tree of errors. Every message says what happened, where, and what to do next."""

from __future__ import annotations

import difflib
import re
import reprlib
from collections.abc import Iterable


class AcsarError(Exception):
    """Base of every error this package raises on purpose.

    `exit_code` is what the command line ends with, so that scripts can tell them apart.
    """

    exit_code = 1


class ConfigError(AcsarError):
    """A parameter, option, file or name that can't be used as given."""

    exit_code = 2


class WorldError(ConfigError):
    """A world that is broken, can't be crossed, or has its start inside an obstacle."""


class CommandError(AcsarError):
    """A wheel speed, twist or action that must not be sent to a robot, such as NaN."""

    exit_code = 2


class MissingExtraError(AcsarError):
    """A feature whose optional dependency isn't installed."""

    exit_code = 2

    def __init__(self, feature: str, extra: str) -> None:
        super().__init__(f"{feature} needs an extra: pip install 'acsar_gym[{extra}]'")


class RenderError(AcsarError):
    """A picture that can't be drawn here: no display, or no camera behind this link."""

    exit_code = 2


class OffScreenWarning(UserWarning):
    """A window can't open here, so its pictures are drawn without being shown."""


class PolicyError(AcsarError):
    """A policy file that is missing, broken, or made for another observation."""

    exit_code = 2


class LinkError(AcsarError):
    """The other side of the wire can't be reached, or was lost.

    `found` says what happened and where, `fix` what to do; the message is both.
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
    """The device went away while it was in use."""


class SensorError(AcsarError):
    """What a sensor has read can't be in an observation: a wrong number of numbers, or NaN."""


class LidarError(LinkError):
    """The LiDAR can't be opened, isn't one, or has fallen silent."""


LONGEST = 1_000
"""Characters of a line that is printed."""
_UNPRINTABLE = re.compile(
    "[^\\x20-\\x7e\\xa1-\U0010ffff]|[\\u200e\\u200f\\u2028-\\u202e\\u2066-\\u2069]|[\\ud800-\\udfff]"
)
"""Control characters, what turns the direction of text, and halves of surrogate pairs."""


def shortened(text: str, most: int = LONGEST) -> str:
    """The text, cut off where it is long."""
    return text if len(text) <= most else f"{text[:most]}..."


def shown(value: object) -> str:
    """The value as in source code: on one line, and shortened where it is long."""
    try:
        return " ".join(reprlib.repr(value).split())
    except ValueError:  # Python refuses to print integers of thousands of digits
        return "a very long number"


def printable(text: str) -> str:
    """Text that others wrote, for a terminal: control characters as in source code, never long."""
    short = shortened(text)
    return _UNPRINTABLE.sub(lambda found: found[0].encode("unicode_escape").decode(), short)


class SafetyWarning(UserWarning):
    """A protection that a robot is driven without; the message says which, why, and what to do."""


def suggestion(name: str, known: Iterable[str]) -> str:
    """'; did you mean X?' for the nearest known name, or the list of known names."""
    names = sorted(known)
    near = difflib.get_close_matches(name, names, n=1, cutoff=0.5)
    return f"; did you mean {near[0]!r}?" if near else f"; known: {', '.join(names)}"
