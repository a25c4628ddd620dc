"""Traces and axes of plotly, as plain data. Colours are names of page.css."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

MOST_POINTS = 2_500
"""Most points of a line; of longer ones every n-th point is drawn."""
DIGITS = 5
"""Significant digits of the points."""

Trace = dict[str, Any]


def line(
    name: str, x: ArrayLike, y: ArrayLike, color: str, *, width: float = 1.8, **options: Any
) -> Trace:
    """Make a line; options are those of plotly's scatter trace."""
    xs, ys = np.asarray(x, np.float64), np.asarray(y, np.float64)
    stride = max(1, -(-len(xs) // MOST_POINTS))
    return {
        "type": "scatter",
        "mode": "lines",
        "name": name,
        "x": _rounded(xs[::stride]),
        "y": _rounded(ys[::stride]),
        "line": {"color": color, "width": width},
        **options,
    }


def dotted(name: str, x: ArrayLike, y: ArrayLike, color: str) -> Trace:
    """Make a dotted line."""
    return line(name, x, y, color) | {"line": {"color": color, "width": 1.4, "dash": "dot"}}


def stairs(
    name: str, x: ArrayLike, y: ArrayLike, color: str, *, width: float = 1.2, **options: Any
) -> Trace:
    """Make a line of values that hold until the next one; repeated values are left out."""
    xs, ys = np.asarray(x, np.float64), np.asarray(y, np.float64)
    keep = np.ones(len(ys), bool)
    if len(ys) > 2:
        keep[1:-1] = np.diff(ys)[:-1] != 0.0
    shape = {"color": color, "shape": "hv", "width": width}
    return line(name, xs[keep], ys[keep], color) | {"line": shape} | options


def shares(
    name: str, values: ArrayLike, color: str, scale: float = 1.0, *, width: float = 1.8
) -> Trace:
    """Make the empirical distribution function of values."""
    known = np.sort(np.asarray(values, np.float64)) * scale
    known = known[np.isfinite(known)]
    part = np.arange(1, len(known) + 1) / max(1, len(known))
    begin = known[:1], np.zeros(min(1, len(known)))
    return stairs(name, np.r_[begin[0], known], np.r_[begin[1], part], color, width=width)


def dots(name: str, x: ArrayLike, y: ArrayLike, color: str, **options: Any) -> Trace:
    """Make points."""
    marker = {"color": color, "size": 9}
    return line(name, x, y, color) | {"mode": "markers", "marker": marker} | options


def axis(title: str, **options: Any) -> dict[str, Any]:
    """Make an axis with a title, in which its unit stands."""
    return {"title": {"text": title, "standoff": 8}, **options}


def layout(x: str, y: str, **options: Any) -> Mapping[str, Any]:
    """Make the layout of a plot with one pair of axes."""
    return {"xaxis": axis(x), "yaxis": axis(y), **options}


MAP: Mapping[str, Any] = {
    "xaxis": axis("x [m]"),
    "yaxis": axis("y [m]", scaleanchor="x", scaleratio=1),
}
"""Layout of a view from above: metres are equally long along both axes."""


def _rounded(values: np.ndarray[Any, Any]) -> list[float]:
    return [float(f"{value:.{DIGITS}g}") for value in values.tolist()]
