"""The HTML page in headless Chromium: drawn whole, without network. `make test-browser` runs it."""

from __future__ import annotations

import html
import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest
from benchmark_tools import cell, driven, result_of

from acsar_gym.tools.benchmark import report

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
TIMEOUT = 300.0
"""Longest wait for the browser [s]."""
pytestmark = pytest.mark.skipif(
    CHROMIUM is None, reason="chromium isn't installed: apt install chromium"
)
NOTE_ERRORS = """<script>
var errors = [];
addEventListener("error", event => errors.push(String(event.message || event.target.src)), true);
</script>"""
MEASURE = """<script>
addEventListener("load", () => setTimeout(() => {
  const all = selector => [...document.querySelectorAll(selector)];
  const result = document.createElement("pre");
  result.id = "result";
  result.innerText = JSON.stringify({
    plots: all("figure svg").length,
    cells: all("td").map(cell => cell.innerText),
    scroll: all(".card").map(card => getComputedStyle(card).overflowX),
    cut: all(".card").filter(card => card.scrollWidth > card.clientWidth).length,
    wide: document.documentElement.scrollWidth > innerWidth,
    loaded: performance.getEntriesByType("resource").map(entry => entry.name),
    errors: errors,
  });
  document.body.append(result);
}, 2000));
</script>"""


def look(page: Path, folder: Path, width: int) -> Any:
    """Open a page in a browser that can't resolve any name, and return what is measured there."""
    copy = folder / "page.html"
    copy.write_text(page.read_text().replace("<head>", f"<head>{NOTE_ERRORS}") + MEASURE)
    command = [
        str(CHROMIUM),
        *("--headless=new", "--no-sandbox", "--hide-scrollbars", f"--window-size={width},2000"),
        *("--no-first-run", "--host-resolver-rules=MAP * ~NOTFOUND"),
        *(f"--user-data-dir={folder / 'profile'}", "--virtual-time-budget=10000", "--dump-dom"),
        copy.as_uri(),
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=TIMEOUT)
    (result,) = re.findall('<pre id="result">(.*?)</pre>', done.stdout, re.DOTALL)
    return json.loads(html.unescape(result))


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
def test_page_is_drawn_and_no_table_is_cut(width: int, page: Path, tmp_path: Path) -> None:
    """At 1300 pixels nothing has to be scrolled."""
    result = look(page, tmp_path, width)
    assert result["plots"] >= 1
    assert result["cells"]
    assert "NaN" not in result["cells"]
    assert set(result["scroll"]) == {"auto"}
    assert not result["wide"]
    if width == 1300:
        assert result["cut"] == 0
    assert [name for name in result["loaded"] if not name.startswith(("data:", "file:"))] == []
    assert result["errors"] == []
