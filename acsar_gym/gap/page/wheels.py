"""Plots of the speeds of four wheels, in the places where the wheels are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from acsar_gym.evaluation.page.traces import Trace, axis, line, stairs
from acsar_gym.gap.delays import Floats

CORNERS = (
    (1, "front left (b)"),
    (0, "front right (a)"),
    (2, "rear left (c)"),
    (3, "rear right (d)"),
)
"""Wheels in the order of the four plots, as seen from above."""
COLUMNS = ((0.0, 0.485), (0.515, 1.0))
ROWS = ((0.55, 1.0), (0.0, 0.45))


@dataclass(frozen=True, eq=False)
class Wheels:
    """Speeds of four wheels, (k, 4) [rad/s], at times (k,) [s], and how they are drawn."""

    name: str
    stamps: Floats
    speeds: Floats
    color: str
    width: float


def wheel_traces(commands: tuple[Floats, Floats] | None, tracks: Sequence[Wheels]) -> list[Trace]:
    """Make the traces of four wheels; `commands` are times [s] and speeds [rad/s]."""
    traces = []
    for place, (wheel, _) in enumerate(CORNERS):
        axes: dict[str, Any] = {"xaxis": f"x{_mark(place)}", "yaxis": f"y{_mark(place)}"}
        if commands is not None:
            stamps, speeds = commands
            traces.append(stairs("command", stamps, speeds[:, wheel], "--command", **axes))
        traces += [
            line(t.name, t.stamps, t.speeds[:, wheel], t.color, width=t.width, **axes)
            for t in tracks
        ]
    return traces


def wheel_layout() -> Mapping[str, Any]:
    """Make the layout of four plots that are zoomed together."""
    layout: dict[str, Any] = {"hovermode": "x unified", "annotations": []}
    for place, (_, name) in enumerate(CORNERS):
        mark, column, row = _mark(place), COLUMNS[place % 2], ROWS[place // 2]
        left, low = place % 2 == 0, place >= 2
        first = place == 0
        layout[f"xaxis{mark}"] = axis(
            "time [s]" if low else "",
            anchor=f"y{mark}",
            domain=column,
            showticklabels=low,
            **({} if first else {"matches": "x"}),
        )
        layout[f"yaxis{mark}"] = axis(
            "speed [rad/s]" if left else "",
            anchor=f"x{mark}",
            domain=row,
            showticklabels=left,
            **({} if first else {"matches": "y"}),
        )
        where = {"x": column[0], "y": row[1], "xref": "paper", "yref": "paper"}
        where |= {"xanchor": "left", "yanchor": "bottom"}
        layout["annotations"].append({"text": name, "showarrow": False, **where})
    return layout


def _mark(place: int) -> str:
    """Return the number of an axis, as plotly writes it."""
    return "" if place == 0 else str(place + 1)
