"""Builds HTML reports of one file. All text is escaped; nothing is loaded from anywhere."""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from acsar_gym import reading
from acsar_gym.errors import MissingExtraError
from acsar_gym.tools.evaluation.metrics import replace_nonfinite

CONTENT_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; "
    "img-src data: blob:; media-src data:"
)
"""Content security policy: a browser refuses to load anything over the network."""


WIDE_TABLE_COLUMNS = 9
"""Tables with more columns have small type."""


@dataclass(frozen=True)
class Plot:
    """An interactive plot. Colours are names of page.css, such as "--robot".

    Attributes:
        caption: what it shows, and how to read it.
        choices: traces of plotly for each choice of the picker, or one list for all of them.
        layout: of plotly; axes have titles with units.
        height: [px].
    """

    caption: str
    choices: Sequence[Sequence[Mapping[str, Any]]]
    layout: Mapping[str, Any]
    height: int = 420


@dataclass(frozen=True)
class Grid:
    """A table; cells of the first `words` columns are aligned left, numbers right."""

    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    words: int = 1


@dataclass(frozen=True)
class Film:
    """A picture with a caption, which becomes a video when it is played."""

    caption: str
    picture: bytes
    """PNG."""
    video: bytes
    """MP4."""


@dataclass(frozen=True)
class Gallery:
    """Films side by side."""

    films: Sequence[Film]


@dataclass(frozen=True)
class Tile:
    """One figure in large type: what, its value, and the old value that it replaces."""

    label: str
    value: str
    old: str = ""


@dataclass(frozen=True)
class PageSection:
    """A heading, a paragraph, then tables, plots and films; `picks` puts the picker here."""

    title: str
    text: str = ""
    parts: Sequence[Grid | Plot | Gallery] = ()
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
    footer: str = ""

    def write(self, path: Path) -> None:
        """Write the file.

        Raises:
            ConfigError: it can't be written.
            MissingExtraError: plotly isn't installed.
        """
        reading.write_atomically(path, self.html().encode())

    def html(self) -> str:
        """Return the whole file as text; MissingExtraError without plotly."""
        parts = [part for section in self.sections for part in section.parts]
        plots = [part for part in parts if isinstance(part, Plot)]
        body = "".join(
            [
                _header(self.title, self.subtitle),
                _tiles(self.tiles),
                _list(self.said),
                *(_section(section, self.choices, plots) for section in self.sections),
                f"<section><h2>Notes</h2>{_list(self.notes)}</section>" if self.notes else "",
                f"<footer>{escape(self.footer)}</footer>",
            ]
        )
        return (
            '<!doctype html><html lang="en"><head><meta charset="utf-8">'
            f'<meta http-equiv="Content-Security-Policy" content="{CONTENT_POLICY}">'
            '<meta name="viewport" content="width=device-width, initial-scale=1">'
            f"<title>{escape(self.title)}</title><style>{_file('page.css')}</style></head>"
            f"<body><main>{body}</main>"
            f'<script id="plots" type="application/json">{_data(plots)}</script>'
            f"<script>{plotly_source()}</script><script>{_file('page.js')}</script></body></html>\n"
        )


def _data(plots: Sequence[Plot]) -> str:
    """Return the plots as JSON that can stand in a script element."""
    data = [
        {"id": _name(plot, plots), "choices": plot.choices, "layout": plot.layout} for plot in plots
    ]
    return json.dumps(replace_nonfinite(data), separators=(",", ":")).replace("<", "\\u003c")


def _name(plot: Plot, plots: Sequence[Plot]) -> str:
    """Return the id of a plot's element."""
    return f"plot{next(n for n, other in enumerate(plots) if other is plot)}"


def plotly_source() -> str:
    """Return the source of plotly.js; MissingExtraError where plotly isn't installed."""
    try:
        from plotly.offline import get_plotlyjs  # noqa: PLC0415 - optional
    except ImportError:
        raise MissingExtraError("an HTML report", "report") from None
    return str(get_plotlyjs())


def _file(name: str) -> str:
    return (resources.files(__package__) / name).read_text(encoding="utf-8")


def _header(title: str, subtitle: str) -> str:
    return (
        f'<header><div><h1>{escape(title)}</h1><p class="muted">{escape(subtitle)}</p></div>'
        '<button id="theme" type="button">Dark / light</button></header>'
    )


def _tiles(tiles: Sequence[Tile]) -> str:
    if not tiles:
        return ""
    cells = "".join(
        f'<div class="tile"><span>{escape(tile.label)}</span><b>'
        + (f'<span class="old">{escape(tile.old)} → </span>' if tile.old else "")
        + f"{escape(tile.value)}</b></div>"
        for tile in tiles
    )
    return f'<div class="tiles">{cells}</div>'


def _list(lines: Sequence[str]) -> str:
    return f'<ul class="said">{"".join(f"<li>{escape(line)}</li>" for line in lines)}</ul>'


def _section(section: PageSection, choices: Sequence[str], plots: Sequence[Plot]) -> str:
    """Return a section with its tables and plots."""
    parts = "".join(_part(part, plots) for part in section.parts)
    text = f'<p class="muted">{escape(section.text)}</p>' if section.text else ""
    picker = _picker(choices) if section.picks and len(choices) > 1 else ""
    key = _key(section.key) if section.key else ""
    return f"<section><h2>{escape(section.title)}</h2>{text}{picker}{key}{parts}</section>"


def _part(part: Grid | Plot | Gallery, plots: Sequence[Plot]) -> str:
    if isinstance(part, Plot):
        return _plot(part, _name(part, plots))
    return _grid(part) if isinstance(part, Grid) else _gallery(part)


def _gallery(gallery: Gallery) -> str:
    """Return films; their pictures are shown until they are clicked, see page.js."""
    films = "".join(
        f'<figure class="card"><video muted playsinline preload="none" '
        f'poster="{_embedded("image/png", film.picture)}" '
        f'src="{_embedded("video/mp4", film.video)}" aria-label="{escape(film.caption)}"></video>'
        f"<figcaption>{escape(film.caption)}</figcaption></figure>"
        for film in gallery.films
    )
    return f'<div class="gallery">{films}</div>'


def _embedded(kind: str, data: bytes) -> str:
    """Return a file as the URL that holds it."""
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"


def _picker(choices: Sequence[str]) -> str:
    options = "".join(
        f'<option value="{number}">{escape(name)}</option>' for number, name in enumerate(choices)
    )
    return (
        '<div class="picker"><label for="picker">Episode</label>'
        f'<select id="picker" autocomplete="off">{options}</select></div>'
    )


def _plot(plot: Plot, name: str) -> str:
    """Return the place of a plot, which page.js fills."""
    return (
        f'<figure class="card"><div id="{name}" role="img" aria-label="{escape(plot.caption)}" '
        f'style="height:{plot.height}px"></div>'
        f"<figcaption>{escape(plot.caption)}</figcaption></figure>"
    )


def _key(entries: Sequence[tuple[str, str]]) -> str:
    parts = "".join(
        f'<span><i style="border-color:var({color})"></i>{escape(label)}</span>'
        for color, label in entries
    )
    return f'<div class="key">{parts}</div>'


def _grid(grid: Grid) -> str:
    def row(cells: Sequence[str], tag: str) -> str:
        return "".join(
            f"<{tag}{'' if number < grid.words else ' class=number'}>{escape(cell)}</{tag}>"
            for number, cell in enumerate(cells)
        )

    rows = "".join(f"<tr>{row(cells, 'td')}</tr>" for cells in grid.rows)
    head = f"<thead><tr>{row(grid.columns, 'th')}</tr></thead>"
    wide = ' class="wide"' if len(grid.columns) > WIDE_TABLE_COLUMNS else ""
    return f'<div class="card"><table{wide}>{head}<tbody>{rows}</tbody></table></div>'


MAX_LINE_POINTS = 2_500
"""Most points of a line; of longer ones every n-th point is drawn."""
POINT_DIGITS = 5
"""Significant digits of the points."""

PlotTrace = dict[str, Any]


def line_trace(
    name: str, x: ArrayLike, y: ArrayLike, color: str, *, width: float = 1.8, **options: Any
) -> PlotTrace:
    """Make a line; options are those of plotly's scatter trace."""
    xs, ys = np.asarray(x, np.float64), np.asarray(y, np.float64)
    stride = max(1, -(-len(xs) // MAX_LINE_POINTS))
    return {
        "type": "scatter",
        "mode": "lines",
        "name": name,
        "x": _rounded(xs[::stride]),
        "y": _rounded(ys[::stride]),
        "line": {"color": color, "width": width},
        **options,
    }


def dotted_trace(name: str, x: ArrayLike, y: ArrayLike, color: str) -> PlotTrace:
    """Make a dotted line."""
    return line_trace(name, x, y, color) | {"line": {"color": color, "width": 1.4, "dash": "dot"}}


def stairs_trace(
    name: str, x: ArrayLike, y: ArrayLike, color: str, *, width: float = 1.2, **options: Any
) -> PlotTrace:
    """Make a line of values that hold until the next one; repeated values are left out."""
    xs, ys = np.asarray(x, np.float64), np.asarray(y, np.float64)
    keep = np.ones(len(ys), bool)
    if len(ys) > 2:
        keep[1:-1] = np.diff(ys)[:-1] != 0.0
    shape = {"color": color, "shape": "hv", "width": width}
    return line_trace(name, xs[keep], ys[keep], color) | {"line": shape} | options


def distribution_trace(
    name: str, values: ArrayLike, color: str, scale: float = 1.0, *, width: float = 1.8
) -> PlotTrace:
    """Make the empirical distribution function of values."""
    known = np.sort(np.asarray(values, np.float64)) * scale
    known = known[np.isfinite(known)]
    part = np.arange(1, len(known) + 1) / max(1, len(known))
    begin = known[:1], np.zeros(min(1, len(known)))
    return stairs_trace(name, np.r_[begin[0], known], np.r_[begin[1], part], color, width=width)


def dots_trace(name: str, x: ArrayLike, y: ArrayLike, color: str, **options: Any) -> PlotTrace:
    """Make points."""
    marker = {"color": color, "size": 9}
    return line_trace(name, x, y, color) | {"mode": "markers", "marker": marker} | options


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


def _rounded(values: np.ndarray[Any, Any]) -> list[float]:
    return [float(f"{value:.{POINT_DIGITS}g}") for value in values.tolist()]
