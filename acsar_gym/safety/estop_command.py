"""The command `acsar-gym estop`; imports nothing slow, so that it acts soon."""

from __future__ import annotations

import sys
import time

from acsar_gym.errors import LinkError, printable
from acsar_gym.safety import estop

NOBODY = "no robot is being driven from this computer"


def command(name: str = "", *, listing: bool = False) -> int:
    """Run `acsar-gym estop`: stop robots, or list who drives them; prints and returns exit code.

    Args:
        name: as for `stop_all`.
        listing: only list.
    """
    try:
        return _list() if listing else _stop(name)
    except LinkError as error:
        print(f"acsar-gym: {printable(str(error))}", file=sys.stderr)
        return error.exit_code


def _stop(name: str) -> int:
    """Stop robots and print the results."""
    found = estop.stop_all(name)
    for each in found:
        said = "stopped" if each.answered else "doesn't answer: its watchdog stops it"
        print(f"process {each.process}: {said}")
    if not found and name and estop.drivers():
        print(f"no robot {printable(name)} is being driven from this computer; these are:")
        _list()
    elif not found:
        print(NOBODY)
    return 0 if found and all(each.answered for each in found) else 1


def _list() -> int:
    """Print who drives a robot; exit code 1 where nobody does."""
    found = estop.drivers()
    for each in found:
        since = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(each.since))
        robot = each.device or "doesn't answer"
        called = f" ({printable(each.name)})" if each.name else ""
        print(f"{printable(robot)}{called}: process {each.process}, since {since}")
    if not found:
        print(NOBODY)
    return 0 if found else 1


def main(arguments: list[str]) -> int | None:
    """Run `acsar-gym estop` with these arguments; None for those that aren't a name or --list."""
    names = [each for each in arguments if not each.startswith("-")]
    listing = arguments == ["--list"]
    if len(names) > 1 or (names != arguments and not listing):
        return None
    return command(*names, listing=listing)
