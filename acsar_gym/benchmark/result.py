"""The result of a benchmark, from one folder or several: the content of `benchmark.json`."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from acsar_gym.benchmark import comparing, rows, statistics
from acsar_gym.benchmark.figures import summary
from acsar_gym.benchmark.store import PLAN, SCHEMA, Part, Store, columns
from acsar_gym.errors import ConfigError
from acsar_gym.evaluation import metrics, provenance
from acsar_gym.reading import bounded, structured

MOST_PLAN = 10_000_000
"""Largest accepted plan [bytes]."""
FILE, TABLE = "benchmark.json", "benchmark.md"


def result(plan: Mapping[str, Any], parts: Sequence[Part]) -> dict[str, Any]:
    """Compute everything that `store` describes.

    Args:
        plan: as `Plan.as_dict`.
        parts: finished parts of its cells.
    """
    kinds = {name: seeds[0]["kind"] for name, seeds in plan["agents"].items()}
    return {"schema": SCHEMA, "header": header(plan), **figures(parts, kinds)}


def figures(parts: Sequence[Part], kinds: Mapping[str, str]) -> dict[str, Any]:
    """Compute everything but the header.

    Args:
        parts: finished parts of cells.
        kinds: "learned" or "baseline" by agent.
    """
    cells = rows.cells(parts)
    grouped = rows.rows(cells, kinds)
    told = {
        "cells": [_cell(each) for each in cells],
        "rows": [row.as_dict() for row in grouped],
        "improvements": comparing.improvements(grouped),
        "best": comparing.best(grouped),
        "taus": statistics.TAUS,
    }
    cleaned: dict[str, Any] = metrics.finite(told)
    return cleaned


def write(path: Path, told: Mapping[str, Any]) -> None:
    """Write JSON on one line: lists of episodes with a line for each number would be long.

    Raises:
        ConfigError: it can't be written.
    """
    text = json.dumps(told, allow_nan=False, separators=(",", ":"))
    bounded.write_atomically(path, f"{text}\n".encode())


def header(plan: Mapping[str, Any]) -> dict[str, Any]:
    """Return what is needed to repeat a benchmark."""
    agents = {
        name: {"kind": seeds[0]["kind"], "policies": seeds}
        for name, seeds in plan["agents"].items()
    }
    return {
        "versions": provenance.versions(*provenance.DRIVING),
        "agents": agents,
        "scenes": plan["scenes"],
        "conditions": plan["conditions"],
        "links": plan["links"],
        "port_scenes": plan["port_scenes"],
    }


def _cell(each: rows.CellResult) -> dict[str, Any]:
    """Return a cell with its episodes."""
    told = asdict(each.cell) | {"refused": each.refused, "seconds": round(each.seconds, 3)}
    means = summary(each.episodes) if each.episodes else {}
    return told | {"summary": means, "episodes": columns(each.episodes)}


def combined(folders: Sequence[Path]) -> tuple[dict[str, Any], list[Part]]:
    """Read the plans and parts of several folders, which must have used the same scenes.

    Args:
        folders: of benchmarks, finished or not.

    Returns:
        One plan, and all parts; where two have the same one, that of the last folder.

    Raises:
        ConfigError: a folder holds no benchmark, or one of other scenes or another version.
    """
    plans = [_plan(folder) for folder in folders]
    parts = {
        (part.cell, part.first): part
        for folder, plan in zip(folders, plans, strict=True)
        for part in Store(folder).open(plan)
    }
    told = plans[0]
    for folder, plan in zip(folders[1:], plans[1:], strict=True):
        told = _joined(told, plan, folder)
    return told, list(parts.values())


def _plan(folder: Path) -> dict[str, Any]:
    """Read the plan of a folder."""
    content = bounded.read(folder / PLAN, MOST_PLAN)
    try:
        plan: dict[str, Any] = structured.from_json(content)
        sound = plan["schema"] == SCHEMA
    except (ConfigError, TypeError, LookupError):
        sound = False
    if not sound:
        raise ConfigError(f"{folder / PLAN}: isn't a benchmark's plan of this version")
    return plan


def _joined(one: dict[str, Any], other: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Join two plans."""
    for env_id, sets in other["scenes"].items():
        for name, about in sets.items():
            known = one["scenes"].get(env_id, {}).get(name, about)
            if known["sha256"] != about["sha256"]:
                raise ConfigError(
                    f"{folder}: {env_id} {name}: scene set of another version than in the first "
                    "folder"
                )
    scenes = {
        env_id: _sets(one["scenes"].get(env_id, {}), other["scenes"].get(env_id, {}))
        for env_id in [*one["scenes"], *other["scenes"]]
    }
    agents = {
        name: _policies(name, one["agents"].get(name, []), other["agents"].get(name, []), folder)
        for name in [*one["agents"], *other["agents"]]
    }
    return one | {
        "scenes": scenes,
        "agents": agents,
        "conditions": one["conditions"] | other["conditions"],
        "links": [*dict.fromkeys([*one["links"], *other["links"]])],
        "port_scenes": max(one["port_scenes"], other["port_scenes"]),
    }


def _sets(one: dict[str, Any], other: dict[str, Any]) -> dict[str, Any]:
    """Join the sets of an id; of the same set, the larger number of scenes counts."""
    return one | {
        name: about
        for name, about in other.items()
        if name not in one or about["count"] > one[name]["count"]
    }


def _policies(
    name: str, some: list[dict[str, Any]], others: list[dict[str, Any]], folder: Path
) -> list[dict[str, Any]]:
    """Join the policies of an agent; ConfigError where two files were the same seed on an id."""
    known = {(each["id"], each["training_seed"]): each["sha256"] for each in some}
    for each in others:
        place = each["id"], each["training_seed"]
        if known.get(place, each["sha256"]) != each["sha256"]:
            raise ConfigError(f"{folder}: {name} on {each['id']} was another policy file there")
    return some + [each for each in others if (each["id"], each["training_seed"]) not in known]
