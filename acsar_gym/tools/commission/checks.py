"""Results of diagnostic checks, and the checks of this computer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from rich.table import Column, Table

from acsar_gym.errors import LinkError
from acsar_gym.guard.estop import try_listening
from acsar_gym.links.ports import find_ports

STATUS_MARKS = {
    "ok": "[green]ok[/]",
    "warn": "[yellow]warn[/]",
    "fail": "[red]FAIL[/]",
    "skip": "[dim]skip[/]",
}


@dataclass(frozen=True, slots=True)
class Check:
    """Result of one check.

    Attributes:
        name: What was checked.
        status: "ok", "warn", "fail" or "skip".
        found: What was found.
        fix: What to do. Empty if nothing.
    """

    name: str
    status: str
    found: str
    fix: str = ""


def warn_if(bad: bool, name: str, found: str, fix: str) -> Check:
    """Return a warning with what to do, or "ok" without it."""
    return Check(name, "warn", found, fix) if bad else Check(name, "ok", found)


def check_ports(device: str | None = None) -> Check:
    """List the serial ports of this computer. Warn if there is neither a port nor a device."""
    # A pseudo-terminal isn't listed, though it can be examined.
    ports = [f"{port.device} ({port.description})" for port in find_ports()]
    if device is not None:
        ports = ports or [f"none but {device}"]
    advice = "plug the board in; is its driver loaded?"
    return warn_if(not ports, "serial ports", ", ".join(ports) or "none found", advice)


def check_estop() -> Check:
    """Check whether `acsar-gym estop` can stop programs on this computer."""
    try:
        folder = try_listening()
    except LinkError as error:
        message = f"'acsar-gym estop' won't be heard: {error.found}"
        return Check("emergency stop", "warn", message, error.fix)
    return Check("emergency stop", "ok", f"listens in {folder}")


def draw_checks(checks: Sequence[Check]) -> Table:
    """Format results as a table."""
    # Long advice is folded, so that the table fits into any terminal.
    columns = [Column(name, overflow="fold") for name in ("check", "", "found", "what to do")]
    table = Table(*columns, title="acsar-gym doctor", title_justify="left")
    for check in checks:
        table.add_row(check.name, STATUS_MARKS[check.status], check.found, check.fix)
    return table
