"""Builds the HTML file. All text is escaped; nothing is loaded from anywhere."""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from importlib import resources
from pathlib import Path
from typing import Any

from acsar_gym.errors import MissingExtraError
from acsar_gym.evaluation.metrics import finite
from acsar_gym.reading import bounded

POLICY = (
    "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; "
    "img-src data: blob:; media-src data:"
)
"""Content security policy: a browser refuses to load anything over the network."""


MOST_COLUMNS = 9
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
class Section:
    """A heading, a paragraph, then tables, plots and films; `picks` puts the picker here."""

    title: str
    text: str = ""
    parts: Sequence[Grid | Plot | Gallery] = ()
    key: Sequence[tuple[str, str]] = ()
    """Colours and what they stand for."""
    picks: bool = False


@dataclass(frozen=True)
class Page:
    """A report."""

    title: str
    subtitle: str
    said: Sequence[str]
    tiles: Sequence[Tile]
    sections: Sequence[Section]
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
        bounded.write_atomically(path, self.html().encode())

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
            f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">'
            '<meta name="viewport" content="width=device-width, initial-scale=1">'
            f"<title>{escape(self.title)}</title><style>{_file('page.css')}</style></head>"
            f"<body><main>{body}</main>"
            f'<script id="plots" type="application/json">{_data(plots)}</script>'
            f"<script>{library()}</script><script>{_file('page.js')}</script></body></html>\n"
        )


def _data(plots: Sequence[Plot]) -> str:
    """Return the plots as JSON that can stand in a script element."""
    data = [
        {"id": _name(plot, plots), "choices": plot.choices, "layout": plot.layout} for plot in plots
    ]
    return json.dumps(finite(data), separators=(",", ":")).replace("<", "\\u003c")


def _name(plot: Plot, plots: Sequence[Plot]) -> str:
    """Return the id of a plot's element."""
    return f"plot{next(n for n, other in enumerate(plots) if other is plot)}"


def library() -> str:
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


def _section(section: Section, choices: Sequence[str], plots: Sequence[Plot]) -> str:
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
    wide = ' class="wide"' if len(grid.columns) > MOST_COLUMNS else ""
    return f'<div class="card"><table{wide}>{head}<tbody>{rows}</tbody></table></div>'
