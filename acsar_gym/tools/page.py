"""The HTML page of results, which `evaluate`, `benchmark` and `gap` write with `--html FILE`.

A page is a single file: plotly's script is in it, all text is escaped, and its content security
policy lets it load nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import acsar_gym
from acsar_gym import reading
from acsar_gym.errors import check_extra


@dataclass(frozen=True)
class Table:
    """Cells of text. The first column is aligned left, the others right."""

    columns: Sequence[str]
    rows: Sequence[Sequence[str]]


@dataclass(frozen=True)
class Section:
    """A heading, a paragraph, a table, then figures, whose axes name their units."""

    heading: str
    text: str = ""
    table: Table | None = None
    figures: Sequence[Any] = ()
    """Figures of plotly, and drawings as SVG text."""


def check_report_extra() -> None:
    """Check before a long run that a page can be made. MissingExtraError if not."""
    check_extra("an HTML page", "report", "jinja2", "plotly")


def write_page(path: Path, title: str, sections: Sequence[Section]) -> None:
    """Write results as an HTML file.

    Args:
        path: File to write. `reading.check_replaceable` accepts it again.
        title: Title of the page.
        sections: Sections from top to bottom.

    Raises:
        ConfigError: The file can't be written.
        MissingExtraError: jinja2 or plotly isn't installed.
    """
    check_report_extra()
    import jinja2  # noqa: PLC0415 - optional
    from plotly.offline import get_plotlyjs  # noqa: PLC0415 - optional

    def figure_html(figure: Any) -> str:
        if isinstance(figure, str):
            return figure[figure.index("<svg") :]
        options = {"displaylogo": False, "responsive": True}
        html: str = figure.to_html(full_html=False, include_plotlyjs=False, config=options)
        return html

    # Strict, so that a name that is missing is an error and not an empty cell.
    source = Path(__file__).with_name("page.html").read_text(encoding="utf-8")
    template = jinja2.Environment(
        autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined
    ).from_string(source)
    html = template.render(
        title=title,
        sections=sections,
        figure_html=figure_html,
        plotly=get_plotlyjs(),
        footer=f"acsar_gym {acsar_gym.__version__}",
    )
    reading.write_atomically(path, f"<!-- {reading.describe_origin()} -->\n{html}".encode())
