"""The rows of a benchmark's table: figures of agents over few training seeds, and comparisons.

Intervals of scores and means are those of the bootstrap over training seeds and scenes, see
`metrics.bootstrap_interval`. An agent without training has one seed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acsar_gym.errors import require_extra
from acsar_gym.tools.benchmark.agents import BASELINE
from acsar_gym.tools.benchmark.plan import Cell, Place
from acsar_gym.tools.evaluation import metrics, provenance
from acsar_gym.tools.evaluation.episode import Episode
from acsar_gym.tools.evaluation.metrics import TOLD_PREFIX, bootstrap_interval

Floats = NDArray[np.float64]
BENCHMARK_SCHEMA = 5
"""Version of `benchmark.json`."""
TRIM = 0.25
"""Share that the interquartile mean leaves out on each side."""
COMPARED = ("score", "success")
"""Fields of `Episode` by whose means agents are compared with the best baseline."""


@dataclass(frozen=True)
class CellResult:
    """The episodes of a cell, in the order of its scenes."""

    episodes: list[Episode] = field(default_factory=list)
    seconds: float = 0.0
    """CPU time that it took [s]."""
    refused: str = ""
    """Why the agent couldn't drive there; empty if it did."""


@dataclass
class AgentRow:
    """An agent at a place, over all its training seeds."""

    agent: str
    kind: str
    place: Place
    seeds: list[int | None] = field(default_factory=list)
    groups: list[list[Episode]] = field(default_factory=list)
    """Episodes of each training seed that drove."""
    refused: str = ""

    def matrix(self, figure: str) -> Floats:
        """Return a field of `Episode`, (training seeds, scenes)."""
        return np.array(
            [[float(getattr(episode, figure)) for episode in group] for group in self.groups]
        )

    def as_dict(self, others: Sequence[AgentRow]) -> dict[str, Any]:
        """Return figures, intervals and differences to the best baseline of `others`, for JSON."""
        about = {
            "agent": self.agent,
            "kind": self.kind,
            **self.place._asdict(),
            "refused": "" if self.groups else self.refused,
        }
        if not self.groups:
            return about
        with require_extra("a benchmark", "scipy"):
            from scipy.stats import trim_mean  # noqa: PLC0415 - slow to import

        episodes = [episode for group in self.groups for episode in group]
        scores = self.matrix("score")
        numbers = metrics.average_told(episodes)
        intervals = metrics.find_intervals(self.groups)
        intervals |= {
            "score": bootstrap_interval(scores),
            "score_iqm": bootstrap_interval(scores, trim=TRIM),
        }
        return about | {
            "training_seeds": self.seeds,
            "episodes": len(episodes),
            "score": metrics.finite_mean(scores.ravel()),
            "score_iqm": float(trim_mean(scores.ravel(), TRIM)),
            **metrics.average(episodes),
            **{f"{TOLD_PREFIX}{name}": value for name, value in numbers.items()},
            "intervals": intervals,
            "seed_scores": scores.mean(axis=1).tolist(),
            "seed_success": self.matrix("success").mean(axis=1).tolist(),
            "differences": {name: self._compare(name, others) for name in COMPARED},
        }

    def _compare(self, figure: str, others: Sequence[AgentRow]) -> dict[str, Any] | None:
        """Compare with the best baseline, in pairs of episodes of the same scene and seed.

        Of baselines that succeed equally often, the best is the one with the highest score. None
        if there is no other baseline.
        """
        baselines = [row for row in others if row.kind == BASELINE and row.groups]
        baselines.sort(key=lambda row: -row.matrix("score").mean())
        best = max(baselines, key=lambda row: row.matrix(figure).mean(), default=self)
        if best is self:
            return None
        differences = self.matrix(figure) - best.matrix(figure)[:1]
        return {
            "over": best.agent,
            "difference": float(differences.mean()),
            "interval": bootstrap_interval(differences),
        }


def make_rows(cells: Mapping[Cell, CellResult]) -> list[AgentRow]:
    """Group cells to rows, of all training seeds of an agent."""
    rows: dict[tuple[str, Place], AgentRow] = {}
    for cell, result in cells.items():
        agent = cell.agent
        row = AgentRow(agent.name, agent.kind, cell.place)
        row = rows.setdefault((agent.name, cell.place), row)
        row.refused = row.refused or result.refused
        if result.episodes:
            row.seeds.append(agent.training_seed)
            row.groups.append(result.episodes)
    return list(rows.values())


def make_result(plan: Mapping[str, Any], cells: Mapping[Cell, CellResult]) -> dict[str, Any]:
    """Compute the content of `benchmark.json`.

    Args:
        plan: The plan, as `Plan.as_dict`.
        cells: The cells and their results.

    Returns:
        | key | content |
        |---|---|
        | `schema` | `BENCHMARK_SCHEMA` |
        | `header` | `versions`, and the plan: `scenes`, by id and set (`robot`, `score`, |
        | | `sha256`, ...); `agents`, by name; `conditions`, by name; `links` |
        | `cells` | a list: agent, training seed and place, `refused` (why it couldn't drive, |
        | | else ""), `seconds`, and `episodes`: the fields of every `Episode` |
        | `rows` | figures over all training seeds of an agent at a place, with `intervals`, |
        | | and `differences` of score and success to the best baseline in the same scenes |
    """
    rows = make_rows(cells)
    result: dict[str, Any] = {
        "schema": BENCHMARK_SCHEMA,
        "header": {
            "versions": provenance.library_versions(*provenance.DRIVING_LIBRARIES),
            **plan,
        },
        "cells": [describe_cell(cell, result) for cell, result in cells.items()],
        "rows": [
            row.as_dict([rival for rival in rows if rival.place == row.place]) for row in rows
        ],
    }
    cleaned: dict[str, Any] = metrics.replace_nonfinite(result)
    return cleaned


def describe_cell(cell: Cell, result: CellResult) -> dict[str, Any]:
    """Return a cell and its result for JSON."""
    cleaned: dict[str, Any] = metrics.replace_nonfinite(asdict(result))
    return {**cell.about, **cleaned}
