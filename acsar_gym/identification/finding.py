"""One parameter that an identification found, or why it couldn't."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Finding:
    """One parameter of one wheel, or of the board.

    Attributes:
        name: field of the robot's config, such as "motor.gain".
        wheel: "a" to "d"; "" for all.
        value: in the field's unit; None where the log can't tell, or there is none.
        low: lower end of the 95 % interval.
        high: upper end.
        before: as configured.
        note: why it can't be told, or what it means.
        told: whether it goes into the robot's file.
    """

    name: str
    wheel: str = ""
    value: float | None = None
    low: float | None = None
    high: float | None = None
    before: float | None = None
    note: str = ""
    told: bool = False


def unknown(name: str, wheel: str, before: float | None, why: str) -> Finding:
    """Make the finding of a parameter that the log can't tell."""
    return Finding(name, wheel, before=before, note=why)
