"""The table of an identification."""

from __future__ import annotations

from rich.table import Table

from acsar_gym.identification.finding import Finding
from acsar_gym.identification.identified import Identified
from acsar_gym.identification.motors import NO_RAMP

UNITS = {
    "motor.time_constant": (1e3, "ms"),
    "motor.gain": (1.0, ""),
    "motor.acceleration": (1.0, "rad/s^2"),
    "motor.deadband": (1.0, "rad/s"),
    "firmware.command_delay": (1e3, "ms"),
    "firmware.command_timeout": (1e3, "ms"),
    "firmware.feedback_rate": (1.0, "Hz"),
    "encoder.window": (1e3, "ms"),
    "encoder.quantum": (1.0, "rad/s"),
}
"""Factor and unit in which each parameter is shown."""


def table(found: Identified) -> Table:
    """Draw the findings; what a log can't tell has no number, but a reason."""
    drawn = Table(title="acsar-gym identify", title_justify="left", caption=_caption(found))
    drawn.caption_justify = "left"
    for column in ("parameter", "wheel", "value", "95 % interval", "before", "note"):
        drawn.add_column(column, overflow="fold")
    for one in found.findings:
        factor, unit = UNITS[one.name]
        drawn.add_row(
            one.name,
            one.wheel or ("all" if one.name.startswith("motor.") else ""),
            _value(one, factor, unit),
            _interval(one, factor),
            _number(one.before, factor),
            one.note if one.value is not None or one.told else f"[yellow]can't tell:[/] {one.note}",
        )
    return drawn


def _value(one: Finding, factor: float, unit: str) -> str:
    if one.value is None or one.value == NO_RAMP:
        return "none" if one.told else "-"
    return f"{_number(one.value, factor)} {unit}".strip()


def _interval(one: Finding, factor: float) -> str:
    if one.low is None or one.high is None or one.value == NO_RAMP:
        return ""
    return f"{_number(one.low, factor)} to {_number(one.high, factor)}"


def _number(value: float | None, factor: float) -> str:
    if value is None:
        return "none"
    scaled = value * factor
    return f"{scaled:.1f}" if abs(scaled) >= 100.0 else f"{scaled:.3g}"


def _caption(found: Identified) -> str:
    """Say how well the fit predicts what it didn't see."""
    log = f"{found.duration:.1f} s of log"
    if found.held_out is None:
        return log
    one = found.held_out
    return (
        f"{log}; wheel speeds on the {one.share:.0%} that the fit didn't see: "
        f"{one.after:.3f} rad/s RMS, {one.before:.3f} as configured before"
    )
