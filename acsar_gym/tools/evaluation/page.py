"""HTML reports of one file: tables and plots, a template and what it is filled with.

All text is escaped, and nothing is loaded from anywhere: page.html has a content security policy.
Colours of plots are names of page.css, such as "--robot", so that they follow the scheme.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

import acsar_gym
from acsar_gym import reading
from acsar_gym.errors import MissingExtraError
from acsar_gym.tools.evaluation.metrics import replace_nonfinite

MAX_LINE_POINTS = 2_500
"""Most points of a line; of longer ones every n-th point is drawn."""
POINT_DIGITS = 5
"""Significant digits of the points."""
PlotTrace = dict[str, Any]
"""A trace of plotly, as plain data."""


@dataclass(frozen=True)
class Plot:
    """An interactive plot.

    Attributes:
        caption: what it shows, and how to read it.
        choices: traces for each choice of the picker, or one list for all of them.
        layout: of plotly; axes have titles with units.
        height: [px].
    """

    caption: str
    choices: Sequence[Sequence[PlotTrace]]
    layout: Mapping[str, Any]
    height: int = 420


@dataclass(frozen=True)
class Grid:
    """A table; cells of the first `words` columns are aligned left, numbers right."""

    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    words: int = 1


@dataclass(frozen=True)
class Tile:
    """One figure in large type: what, its value, and the old value that it replaces."""

    label: str
    value: str
    old: str = ""


@dataclass(frozen=True)
class PageSection:
    """A heading, a paragraph, then tables and plots; `picks` puts the picker here."""

    title: str
    text: str = ""
    parts: Sequence[Grid | Plot] = ()
    key: Sequence[tuple[str, str]] = ()
    """Colours and what they stand for."""
    picks: bool = False


@dataclass(frozen=True)
class ReportPage:
    """A report."""

    title: str
    subtitle: str
    said: Sequence[str]
    tiles: Sequence[Tile]
    sections: Sequence[PageSection]
    choices: Sequence[str] = ()
    """What the picker offers, such as the names of episodes."""
    notes: Sequence[str] = ()
    footer: str = f"acsar_gym {acsar_gym.__version__}"

    def write(self, path: Path) -> None:
        """Write the file.

        Raises:
            ConfigError: it can't be written.
            MissingExtraError: plotly or jinja2 isn't installed.
        """
        text = f"<!-- {reading.describe_origin()} -->\n{self.html()}"  # found by check_replaceable
        reading.write_atomically(path, text.encode())

    def html(self) -> str:
        """Return the whole file as text; MissingExtraError without plotly or jinja2."""
        check_report_extra()
        import jinja2  # noqa: PLC0415 - optional
        from plotly.io.json import to_json_plotly  # noqa: PLC0415 - optional
        from plotly.offline import get_plotlyjs  # noqa: PLC0415 - optional

        folder = Path(__file__).parent
        parts = [part for section in self.sections for part in section.parts]
        plots = [
            {"id": f"plot{number}", "choices": plot.choices, "layout": plot.layout}
            for number, plot in enumerate(part for part in parts if isinstance(part, Plot))
        ]
        template = jinja2.Environment(
            autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined
        ).from_string((folder / "page.html").read_text(encoding="utf-8"))
        return template.render(
            page=self,
            plots=to_json_plotly(replace_nonfinite(plots)),  # safe within a script element
            plotly=get_plotlyjs(),
            css=(folder / "page.css").read_text(encoding="utf-8"),
            js=(folder / "page.js").read_text(encoding="utf-8"),
        )


def check_report_extra() -> None:
    """Check before a long run that a report can be made; MissingExtraError if not."""
    try:
        import jinja2  # noqa: F401, PLC0415 - optional
        import plotly.offline  # noqa: F401, PLC0415 - optional
    except ImportError as error:
        raise MissingExtraError("an HTML report", "report") from error


def line_trace(
    name: str, x: ArrayLike, y: ArrayLike, color: str, *, width: float = 1.8, **options: Any
) -> PlotTrace:
    """Make a line; options are those of plotly's scatter trace."""
    xs, ys = np.asarray(x, np.float64), np.asarray(y, np.float64)
    stride = max(1, -(-len(xs) // MAX_LINE_POINTS))
    rounded = [
        [float(f"{value:.{POINT_DIGITS}g}") for value in values[::stride].tolist()]
        for values in (xs, ys)
    ]
    return {
        "type": "scatter",
        "mode": "lines",
        "name": name,
        **dict(zip("xy", rounded, strict=True)),
        "line": {"color": color, "width": width},
        **options,
    }


def stairs_trace(
    name: str, x: ArrayLike, y: ArrayLike, color: str, *, width: float = 1.2, **options: Any
) -> PlotTrace:
    """Make a line of values that hold until the next one; repeated values are left out."""
    xs, ys = np.asarray(x, np.float64), np.asarray(y, np.float64)
    keep = np.ones(len(ys), bool)
    if len(ys) > 2:
        keep[1:-1] = np.diff(ys)[:-1] != 0.0
    shape = {"color": color, "shape": "hv", "width": width}
    return line_trace(name, xs[keep], ys[keep], color, line=shape, **options)


def distribution_trace(
    name: str, values: ArrayLike, color: str, scale: float = 1.0, *, width: float = 1.8
) -> PlotTrace:
    """Make the empirical distribution function of values."""
    known = np.sort(np.asarray(values, np.float64)) * scale
    known = known[np.isfinite(known)]
    part = np.arange(1, len(known) + 1) / max(1, len(known))
    return stairs_trace(
        name, np.r_[known[:1], known], np.r_[np.zeros(min(1, len(known))), part], color, width=width
    )


def dots_trace(
    name: str, x: ArrayLike, y: ArrayLike, color: str, *, symbol: Any = "circle"
) -> PlotTrace:
    """Make points; `symbol` may be a list with one for each."""
    marker = {"color": color, "size": 9, "symbol": symbol}
    return line_trace(name, x, y, color, mode="markers", marker=marker)


def make_axis(title: str, **options: Any) -> dict[str, Any]:
    """Make an axis with a title, in which its unit stands."""
    return {"title": {"text": title, "standoff": 8}, **options}


def make_layout(x: str, y: str, **options: Any) -> Mapping[str, Any]:
    """Make the layout of a plot with one pair of axes."""
    return {"xaxis": make_axis(x), "yaxis": make_axis(y), **options}


MAP_LAYOUT: Mapping[str, Any] = {
    "xaxis": make_axis("x [m]"),
    "yaxis": make_axis("y [m]", scaleanchor="x", scaleratio=1),
}
"""Layout of a view from above: metres are equally long along both axes."""
