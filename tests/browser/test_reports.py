"""The HTML reports in headless Chromium: drawn whole, in both colour schemes, without network.

`make test-browser` runs these. Set ACSAR_GYM_SHOTS to a folder to keep the pictures.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from benchmark_tools import cell, part, plan
from rollout_tools import HIDDEN, driven, random_steps, recording, rollouts

from acsar_gym import RobotConfig
from acsar_gym.tools.benchmark import result
from acsar_gym.tools.benchmark.page import benchmark_page
from acsar_gym.tools.evaluation.page import ReportPage
from acsar_gym.tools.sysid import pages as sysid_pages
from acsar_gym.tools.sysid.sim_real import compare_sides
from acsar_gym.tools.sysid.twin_gap import measure_gap

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
pytestmark = pytest.mark.skipif(
    CHROMIUM is None, reason="chromium isn't installed: apt install chromium"
)
TIMEOUT = 120.0
SCHEMES = {"dark": (0, (20, 22, 26)), "light": (1, (251, 251, 250))}
"""Blink's number of each scheme, and the background in page.css."""
ACSAR = RobotConfig.preset("acsar")
PAGES = ("gap", "compare", "benchmark")


@dataclass(frozen=True)
class Seen:
    """What the browser made of a page."""

    dom: str
    console: list[str]
    requests: list[str]
    shot: Path


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with one report of each kind."""
    folder = tmp_path_factory.mktemp("pages")
    robot = ACSAR.with_(**HIDDEN)
    logs = []
    for seed in range(3):
        episode = driven(robot, random_steps(seed, 12.0, robot), phase=0.003)
        logs.append((f"log{seed}.mcap", recording(ACSAR, episode, name=f"{seed}")))
    near = ACSAR.with_(**HIDDEN | {"motor": {"time_constant": 0.136}})
    gap = measure_gap(logs, ("my_robot.yaml", near), ("acsar", ACSAR))
    sim = [("sim.mcap", rollouts(ACSAR, range(8)))]
    real = [("real.mcap", rollouts(robot.with_(max_linear=0.45), range(1, 9)))]
    made: dict[str, ReportPage] = {
        "gap": sysid_pages.gap_page(gap),
        "compare": sysid_pages.compare_page(compare_sides(sim, real)),
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
        for link, condition in (("planar", "nominal"), ("bullet", "nominal"), ("planar", "husky"))
    ]
    told = result.make_result(plan(packaged="learned", floor="baseline"), parts)
    found: dict[str, Any] = json.loads(json.dumps(told))
    return found


def opened(page: Path, scheme: str, folder: Path, height: int = 3000) -> Seen:
    """Open a page in a fresh browser, and wait until it is drawn."""
    shots = Path(os.environ.get("ACSAR_GYM_SHOTS", folder))
    shot, log = shots / f"{page.stem}_{scheme}.png", folder / "net.json"
    common = [
        str(CHROMIUM),
        *("--headless=new", "--no-sandbox", "--disable-gpu", "--hide-scrollbars"),
        *("--no-first-run", "--host-resolver-rules=MAP * ~NOTFOUND"),
        f"--blink-settings=preferredColorScheme={SCHEMES[scheme][0]}",
        *(f"--window-size=1200,{height}", "--virtual-time-budget=20000"),
        *("--enable-logging=stderr", "--v=0", f"--user-data-dir={folder / 'profile'}"),
    ]
    url = page.as_uri()
    dom = ran([*common, f"--log-net-log={log}", "--dump-dom", url])
    ran([*common, f"--screenshot={shot}", url])
    console = re.findall(r"CONSOLE.*", dom.stderr)
    return Seen(dom.stdout, console, requests(log), shot)


def ran(command: list[str]) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, check=True, capture_output=True, text=True, timeout=TIMEOUT)


def requests(log: Path) -> list[str]:
    """Addresses that the page asked for; those of the browser itself have no origin."""
    events = json.loads(log.read_text(encoding="utf-8"))["events"]
    asked = [event["params"] for event in events if "initiator" in event.get("params", {})]
    urls = {one["url"] for one in asked if one["initiator"] != "not an origin"}
    return sorted(url for url in urls if not url.startswith(("file:", "data:", "blob:")))


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("name", PAGES)
def test_a_report_is_drawn(name: str, scheme: str, pages: Path, tmp_path: Path) -> None:
    seen = opened(pages / f"{name}.html", scheme, tmp_path)
    assert seen.console == []
    assert seen.requests == []
    plots = seen.dom.count('role="img"')
    assert f'data-drawn="{plots}"' in seen.dom
    assert seen.dom.count('class="main-svg"') >= 2 * plots
    assert "NaN" not in re.sub(r"<script.*?</script>", "", seen.dom, flags=re.DOTALL)
    background(seen.shot, scheme)


def test_scheme_and_episode_can_be_chosen(pages: Path, tmp_path: Path) -> None:
    click = """<script>
      document.getElementById("theme").click();
      picker.value = "2";
      picker.dispatchEvent(new Event("change"));
    </script></body>"""
    html = (pages / "gap.html").read_text(encoding="utf-8")
    page = tmp_path / "clicked.html"
    page.write_text(html.replace("</body>", click), encoding="utf-8")
    seen = opened(page, "light", tmp_path)
    assert seen.console == []
    assert 'data-theme="dark"' in seen.dom
    background(seen.shot, "dark")
    other = opened(pages / "gap.html", "dark", tmp_path)
    assert seen.shot.read_bytes() != other.shot.read_bytes()


def test_a_page_that_loads_or_fails_would_be_found(tmp_path: Path) -> None:
    page = tmp_path / "bad.html"
    page.write_text('<img src="http://example.com/a.png"><script>oh()</script>', encoding="utf-8")
    seen = opened(page, "light", tmp_path)
    assert seen.requests == ["http://example.com/a.png"]
    assert "oh is not defined" in " ".join(seen.console)


def background(shot: Path, scheme: str) -> None:
    """The corner of the picture has the background of the scheme, and most isn't empty."""
    image = pytest.importorskip("PIL.Image").open(shot).convert("RGB")
    assert image.getpixel((3, 3)) == SCHEMES[scheme][1]
    assert len(set(image.resize((300, 750)).getdata())) > 200
