"""The command `acsar-gym estop`; imports nothing slow, so that it acts soon."""

from __future__ import annotations

import sys
import time

from acsar_gym.errors import LinkError, printable
from acsar_gym.safety import estop

NOBODY = "no robot is being driven from this computer"


def command(name: str = "", *, listing: bool = False, release: bool = False) -> int:
    """Run `acsar-gym estop`: stop robots, release them, or list who drives them.

    Args:
        name: as for `stop_all`.
        listing: only list.
        release: release instead of stopping.

    Returns:
        The exit code.
    """
    try:
        if listing:
            return _list()
        return _release(name) if release else _stop(name)
    except LinkError as error:
        print(f"acsar-gym: {printable(str(error))}", file=sys.stderr)
        return error.exit_code


def _stop(name: str) -> int:
    """Stop robots and print the results."""
    found = estop.stop_all(name)
    for each in found:
        if not each.answered:
            said = "doesn't answer: its watchdog stops wheels that turn, and it stops when it hears"
        elif each.connected:
            said = "stopped"
        else:
            said = "isn't connected to its robot, and won't drive it when it is"
        print(f"process {each.process}: {said}")
    if not found:
        _say_nobody(name)
    return 0 if found and all(each.answered for each in found) else 1


def _release(name: str) -> int:
    """Release robots and print the results."""
    found = estop.release_all(name)
    for each in found:
        said = "released: it drives after its next reset" if each.was_stopped else "wasn't stopped"
        said = said if each.answered else "doesn't answer: it is released when it hears"
        print(f"process {each.process}: {said}")
    if not found:
        _say_nobody(name)
    return 0 if found and all(each.answered for each in found) else 1


def _say_nobody(name: str) -> None:
    """Print that nobody drives a robot, or nobody the one of this name."""
    if name and estop.drivers():
        print(f"no robot {printable(name)} is being driven from this computer; these are:")
        _list()
    else:
        print(NOBODY)


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
    """Run `acsar-gym estop` with a name, --list or --release; None for other arguments.

    Args:
        arguments: of the command line, without "estop".
    """
    options = [each for each in arguments if each.startswith("-")]
    names = [each for each in arguments if not each.startswith("-")]
    if len(names) > 1 or options not in ([], ["--list"], ["--release"]):
        return None
    if options == ["--list"] and names:
        return None
    return command(*names, listing="--list" in options, release="--release" in options)
