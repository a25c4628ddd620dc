"""The charts over time: wheel speeds, lateness, and the safety layer's reason."""

from __future__ import annotations

import math

import numpy as np

from acsar_gym.dashboard import palette
from acsar_gym.dashboard.columns import Floats, outline
from acsar_gym.dashboard.episodes import TICK, Episode
from acsar_gym.dashboard.palette import Figure
from acsar_gym.recording.diagnostics import LATE

WINDOW = 20.0
"""How much of the time before now the wheels' charts show [s]."""
POINTS = 300
"""Points of a line that are drawn; a chart is about as many pixels wide."""
LEAST = 0.01
"""Smallest lateness on the axis, which is logarithmic [ms]."""
STRIPES = 600
"""Stretches of the episode for each of which one reason is drawn."""
Pair = tuple[float, float]
WHEELS = ((1, "front left"), (0, "front right"), (2, "rear left"), (3, "rear right"))
"""Place in the wheel order and name of each, as seen from above with the front up."""


def wheels(episode: Episode, time: float, revision: str) -> Figure:
    """Draw the wheel speeds asked for, sent and measured, in the time before `time` [s]."""
    begin = max(0.0, time - WINDOW)
    ticks = slice(max(episode.place(begin), 0), episode.place(time) + 1)
    stamps = episode.column("stamp")[ticks]
    measured = episode.ticks.rows[ticks, TICK["speed_a"] : TICK["speed_a"] + 4]
    asked, sent = episode.asked(ticks), episode.sent.rows
    first, last = np.searchsorted(sent[:, 0], (begin, time + 1e-9))
    sent = sent[max(first - 1, 0) : last]
    traces: list[Figure] = []
    annotations: list[Figure] = []
    style: dict[str, object] = {"dash": "dot", "width": 2.2}
    steps: dict[str, object] = {"shape": "hv"}
    for place, (wheel, name) in enumerate(WHEELS):
        axes = {"xaxis": f"x{place % 2 + 1}", "yaxis": f"y{place + 1}"}
        traces += [
            _line(stamps, measured[:, wheel], palette.MEASURED, {}) | axes,
            _line(sent[:, 0], sent[:, 1 + wheel], palette.SENT, steps) | axes,
            _line(stamps, asked[:, wheel], palette.ASKED, style) | axes,
        ]
        annotations.append(_title(name, place))
    span = _span(np.concatenate([measured.ravel(), asked.ravel(), sent[:, 1:].ravel()]))
    times = begin, max(time, begin + 1.0)
    return {"data": traces, "layout": _grid(times, span, revision, annotations)}


def _line(x: Floats, y: Floats, colour: str, style: dict[str, object]) -> Figure:
    """A line of few points."""
    chosen = outline(y, POINTS)
    return palette.line(x[chosen], y[chosen], colour, line=style)


def _span(speeds: Floats) -> tuple[float, float]:
    """Limits of the axes, around zero and in steps of 2 rad/s, so that they seldom change."""
    known = np.r_[speeds[np.isfinite(speeds)], 0.0, 2.0]
    low, high = float(known.min()), float(known.max())
    return 2.0 * math.floor(low / 1.9), 2.0 * math.ceil(high / 1.9)


def _title(name: str, place: int) -> Figure:
    """The name of a wheel, in its chart."""
    return {
        "text": f"<b>{name}</b>",
        "showarrow": False,
        "xref": f"x{place % 2 + 1} domain",
        "yref": f"y{place + 1} domain",
        "x": 0.0,
        "y": 1.0,
        "xanchor": "left",
        "yanchor": "bottom",
        "font": {"size": 12, "color": palette.INK},
    }


def _grid(times: Pair, speeds: Pair, revision: str, annotations: list[Figure]) -> Figure:
    """The layout of the four charts."""
    columns, rows = ((0.0, 0.47), (0.53, 1.0)), ((0.55, 0.96), (0.0, 0.41))
    axes: Figure = {}
    for column, domain in enumerate(columns):
        axes[f"xaxis{column + 1}"] = palette.axis(
            "time [s]",
            domain=list(domain),
            range=list(times),
            anchor=f"y{column + 3}",
            fixedrange=True,
        )
    for place in range(4):
        axes[f"yaxis{place + 1}"] = palette.axis(
            "" if place % 2 else "rad/s",
            domain=list(rows[place // 2]),
            anchor=f"x{place % 2 + 1}",
            range=list(speeds),
            zeroline=True,
            zerolinecolor="#d5d8dc",
            nticks=5,
            fixedrange=True,
        )
    return palette.layout(revision, annotations=annotations, **axes)


def lateness(episode: Episode, time: float, revision: str) -> Figure:
    """Draw how late ticks ended and why the safety layer stepped in, over the whole episode."""
    end = max(episode.end, 1.0)
    late = np.maximum(episode.column("lateness") * 1e3, LEAST)
    known = late[np.isfinite(late)]
    high = max(10.0, 2.0 * float(known.max())) if len(known) else 10.0
    limit = np.array([0.0, end]), np.full(2, LATE * 1e3)
    traces = [
        palette.line(*limit, palette.REASONS[4], line={"dash": "dash", "width": 1}),
        _line(episode.column("stamp"), late, palette.INK, {"width": 1.2}),
        _reasons(episode, end) | {"yaxis": "y2"},
    ]
    notes = [] if len(known) else [_note("simulated time is never late")]
    cursor = {"type": "line", "x0": time, "x1": time, "y0": 0, "y1": 1, "yref": "paper"}
    layout = palette.layout(
        revision,
        annotations=notes,
        margin={"l": 48, "r": 12, "t": 8, "b": 36},
        xaxis=palette.axis("time [s]", range=[0.0, end], anchor="y2", fixedrange=True),
        yaxis=palette.axis(
            "ms",
            type="log",
            dtick=1,
            domain=[0.3, 1.0],
            range=[math.log10(LEAST), math.log10(high)],
            fixedrange=True,
        ),
        yaxis2={"domain": [0.0, 0.18], "visible": False, "fixedrange": True},
        shapes=[cursor | {"line": {"color": palette.SENT, "width": 1.5}}],
    )
    return {"data": traces, "layout": layout}


def _note(text: str) -> Figure:
    """Words instead of a line."""
    place = {"x": 0.5, "y": 0.65, "xref": "paper", "yref": "paper", "showarrow": False}
    return {
        "text": text,
        "font": {"size": 12, "color": palette.MUTED},
        "bgcolor": palette.PAPER,
        **place,
    }


def _reasons(episode: Episode, end: float) -> Figure:
    """A strip with the gravest reason of each stretch of time."""
    edges = np.linspace(0.0, end, STRIPES + 1)
    places = np.clip(np.searchsorted(edges, episode.column("stamp")) - 1, 0, STRIPES - 1)
    grave = np.full(STRIPES, np.nan)
    reasons = np.clip(np.nan_to_num(episode.column("reason")), 0, len(palette.REASONS) - 1)
    np.fmax.at(grave, places, reasons)
    if len(places):  # a stretch that is shorter than a tick has none: as the one before it
        held = np.maximum.accumulate(np.where(np.isnan(grave), 0, np.arange(STRIPES)))
        grave = np.where(edges[:-1] > episode.column("stamp")[-1], np.nan, grave[held])
    steps = len(palette.REASONS)
    scale = [[(n + k) / steps, colour] for n, colour in enumerate(palette.REASONS) for k in (0, 1)]
    cells = [[None if np.isnan(value) else int(value) for value in grave]]
    colours = {"colorscale": scale, "zmin": -0.5, "zmax": steps - 0.5, "showscale": False}
    return {"type": "heatmap", "x": numbers_of(edges), "z": cells, **colours}


def numbers_of(edges: Floats) -> list[float]:
    """Edges of cells; a heatmap doesn't read them in base64."""
    return [round(float(edge), 4) for edge in edges]
