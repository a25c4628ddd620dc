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


def best(some: Sequence[Row]) -> list[dict[str, Any]]:
    """Compare the best learned agent with the best baseline of each nominal place.

    The best are those with the highest interquartile mean of the score.
    """
    found = []
    for place, group in by_place(some).items():
        ours = next((row for row in group if row.kind == LEARNED), None)
        other = next((row for row in group if row.kind == BASELINE), None)
        if place[3] == NOMINAL and ours is not None and other is not None:
            found.append(_compared(place, ours, other))
    return found


def _compared(place: Place, ours: Row, other: Row) -> dict[str, Any]:
    """Compare two rows by score and success."""
    told: dict[str, Any] = {
        "id": place[0],
        "scenes": place[1],
        "link": place[2],
        "learned": ours.agent,
        "baseline": other.agent,
    }
    figures = {
        "score_iqm": ("score", statistics.iqm),
        "success_rate": ("success", statistics.mean),
    }
    for name, (figure, statistic) in figures.items():
        values = [row.matrix(figure) for row in (ours, other)]
        both = [statistics.overall([each], statistic) for each in values]
        ends = [statistics.interval([each], statistic) for each in values]
        told[name] = {
            "learned": both[0],
            "baseline": both[1],
            "better": both[0] > both[1],
            "learned_interval": ends[0],
            "baseline_interval": ends[1],
            "apart": statistics.apart(*ends),
        }
    return told


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
