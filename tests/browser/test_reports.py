"""The HTML page in headless Chromium: drawn whole, without network.

`make test-browser` runs these. Set ACSAR_GYM_SHOTS to a folder to keep the pictures.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from benchmark_tools import cell, driven, result_of
from browser_tools import CHROMIUM, browser

from acsar_gym.tools.benchmark import report

pytestmark = pytest.mark.skipif(
    CHROMIUM is None, reason="chromium isn't installed: apt install chromium"
)


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page of a benchmark with several agents, links and conditions."""
    scores = (0.9, 0.0, 0.5, 0.7)
    cells = {
        cell(agent, kind, seed, link, condition): driven(scores)
        for agent, kind, seed in (
            ("packaged", "learned", None),
            ("own", "learned", 0),
            ("own", "learned", 1),
            *((name, "baseline", None) for name in ("navfn", "dwa", "dwa_movers", "orca")),
        )
        for link, condition in (
            ("planar", "nominal"),
            ("bullet", "nominal"),
            ("planar", "dropped-5"),
        )
    }
    path = tmp_path_factory.mktemp("pages") / "benchmark.html"
    report.write_benchmark_page(path, result_of(cells))
    return path


@pytest.mark.parametrize("width", [1300, 1000])
def test_a_page_is_drawn_and_no_table_is_cut(width: int, page: Path, tmp_path: Path) -> None:
    """At 1300 pixels nothing has to be scrolled."""
    with browser(tmp_path) as tab:
        tab.open(page.as_uri(), width, 2000)
        tab.wait("document.querySelectorAll('figure svg').length >= 1", "a plot that is drawn")
        assert tab.run("[...document.querySelectorAll('td')].every(c => c.innerText != 'NaN')")
        cards = "[...document.querySelectorAll('.card')]"
        assert tab.run(f"{cards}.every(c => getComputedStyle(c).overflowX == 'auto')")
        if width == 1300:
            assert tab.run(f"{cards}.every(c => c.scrollWidth <= c.clientWidth)")
        assert tab.run("document.documentElement.scrollWidth <= innerWidth")
        shot = pytest.importorskip("PIL.Image").open(tab.shot(f"page_{width}", tmp_path))
        assert len(set(shot.convert("RGB").resize((300, 500)).getdata())) > 100
        assert (tab.console, tab.foreign) == ([], [])
