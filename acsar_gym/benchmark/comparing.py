"""Comparisons between agents in the same scenes: who is better, and how surely."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from acsar_gym.benchmark import statistics
from acsar_gym.benchmark.agents import BASELINE, LEARNED
from acsar_gym.benchmark.conditions import NOMINAL
from acsar_gym.benchmark.rows import Place, Row


def by_place(some: Iterable[Row]) -> dict[Place, list[Row]]:
    """Group the rows that drove by place, the best score first."""
    found: dict[Place, list[Row]] = {}
    for row in some:
        if row.driven:
            found.setdefault(row.place, []).append(row)
    for group in found.values():
        group.sort(key=lambda row: -statistics.overall([row.matrix("score")]))
    return found


COMPARED = {
    "success_rate": ("success", statistics.mean),
    "score_iqm": ("score", statistics.iqm),
}
"""The figures that the best are compared by: a field of `Episode`, and the statistic of it."""


def best(some: Sequence[Row]) -> list[dict[str, Any]]:
    """Compare the best learned agent with the best baseline of each nominal place.

    Each figure has its own best agents: the baseline with the highest score may not be the one that
    succeeds most often.
    """
    found = []
    for place, group in by_place(some).items():
        for figure in COMPARED if place[3] == NOMINAL else ():
            ours, other = (_first(group, kind, figure) for kind in (LEARNED, BASELINE))
            if ours is not None and other is not None:
                found.append(_compared(figure, ours, other))
    return found


def _first(group: Iterable[Row], kind: str, figure: str) -> Row | None:
    """The row of a kind with the highest figure; None where there is none."""
    own = (row for row in group if row.kind == kind)
    return max(own, key=lambda row: _value(row, figure), default=None)


def _value(row: Row, figure: str) -> float:
    """A figure of COMPARED over all seeds and scenes of a row."""
    name, statistic = COMPARED[figure]
    return statistics.overall([row.matrix(name)], statistic)


def _compared(figure: str, ours: Row, other: Row) -> dict[str, Any]:
    """Compare two rows of one place by a figure."""
    name, statistic = COMPARED[figure]
    values = [_value(row, figure) for row in (ours, other)]
    ends = [statistics.interval([row.matrix(name)], statistic) for row in (ours, other)]
    return {
        "id": ours.place[0],
        "scenes": ours.place[1],
        "link": ours.place[2],
        "figure": figure,
        "learned": ours.agent,
        "baseline": other.agent,
        "learned_value": values[0],
        "baseline_value": values[1],
        "better": values[0] > values[1],
        "learned_interval": ends[0],
        "baseline_interval": ends[1],
        "apart": statistics.apart(*ends),
    }


def improvements(some: Sequence[Row]) -> list[dict[str, Any]]:
    """Return the probability that each learned agent improves on each other agent, by score."""
    found = []
    for place, group in by_place(some).items():
        for ours in (row for row in group if row.kind == LEARNED and place[3] == NOMINAL):
            for other in (row for row in group if row is not ours):
                x, y = ours.matrix("score"), other.matrix("score")
                common = min(x.shape[1], y.shape[1])
                x, y = x[:, :common], y[:, :common]
                found.append(
                    {
                        "id": place[0],
                        "scenes": place[1],
                        "link": place[2],
                        "agent": ours.agent,
                        "over": other.agent,
                        "probability": statistics.probability_of_improvement(x, y),
                        "interval": statistics.improvement_interval(x, y),
                    }
                )
    return found
