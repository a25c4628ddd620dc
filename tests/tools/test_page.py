"""The HTML page: self-contained, escaped, and with what it should show."""

from __future__ import annotations

import json
import re
from html import unescape
from pathlib import Path

import pytest

from acsar_gym.reading import check_replaceable
from acsar_gym.tools.page import Section, Table, write_page

graph_objects = pytest.importorskip("plotly.graph_objects")
EVIL = '</script><script src="https://example.com/x.js"></script><img src=x onerror=alert(1)>'
LOADING = r"\b(src|href|data|action|poster|srcset|formaction|background)\s*="


def test_write_page_loads_nothing_and_text_from_files_is_only_text(tmp_path: Path) -> None:
    figure = graph_objects.Figure(graph_objects.Scatter(name=EVIL, x=[0.0, 1.0], y=[1.0, None]))
    sections = [Section(EVIL, EVIL, Table([EVIL], [[EVIL]]), [figure]), Section("empty")]
    path = tmp_path / "page.html"
    write_page(path, EVIL, sections)

    html = path.read_text(encoding="utf-8")
    assert "default-src 'none'" in html
    assert "<script src" not in html
    markup = re.sub(r"<script[^>]*>.*?</script>", "", html, flags=re.DOTALL)
    tags = re.findall(r"<[a-z][^>]*>", markup)
    assert not any(re.search(LOADING, tag) for tag in tags)
    assert not re.search(r"url\(|@import|<img", markup)
    assert markup.count("<figure") == 1
    assert unescape(markup).count(EVIL) == 6  # twice the title
    traces = re.search(r'Plotly\.newPlot\(\s*"[\w-]+",\s*(\[.*?\]),\s*\{', html, re.DOTALL)
    assert traces is not None
    assert json.loads(traces[1])[0]["name"] == EVIL
    check_replaceable(path)  # it was written by this command
