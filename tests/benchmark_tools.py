"""Parts of a benchmark with made-up episodes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from acsar_gym.tools.benchmark.plan import CONDITIONS, condition_fields
from acsar_gym.tools.benchmark.scenes import find_sets
from acsar_gym.tools.benchmark.store import BENCHMARK_SCHEMA, Cell, EpisodeRecord, Part

ENV_ID = "PointGoal-v0"
SCENES = find_sets(f"acsar_gym/{ENV_ID}")[0]
SET = SCENES.name
FIRST = SCENES.numbers[0]


def episode(number: int = 0, score: float = 0.9, **changes: Any) -> EpisodeRecord:
    """An episode of the open floor; it is a success where its score isn't 0."""
    here = FIRST + number
    values: dict[str, Any] = {"scene": here, "seed": here, "success": score > 0.0}
    values |= {"collision": False, "score": score, "spl": score, "soft_spl": score}
    values |= {"time": 4.0, "steps": 40, "path": 1.5, "driven": 1.5, "shortest": 1.4}
    values |= {"turning": 0.5, "jerk": 2.0, "energy": 3.0, "odometry_error": 0.01}
    values |= dict.fromkeys(("clearance", "cross_track", "barn_score", "barn_score_own"), math.nan)
    values |= {"episode_return": 4.0, "late_ticks": 0, "fault": ""}
    return EpisodeRecord(**values | changes)


def cell(agent: str = "packaged", seed: int | None = None, **changes: str) -> Cell:
    """A nominal cell in the planar simulation."""
    told = {"id": ENV_ID, "link": "planar", "condition": "nominal", "scenes": SET} | changes
    return Cell(agent, seed, **told)


def part(own: Cell | None = None, scores: Sequence[float] = (0.9, 0.8), first: int = 0) -> Part:
    """A finished part of a cell."""
    episodes = [episode(first + number, score) for number, score in enumerate(scores)]
    return Part(own or cell(), first, episodes, 1.5)


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
