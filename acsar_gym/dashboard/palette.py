"""Colours and other settings that all figures share; dashboard.css has the same colours."""

from __future__ import annotations

import base64
from typing import Any

import numpy as np
from numpy.typing import NDArray

INK, MUTED, GRID, PAPER = "#1c1e21", "#62676e", "#ececee", "#ffffff"
ASKED, SENT, MEASURED = "#868c94", "#1f5fd6", "#d9640a"
GOAL, SCAN, SEEN, WALL, TRUTH = "#1a8f5a", "#0f8b8d", "#c3ccd4", "#6b7280", "#9b6bd3"
REASONS = ("#dfe9e2", "#f2cf66", "#9b6bd3", "#ef8a3c", "#c81e2b")
"""Of each `safety.rules.Reason`."""
SPECK = 0.001
"""Length of the pieces of a line that are points [m]."""
FONT = {"family": "system-ui, 'Segoe UI', Roboto, 'Helvetica Neue', Arial, sans-serif"}

Figure = dict[str, Any]


def numbers(values: NDArray[Any]) -> dict[str, str]:
    """Return an array as plotly.js reads it fastest: 32-bit floats in base64."""
    data = np.ascontiguousarray(values, "<f4").tobytes()
    return {"dtype": "f4", "bdata": base64.b64encode(data).decode()}


def layout(revision: str, **more: Any) -> Figure:
    """Return a plotly layout.

    Args:
        revision: what zoom and pan belong to; they are kept for as long as it is the same.
        **more: of the layout.
    """
    return {
        "font": FONT | {"size": 12, "color": INK},
        "paper_bgcolor": PAPER,
        "plot_bgcolor": PAPER,
        "showlegend": False,
        "hovermode": False,
        "uirevision": revision,
        "margin": {"l": 48, "r": 12, "t": 12, "b": 36},
        **more,
    }


def axis(title: str, **more: Any) -> Figure:
    """Return a plotly axis."""
    return {
        "title": {"text": title, "standoff": 6, "font": {"size": 12, "color": MUTED}},
        "gridcolor": GRID,
        "zeroline": False,
        "linecolor": GRID,
        "tickfont": {"size": 11, "color": MUTED},
        **more,
    }


def line(x: NDArray[Any], y: NDArray[Any], colour: str, **more: Any) -> Figure:
    """Return a plotly line, 1.6 px wide unless `more` says otherwise."""
    style = {"color": colour, "width": 1.6} | more.pop("line", {})
    return {
        "type": "scatter",
        "mode": "lines",
        "x": numbers(x),
        "y": numbers(y),
        "line": style,
        **more,
    }


def specks(points: NDArray[Any], colour: str, size: float, **more: Any) -> Figure:
    """Return many points (n, 2) as one plotly line, which a browser draws much faster than markers.

    The line is in pieces of almost no length, to which dashboard.css gives round ends.
    """
    gap = np.full(len(points), np.nan)
    x = np.stack([points[:, 0], points[:, 0] + SPECK, gap], axis=1).ravel()
    y = np.stack([points[:, 1], points[:, 1], gap], axis=1).ravel()
    return line(x, y, colour, line={"width": size, "simplify": False}, **more)


def dots(points: NDArray[Any], colour: str, size: float, **more: Any) -> Figure:
    """Return plotly markers at points (n, 2)."""
    return {
        "type": "scatter",
        "mode": "markers",
        "x": numbers(points[:, 0]),
        "y": numbers(points[:, 1]),
        "marker": {"color": colour, "size": size, "line": {"width": 0}},
        **more,
    }
