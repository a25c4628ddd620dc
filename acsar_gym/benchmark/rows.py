"""Rows of the table: an agent's figures on an id over all its training seeds."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from acsar_gym.benchmark import statistics
from acsar_gym.benchmark.agents import LEARNED
from acsar_gym.benchmark.conditions import NOMINAL
from acsar_gym.benchmark.figures import summary
from acsar_gym.benchmark.statistics import Floats
from acsar_gym.benchmark.store import Cell, Episode, Part

Place = tuple[str, str, str, str]
"""Id, set of scenes, link and condition, which the rows to be compared share."""


@dataclass
class CellResult:
    """All finished episodes of a cell, in the order of the scenes."""

    cell: Cell
    episodes: list[Episode] = field(default_factory=list)
    seconds: float = 0.0
    refused: str = ""


@dataclass
class Row:
    """An agent behind one link, with all its training seeds."""

    agent: str
    kind: str
    place: Place
    seeds: list[CellResult] = field(default_factory=list)

    @property
    def refused(self) -> str:
        """Why none of its seeds could drive here; empty if one could."""
        return "" if self.driven else self.seeds[0].refused

    @property
    def driven(self) -> list[CellResult]:
        """The seeds that drove."""
        return [each for each in self.seeds if each.episodes]

    @property
    def episodes(self) -> list[Episode]:
        """Episodes of all seeds."""
        return [episode for each in self.driven for episode in each.episodes]

    def matrix(self, figure: str) -> Floats:
        """(seeds, scenes) of a field of `Episode`; as many scenes as all seeds have."""
        every = [[float(getattr(e, figure)) for e in each.episodes] for each in self.driven]
        common = min(map(len, every), default=0)
        return np.array([row[:common] for row in every]).reshape(len(every), common)

    @property
    def worst_seed(self) -> float:
        """Least success rate of a seed."""
        return float(self.matrix("success").mean(axis=1).min())

    @property
    def median_seed(self) -> float:
        """Median success rate of the seeds."""
        return float(np.median(self.matrix("success").mean(axis=1)))

    def as_dict(self) -> dict[str, Any]:
        """Return the figures with their intervals, for JSON."""
        env_id, scenes, link, condition = self.place
        told: dict[str, Any] = {
            "agent": self.agent,
            "kind": self.kind,
            "id": env_id,
            "scenes": scenes,
            "link": link,
            "condition": condition,
            "refused": self.refused,
        }
        if self.refused:
            return told
        score = self.matrix("score")
        return told | {
            "training_seeds": [each.cell.training_seed for each in self.driven],
            "scene_count": score.shape[1],
            **summary(self.episodes),
            "success_worst_seed": self.worst_seed,
            "success_median_seed": self.median_seed,
            "score_iqm": statistics.overall([score]),
            "intervals": self._intervals(score),
            "profile": statistics.performance_profile(score),
        }

    def _intervals(self, score: Floats) -> dict[str, Any]:
        """Stratified bootstrap intervals; of all but the score under nominal conditions only."""
        found: dict[str, Any] = {"score_iqm": statistics.interval([score])}
        fields = {"success_rate": "success", "spl": "spl", "barn_score_own": "barn_score_own"}
        for name, figure in fields.items():
            values = self.matrix(figure)
            if self.place[3] == NOMINAL and np.isfinite(values).all():
                found[name] = statistics.interval([values], statistics.mean)
        return found


def cells(parts: Iterable[Part]) -> list[CellResult]:
    """Put the parts of each cell together."""
    found: dict[Cell, CellResult] = {}
    for part in sorted(parts, key=lambda part: part.first):
        cell = found.setdefault(part.cell, CellResult(part.cell))
        cell.episodes += part.episodes
        cell.seconds += part.seconds
        cell.refused = cell.refused or part.refused
    return list(found.values())


def rows(found: Sequence[CellResult], kinds: Mapping[str, str]) -> list[Row]:
    """Group cells by agent and place.

    Args:
        found: the cells.
        kinds: "learned" or "baseline" by agent.
    """
    grouped: dict[tuple[str, Place], Row] = {}
    for each in found:
        cell = each.cell
        place = cell.id, cell.scenes, cell.link, cell.condition
        row = Row(cell.agent, kinds.get(cell.agent, LEARNED), place)
        grouped.setdefault((cell.agent, place), row).seeds.append(each)
    return list(grouped.values())
