"""The HTML reports in headless Chromium: drawn whole, in both colour schemes, without network.

`make test-browser` runs these. Set ACSAR_GYM_SHOTS to a folder to keep the pictures.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from benchmark_tools import cell, part, plan
from browser_tools import CHROMIUM, Tab, browser

from acsar_gym.tools.benchmark import result
from acsar_gym.tools.benchmark.page import benchmark_page
from acsar_gym.tools.evaluation.page import ReportPage

pytestmark = pytest.mark.skipif(
    CHROMIUM is None, reason="chromium isn't installed: apt install chromium"
)
SCHEMES = {"dark": (20, 22, 26), "light": (251, 251, 250)}
"""The background of each in page.css."""
DRAWN = "document.documentElement?.dataset.drawn"
PAGES = ("benchmark",)


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with one report of each kind."""
    folder = tmp_path_factory.mktemp("pages")
    made: dict[str, ReportPage] = {
        "benchmark": benchmark_page(benchmark()),
    }
    for name, page in made.items():
        page.write(folder / f"{name}.html")
    return folder


def benchmark() -> dict[str, Any]:
    """Results with several agents, links and conditions."""
    scores = (0.9, 0.0, 0.5, 0.7)
    parts = [
        part(cell(agent, link=link, condition=condition), scores)
        for agent in ("packaged", "floor")
        for link, condition in (
            ("planar", "nominal"),
            ("bullet", "nominal"),
            ("planar", "dropped-5"),
        )
    ]
    told = result.make_result(plan(packaged="learned", floor="baseline"), parts)
    found: dict[str, Any] = json.loads(json.dumps(told))
    return found


@contextmanager
def opened(page: Path, scheme: str, folder: Path) -> Iterator[Tab]:
    """A page in a fresh browser."""
    with browser(folder) as tab:
        media = [{"name": "prefers-color-scheme", "value": scheme}]
        tab.call("Emulation.setEmulatedMedia", features=media)
        tab.open(page.as_uri(), 1200, 3000)
        yield tab


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("name", PAGES)
def test_a_report_is_drawn(name: str, scheme: str, pages: Path, tmp_path: Path) -> None:
    with opened(pages / f"{name}.html", scheme, tmp_path) as tab:
        tab.wait(DRAWN, "a page that is drawn")
        html = tab.run("document.documentElement.outerHTML")
        plots = html.count('role="img"')
        assert tab.run(DRAWN) == str(plots)
        assert html.count('class="main-svg"') >= 2 * plots
        assert "NaN" not in re.sub(r"<script.*?</script>", "", html, flags=re.DOTALL)
        background(tab.shot(f"{name}_{scheme}", tmp_path), scheme)
        assert (tab.console, tab.foreign) == ([], [])


@pytest.mark.parametrize("width", [1300, 1000])
@pytest.mark.parametrize("name", PAGES)
def test_no_table_is_cut(name: str, width: int, pages: Path, tmp_path: Path) -> None:
    """What is wider than the page can be scrolled to."""
    with browser(tmp_path) as tab:
        tab.open((pages / f"{name}.html").as_uri(), width, 900)
        tab.wait(DRAWN, "a page that is drawn")
        cut = "[...document.querySelectorAll('.card')].filter(c => c.scrollWidth > c.clientWidth)"
        if width == 1300:
            assert tab.run(f"{cut}.length") == 0
        assert tab.run(f"{cut}.every(c => getComputedStyle(c).overflowX == 'auto')")
        assert tab.run("document.documentElement.scrollWidth <= innerWidth")


def test_a_page_that_loads_or_fails_would_be_found(tmp_path: Path) -> None:
    page = tmp_path / "bad.html"
    page.write_text('<img src="http://example.com/a.png"><script>oh()</script>', encoding="utf-8")
    with opened(page, "light", tmp_path) as tab:
        tab.wait("document.readyState == 'complete' && document.images.length", "the page")
        assert tab.foreign == ["http://example.com/a.png"]
        assert "oh is not defined" in " ".join(tab.console)


def background(shot: Path, scheme: str) -> None:
    """The corner of the picture has the background of the scheme, and most isn't empty."""
    image = pytest.importorskip("PIL.Image").open(shot).convert("RGB")
    assert image.getpixel((3, 3)) == SCHEMES[scheme]
    assert len(set(image.resize((300, 750)).getdata())) > 200
