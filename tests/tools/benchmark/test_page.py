"""The HTML report of a benchmark with made-up episodes."""

from __future__ import annotations

import json
import re
from html import unescape
from typing import Any

import pytest
from benchmark_tools import cell, part, plan

from acsar_gym.tools.benchmark import result
from acsar_gym.tools.benchmark.page import benchmark_page
from acsar_gym.tools.benchmark.store import Part

pytest.importorskip("plotly")
KINDS = {"packaged": "learned", "floor": "baseline", "other": "baseline"}
PARTS = [
    part(cell(), (0.9, 0.0, 0.5, 0.7)),
    part(cell(link="bullet"), (0.9, 0.8, 0.0, 0.2)),
    part(cell("floor"), (0.5, 0.4, 0.0, 0.0)),
    part(cell(condition="dropped-5"), (0.5, 0.0)),
    Part(cell("other"), 0, refused="other: needs a LiDAR"),
]


@pytest.fixture(scope="module")
def told() -> dict[str, Any]:
    found: dict[str, Any] = json.loads(json.dumps(result.make_result(plan(**KINDS), PARTS)))
    return found


def test_the_page_has_tables_plots_and_provenance(told: dict[str, Any]) -> None:
    made = benchmark_page(told)
    titles = [section.title for section in made.sections]
    assert titles == [
        "PointGoal-v0, open/acsar",
        "Probability of improvement",
        "Robustness",
        "Provenance",
    ]
    html = unescape(made.html())
    for words in ("packaged", "75.0%", "other doesn't drive PointGoal-v0", "5 % of the lines"):
        assert words in html
    assert told["header"]["scenes"]["PointGoal-v0"]["open/acsar"]["sha256"] in html
    assert not re.findall(r"<(?:img|script|link)[^>]+(?:src|href)=", html)
