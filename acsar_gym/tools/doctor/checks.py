"""Results of diagnostic checks, and the checks of this computer."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from rich.table import Table

from acsar_gym.links.ports import find_ports
from acsar_gym.safety.estop import StopListener

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
        name: what was checked.
        status: "ok", "warn", "fail" or "skip".
        found: what was found.
        fix: what to do; empty if nothing.
    """

    name: str
    status: str
    found: str
    fix: str = ""


def check_ports(device: str | None = None) -> Check:
    """List the serial ports of this computer; a warning if there is neither one nor a device."""
    found = [f"{port.device} ({port.description})" for port in find_ports()]
    if not found and device is not None:
        return Check("serial ports", "ok", f"none but {device}")
    if not found:
        return Check(
            "serial ports", "warn", "none found", "plug the board in; is its driver loaded?"
        )
    return Check("serial ports", "ok", ", ".join(found))


def check_estop() -> Check:
    """Check whether `acsar-gym estop` can stop programs on this computer."""
    listener = StopListener()
    folders = ", ".join(str(path.parent) for path in listener.paths)
    faults = "; ".join(fault.found for fault in listener.faults)
    fixes = "; ".join(fault.fix for fault in listener.faults)
    listener.close()
    if not folders:
        return Check("emergency stop", "warn", f"'acsar-gym estop' won't be heard: {faults}", fixes)
    found = f"listens in {folders}" + (f"; not everywhere: {faults}" if faults else "")
    return Check("emergency stop", "warn" if faults else "ok", found, fixes)


def checks_as_json(checks: list[Check]) -> dict[str, Any]:
    """Format results for JSON."""
    return {"checks": [asdict(check) for check in checks]}


def draw_checks(checks: list[Check]) -> Table:
    """Format results as a table."""
    drawn = Table(title="acsar-gym doctor", title_justify="left")
    for column in ("check", "", "found", "what to do"):
        drawn.add_column(column, overflow="fold")
    for check in checks:
        drawn.add_row(check.name, STATUS_MARKS[check.status], check.found, check.fix)
    return drawn
