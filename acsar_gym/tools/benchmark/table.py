"""The rows of a benchmark's table: figures of agents over few training seeds, and comparisons.

Intervals of scores and means are those of the bootstrap over training seeds and scenes, see
`metrics.bootstrap_interval`. An agent without training has one seed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acsar_gym.tools.benchmark.agents import BASELINE
from acsar_gym.tools.benchmark.plan import Cell, Place
from acsar_gym.tools.evaluation import provenance
from acsar_gym.tools.evaluation.episode import Episode
from acsar_gym.tools.evaluation.metrics import (
    bootstrap_interval,
    measure_figures,
    replace_nonfinite,
)

BENCHMARK_SCHEMA = 6
"""Version of `benchmark.json`."""
COMPARED = ("score", "success")
"""Fields of `Episode` by whose means agents are compared with the best baseline."""


@dataclass(frozen=True)
class CellResult:
    """The episodes of a cell, in the order of its scenes."""

    episodes: list[Episode] = field(default_factory=list)
    seconds: float = 0.0
    """CPU time that it took [s]."""
    refused: str = ""
    """Why the agent couldn't drive there. Empty if it did."""


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

    def matrix(self, name: str) -> NDArray[np.float64]:
        """Return a field of `Episode`, (training seeds, scenes)."""
        return np.array([[getattr(e, name) for e in group] for group in self.groups], np.float64)

    def mean(self, name: str) -> float:
        """Return the mean of a field over all episodes."""
        return float(self.matrix(name).mean()) if self.groups else 0.0

    def as_dict(self, rivals: Sequence[AgentRow]) -> dict[str, Any]:
        """Return figures, intervals and differences to the best baseline of `rivals`, for JSON."""
        about = {"agent": self.agent, "kind": self.kind, **self.place._asdict()}
        about["refused"] = "" if self.groups else self.refused
        if not self.groups:
            return about
        return about | {
            "training_seeds": self.seeds,
            "episodes": sum(map(len, self.groups)),
            **measure_figures(self.groups),
            "seed_scores": self.matrix("score").mean(axis=1).tolist(),
            "seed_success": self.matrix("success").mean(axis=1).tolist(),
            "differences": {name: self._compare(name, rivals) for name in COMPARED},
        }

    def _compare(self, name: str, rivals: Sequence[AgentRow]) -> dict[str, Any] | None:
        """Compare with the best baseline, in pairs of episodes of the same scene and seed.

        Of baselines that succeed equally often, the best has the highest score. None if there is
        no other baseline.
        """
        baselines = [row for row in rivals if row.kind == BASELINE and row.groups]
        best = max(baselines, key=lambda row: (row.mean(name), row.mean("score")), default=self)
        if best is self:
            return None

        # A baseline has one seed, with which each training seed is compared.
        differences = self.matrix(name) - best.matrix(name)[:1]
        return {
            "over": best.agent,
            "difference": float(differences.mean()),
            "interval": bootstrap_interval(differences),
        }


def make_rows(cells: Mapping[Cell, CellResult]) -> list[AgentRow]:
    """Group cells to rows, of all training seeds of an agent, the best score of a place first."""
    rows: dict[tuple[Place, str], AgentRow] = {}
    for cell, result in cells.items():
        agent = cell.agent
        row = AgentRow(agent.name, agent.kind, cell.place)
        row = rows.setdefault((cell.place, agent.name), row)
        row.refused = row.refused or result.refused
        if result.episodes:
            row.seeds.append(agent.training_seed)
            row.groups.append(result.episodes)
    # The order of the plan, and the best agent first.
    places = list(dict.fromkeys(place for place, _ in rows))
    return sorted(rows.values(), key=lambda row: (places.index(row.place), -row.mean("score")))


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
        | | `sha256`, ...), `agents`, by name, `conditions`, by name, `links` |
        | `cells` | a list: agent, training seed and place, `refused` (why it couldn't drive, |
        | | else ""), `seconds`, and `episodes`: the fields of every `Episode` |
        | `rows` | figures over all training seeds of an agent at a place, with `intervals`, |
        | | and `differences` of score and success to the best baseline in the same scenes |
    """
    rows = make_rows(cells)
    versions = provenance.library_versions(*provenance.DRIVING_LIBRARIES)
    result: dict[str, Any] = replace_nonfinite(
        {
            "schema": BENCHMARK_SCHEMA,
            "header": {"versions": versions, **plan},
            "cells": [{**cell.about, **vars(result)} for cell, result in cells.items()],
            "rows": [
                row.as_dict([rival for rival in rows if rival.place == row.place]) for row in rows
            ],
        }
    )
    return result
