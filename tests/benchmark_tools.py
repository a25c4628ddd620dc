"""Cells of a benchmark with made-up episodes."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

from acsar_gym.tools.baselines import load_baseline
from acsar_gym.tools.benchmark.plan import Agent, Cell, Place, Plan
from acsar_gym.tools.benchmark.report import CellResult, make_result
from acsar_gym.tools.benchmark.scenes import find_sets
from acsar_gym.tools.evaluation.episode import Episode

ENV = "acsar_gym/PointGoal-v0"
SCENES = find_sets(ENV)[0]
POLICY = load_baseline("turn_drive", ENV)


def episode(number: int = 0, score: float = 0.9, **changes: Any) -> Episode:
    """An episode of the open floor, a success unless its score is 0."""
    values: dict[str, Any] = {"seed": SCENES.numbers[number], "success": score > 0.0}
    values |= {"collision": False, "score": score, "ended": 4.0, "length": 40, "path": 1.5}
    values |= {"driven": 1.5, "shortest": 1.4, "left": 0.0, "turning": 0.5, "jerk": 2.0}
    values |= {"energy": 3.0, "odometry_error": 0.01, "episode_return": 4.0}
    return Episode(**values | changes)


def cell(
    name: str = "packaged",
    kind: str = "learned",
    seed: int | None = None,
    link: str = "planar",
    condition: str = "nominal",
) -> Cell:
    """A cell of two scenes."""
    place = Place(SCENES.id, SCENES.name, link, condition)
    return Cell(Agent(name, kind, ENV, POLICY, seed), SCENES, place)


def driven(scores: Sequence[float] = (0.9, 0.8)) -> CellResult:
    """A finished cell with these scores."""
    return CellResult([episode(number, score) for number, score in enumerate(scores)], 1.5)


def result_of(cells: Mapping[Cell, CellResult]) -> dict[str, Any]:
    """The content of benchmark.json."""
    conditions = tuple(dict.fromkeys(cell.place.condition for cell in cells))
    agents = tuple(dict.fromkeys(cell.agent for cell in cells))
    links = tuple(dict.fromkeys(cell.place.link for cell in cells))
    plan = Plan(agents, (SCENES,), links, conditions, count=2).as_dict()
    read: dict[str, Any] = json.loads(json.dumps(make_result(plan, cells)))
    return read
