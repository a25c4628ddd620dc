"""The gap as tables in the terminal, and as JSON."""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import Any

from rich.table import Table

from acsar_gym.evaluation.metrics import Interval, finite
from acsar_gym.evaluation.report import plain
from acsar_gym.gap.figures import METRICS
from acsar_gym.gap.measure import SIDES, Gap, conclusion

LIMITS = (*METRICS, "delay")
"""What `--fail-over` takes; the delay is the difference of the means [s]."""


def cell(value: float, scale: float = 1.0) -> str:
    """Format a number with three digits; "-" for NaN."""
    if math.isnan(value):
        return "-"
    return "0" if abs(value * scale) < 1e-6 else f"{value * scale:.3g}"


def between(interval: Interval, scale: float = 1.0) -> str:
    """Format an interval; empty if it isn't known."""
    return "" if math.isnan(interval[0]) else " to ".join(cell(end, scale) for end in interval)


def ratio(before: float, after: float, resolution: float) -> str:
    """Format how much of a figure is left after fitting; "-" where there was nothing to lose."""
    known = math.isfinite(before) and math.isfinite(after) and abs(before) >= resolution
    return f"{abs(after / before):.1%}" if known else "-"


def rows(gap: Gap) -> list[tuple[str, str, str, str, str, str]]:
    """Return label, unit, before, after, the interval after, and what is left, per metric."""
    before, after, around = gap.figures("before"), gap.figures("after"), gap.intervals("after")
    return [
        (
            metric.label,
            metric.unit,
            cell(before[name], metric.scale),
            cell(after[name], metric.scale),
            between(around[name], metric.scale),
            ratio(before[name], after[name], metric.resolution),
        )
        for name, metric in METRICS.items()
    ]


def tables(gap: Gap) -> list[Table]:
    """Make the tables of a gap: figures, and the logs."""
    kind = "held-out logs" if gap.held_out else "logs that the robot was fitted to"
    title = f"Gap of {gap.robot} (before: {gap.before}) on {kind}, twin: {gap.body}"
    figures = Table(title=plain(title), title_justify="left")
    for name in ("figure", "unit", "before", "after", "95 % interval", "after / before"):
        figures.add_column(name, justify="left" if name in ("figure", "unit") else "right")
    for row in rows(gap):
        figures.add_row(*row)
    return [figures, _logs(gap)]


def _logs(gap: Gap) -> Table:
    """Make the table of the logs."""
    table = Table(title="Each episode, before -> after", title_justify="left")
    for name in ("log", "use", "duration", "wheel speeds", "end position", "against"):
        table.add_column(name, justify="right" if name == "duration" else "left")
    for replay in gap.replays:
        ends = [
            " -> ".join(cell(replay.figures[side][name], scale) for side in SIDES)
            for name, scale in (("wheel_speed_rms", 1.0), ("end_pose", 100.0))
        ]
        use = "fitted" if replay.fitted else "held out"
        against = "truth" if replay.recorded.known else "odometry"
        cells = (f"{replay.seconds:.1f} s", f"{ends[0]} rad/s", f"{ends[1]} cm", against)
        table.add_row(plain(replay.name), use, *cells)
    return table


def sizes(gap: Gap) -> dict[str, float]:
    """Return the figures of the fitted twin by the names of LIMITS, in SI units."""
    return gap.figures("after") | {"delay": gap.delays("after").difference}


def as_dict(gap: Gap) -> dict[str, Any]:
    """Return the gap for JSON, in SI units; what isn't known is null."""
    sides = {
        side: {
            "figures": gap.figures(side),
            "intervals": gap.intervals(side),
            "delays": asdict(gap.delays(side)),
        }
        for side in SIDES
    }
    logs = [
        {
            "log": replay.log,
            "episode": replay.episode,
            "fitted": replay.fitted,
            "seconds": replay.seconds,
            "truth": replay.recorded.known,
            **{side: replay.figures[side] for side in SIDES},
        }
        for replay in gap.replays
    ]
    told: dict[str, Any] = finite(
        {
            "robot": gap.robot,
            "unfitted": gap.before,
            "body": gap.body,
            "held_out": gap.held_out,
            **sides,
            "logs": logs,
            "notes": list(gap.notes),
            "conclusion": conclusion(gap),
        }
    )
    return told
