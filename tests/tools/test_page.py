"""The HTML page: self-contained, escaped, and with what it should show."""

from __future__ import annotations

import json
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest

from acsar_gym.reading import check_replaceable
from acsar_gym.tools.page import Section, Table, write_page

graph_objects = pytest.importorskip("plotly.graph_objects")
EVIL = '</script><script src="https://example.com/x.js"></script><img src=x onerror=alert(1)>'
LOADING = {"src", "href", "data", "action", "poster", "srcset", "formaction", "background"}


class PageReader(HTMLParser):
    """Collects elements, what they would load, and the text outside of scripts."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.loads: list[str] = []
        self.text = ""
        self.feed(html)

    def handle_starttag(self, tag: str, attrs: Any) -> None:
        self.tags.append(tag)
        self.loads += [value for name, value in attrs if name in LOADING]

    def handle_endtag(self, tag: str) -> None:
        self.tags.append("")

    def handle_data(self, data: str) -> None:
        if self.tags[-1:] == ["style"]:
            assert not re.search(r"url\(|@import", data)
        elif self.tags[-1:] != ["script"]:
            self.text += data


def test_write_page_loads_nothing_and_text_from_files_is_only_text(tmp_path: Path) -> None:
    figure = graph_objects.Figure(graph_objects.Scatter(name=EVIL, x=[0.0, 1.0], y=[1.0, None]))
    sections = [Section(EVIL, EVIL, Table([EVIL], [[EVIL]]), [figure]), Section("empty")]
    path = tmp_path / "page.html"
    write_page(path, EVIL, sections)

    html = path.read_text(encoding="utf-8")
    page = PageReader(html)
    assert page.loads == []
    assert "default-src 'none'" in html
    assert "img" not in page.tags
    assert page.tags.count("figure") == 1
    assert page.text.count(EVIL) == 6  # twice the title
    traces = re.search(r'Plotly\.newPlot\(\s*"[\w-]+",\s*(\[.*?\]),\s*\{', html, re.DOTALL)
    assert traces is not None
    assert json.loads(traces[1])[0]["name"] == EVIL
    check_replaceable(path)  # it was written by this command
