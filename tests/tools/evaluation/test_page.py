"""The HTML file: self-contained, escaped, and with what it should show."""

from __future__ import annotations

import json
import sys
from html.parser import HTMLParser
from typing import Any

import numpy as np
import pytest

from acsar_gym.errors import MissingExtraError
from acsar_gym.tools.evaluation.page import (
    MAX_LINE_POINTS,
    Grid,
    PageSection,
    Plot,
    ReportPage,
    line_trace,
    stairs_trace,
)

pytest.importorskip("plotly")
EVIL = '</script><script src="https://example.com/x.js"></script><img src=x onerror=alert(1)>'
LOADING = {"src", "href", "data", "action", "poster", "srcset", "formaction", "background"}


class Reader(HTMLParser):
    """Collects elements, what they would load, and the text of scripts."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.loads: list[str] = []
        self.scripts: list[str] = []
        self.said = ""
        self._inside = ""
        self.feed(html)

    def handle_starttag(self, tag: str, attrs: Any) -> None:
        self.tags.append(tag)
        self._inside = tag
        self.loads += [value for name, value in attrs if name in LOADING]
        self.loads += [v for n, v in attrs if n == "style" and "url(" in v]

    def handle_endtag(self, tag: str) -> None:
        self._inside = ""

    def handle_data(self, data: str) -> None:
        if self._inside == "script":
            self.scripts.append(data)
        elif self._inside == "style":
            assert "url(" not in data
            assert "@import" not in data
        else:
            self.said += data


def evil_page() -> ReportPage:
    plot = Plot(EVIL, [[line_trace(EVIL, [0.0, 1.0], [1.0, np.nan], "--robot")]], {"title": EVIL})
    section = PageSection(
        EVIL, EVIL, [Grid([EVIL], [[EVIL]]), plot], [("--robot", EVIL)], picks=True
    )
    return ReportPage(EVIL, EVIL, [EVIL], [], [section], [EVIL, EVIL], [EVIL], EVIL)


def test_text_from_files_is_only_text() -> None:
    page = Reader(evil_page().html())
    assert page.loads == []
    assert page.tags.count("script") == 3
    assert "img" not in page.tags
    data = json.loads(page.scripts[0])
    assert data[0]["choices"][0][0]["name"] == EVIL
    assert data[0]["choices"][0][0]["y"] == [1.0, None]
    assert page.said.count(EVIL) >= 8


def test_plotly_is_an_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "plotly.offline", None)
    with pytest.raises(MissingExtraError, match=r"\[report\]"):
        evil_page().html()


def test_long_lines_are_thinned_and_stairs_keep_their_corners() -> None:
    assert len(line_trace("x", range(99_999), range(99_999), "--robot")["x"]) <= MAX_LINE_POINTS
    steps = stairs_trace("x", range(6), [0, 0, 0, 1, 1, 2], "--robot")
    assert (steps["x"], steps["y"]) == ([0.0, 3.0, 5.0], [0.0, 1.0, 2.0])
