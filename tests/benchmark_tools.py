"""Cells of a benchmark with made-up episodes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from acsar_gym.tools.benchmark.cells import BENCHMARK_SCHEMA, Cell, CellResult
from acsar_gym.tools.benchmark.plan import CONDITIONS, condition_fields
from acsar_gym.tools.benchmark.scenes import find_sets
from acsar_gym.tools.evaluation.episode import Episode

ENV_ID = "PointGoal-v0"
SCENES = find_sets(f"acsar_gym/{ENV_ID}")[0]
SET = SCENES.name
FIRST = SCENES.numbers[0]


def episode(number: int = 0, score: float = 0.9, **changes: Any) -> Episode:
    """An episode of the open floor; it is a success where its score isn't 0."""
    values: dict[str, Any] = {"seed": FIRST + number, "success": score > 0.0, "collision": False}
    values |= {"score": score, "ended": 4.0, "length": 40, "path": 1.5, "driven": 1.5}
    values |= {"shortest": 1.4, "left": 0.0, "turning": 0.5, "jerk": 2.0, "energy": 3.0}
    values |= {"odometry_error": 0.01, "episode_return": 4.0}
    return Episode(**values | changes)


def cell(agent: str = "packaged", seed: int | None = None, **changes: str) -> Cell:
    """A nominal cell in the planar simulation."""
    places = {"id": ENV_ID, "link": "planar", "condition": "nominal", "scenes": SET} | changes
    return Cell(agent, seed, **places)


def driven(own: Cell | None = None, scores: Sequence[float] = (0.9, 0.8)) -> CellResult:
    """A finished cell."""
    return CellResult(own or cell(), [episode(n, score) for n, score in enumerate(scores)], 1.5)


def plan(*conditions: str, **kinds: str) -> dict[str, Any]:
    """The plan of agents by name and kind, with these conditions or all of them."""
    agents = {
        name: [{"kind": kind, "id": ENV_ID, "training_seed": None, "file": name, "sha256": None}]
        for name, kind in (kinds or {"packaged": "learned"}).items()
    }
    about = SCENES.about | {"count": 2}
    return {
        "schema": BENCHMARK_SCHEMA,
        "version": "0.1.0",
        "agents": agents,
        "links": ["planar"],
        "scenes": {ENV_ID: {SET: about}},
        "port_scenes": 0,
        "conditions": {
            name: condition_fields(CONDITIONS[name]) for name in conditions or CONDITIONS
        },
    }
