"""The result of a benchmark, from one folder or several: the content of `benchmark.json`.

A submission is the row of anybody's policy, which others can check: `acsar-gym benchmark --policy
mine.onnx` writes `mine.row.json`, the JSON of its benchmark and `sha256`, the hash of all the rest.
`check_row` compares that hash, the hashes of the scenes with those of this package, the cells with
those that the header promises, and all figures with those computed anew from the episodes. It
can't know whether the episodes were really driven: whoever doubts it runs the policy, whose hash is
in the row.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, fields
from itertools import product
from pathlib import Path
from typing import Any

import acsar_gym
from acsar_gym import reading
from acsar_gym.errors import ConfigError, escape_unprintable, shorten_text, show_value
from acsar_gym.registration import SCENE_CHOICES
from acsar_gym.tools.benchmark import figures, runner
from acsar_gym.tools.benchmark.plan import (
    CONDITIONS,
    LINK_KINDS,
    PORT,
    BenchmarkPlan,
    condition_fields,
)
from acsar_gym.tools.benchmark.scenes import (
    GIVEN,
    OWN_NAMESPACE,
    PUBLISHED_SUFFIX,
    SceneSet,
    find_sets,
)
from acsar_gym.tools.benchmark.store import (
    BENCHMARK_SCHEMA,
    PLAN_FILE,
    RESULTS_FILE,
    Cell,
    Part,
    Store,
    episode_columns,
    episode_records,
)
from acsar_gym.tools.benchmark.table import format_tables
from acsar_gym.tools.evaluation import metrics, provenance

Told = Mapping[str, Any]
MAX_PLAN_BYTES = 10_000_000
"""Largest accepted plan [bytes]."""
MAX_ROW_BYTES = 30_000_000
"""Largest accepted row [bytes]; 40,000 episodes have 10 MB."""
TABLE_MARK = "`acsar-gym benchmark` writes this page"
"""At the beginning of a page of tables."""
RESULT_FILE, TABLE_FILE, ROW_SUFFIX = "benchmark.json", "benchmark.md", ".row.json"
NOT_A_ROW = "isn't a row of 'acsar-gym benchmark --policy'"
ROUNDING_TOLERANCE = 1e-6
"""Largest relative difference of a figure that is computed anew from rounded episodes."""
MISSING_VALUE = "nothing"
"""Stands for a value that one side doesn't have."""


def run_benchmark(
    plan: BenchmarkPlan,
    folder: Path,
    *,
    workers: int | None = None,
    address: str | None = None,
    resume: bool = True,
    submit: bool = False,
) -> dict[str, Any]:
    """Run a plan, and return the result.

    Args:
        plan: what to measure.
        folder: where parts are kept.
        workers: most processes at a time.
        address: of a Ray cluster.
        resume: go on where the folder's benchmark ended.
        submit: also write the row of the plan's only policy into the folder.

    Raises:
        AcsarError: as `runner.run_plan`, and where a file can't be written.
    """
    for name in () if resume else (PLAN_FILE, RESULTS_FILE):
        try:
            (folder / name).unlink(missing_ok=True)
        except PermissionError as error:
            raise ConfigError(f"{folder / name}: {reading.explain_error(error)}") from error
    parts = runner.run_plan(plan, Store(folder), workers=workers, address=address)
    told = make_result(plan.as_dict(), parts)
    if submit:
        row = write_row(told, plan.agents[0].name, folder)
        print(escape_unprintable(f"row to submit: {row}"))
    return told


def write_outputs(
    told: Told, folder: Path, table: Path | None, json_file: Path | None, html: Path | None
) -> None:
    """Write JSON and tables to the folder and to other files, and the HTML report.

    Raises:
        ConfigError: a file can't be written.
        MissingExtraError: the report needs plotly and jinja2.
    """
    page = format_tables(told)
    for path in filter(None, (folder / RESULT_FILE, json_file)):
        write_result(path, {"origin": reading.describe_origin(), **told})
    for path in filter(None, (folder / TABLE_FILE, table)):
        reading.write_atomically(path, page.encode())
        print(escape_unprintable(f"tables: {path}"))
    if html is not None:
        from acsar_gym.tools.benchmark.page import benchmark_page  # noqa: PLC0415 - optional

        benchmark_page(told).write(html)
        print(escape_unprintable(f"report: {html}"))


def make_result(plan: Told, parts: Sequence[Part]) -> dict[str, Any]:
    """Compute everything that `store` describes.

    Args:
        plan: as `BenchmarkPlan.as_dict`.
        parts: finished parts of its cells.
    """
    kinds = {name: seeds[0]["kind"] for name, seeds in plan["agents"].items()}
    header = {
        "versions": provenance.library_versions(*provenance.DRIVING_LIBRARIES),
        "agents": {
            name: {"kind": kinds[name], "policies": seeds} for name, seeds in plan["agents"].items()
        },
        **{name: plan[name] for name in ("scenes", "conditions", "links", "port_scenes")},
    }
    return {"schema": BENCHMARK_SCHEMA, "header": header, **compute_figures(parts, kinds)}


def compute_figures(parts: Sequence[Part], kinds: Mapping[str, str]) -> dict[str, Any]:
    """Compute everything but the header.

    Args:
        parts: finished parts of cells.
        kinds: "learned" or "baseline" by agent.
    """
    cells = figures.group_cells(parts)
    rows = figures.group_rows(cells, kinds)
    told = {
        "cells": [
            asdict(each.cell)
            | {
                "refused": each.refused,
                "seconds": round(each.seconds, 3),
                "summary": figures.summarise_records(each.episodes) if each.episodes else {},
                "episodes": episode_columns(each.episodes),
            }
            for each in cells
        ],
        "rows": [row.as_dict() for row in rows],
        "paired": figures.compare_with_best(rows),
        "improvements": figures.compare_pairs(rows),
        "taus": figures.TAUS,
    }
    cleaned: dict[str, Any] = metrics.replace_nonfinite(told)
    return cleaned


def write_result(path: Path, told: Told) -> None:
    """Write JSON on one line: lists of episodes with a line for each number would be long.

    Raises:
        ConfigError: it can't be written.
    """
    text = json.dumps(told, allow_nan=False, separators=(",", ":"))
    reading.write_atomically(path, f"{text}\n".encode())


def combine_folders(folders: Sequence[Path]) -> tuple[dict[str, Any], list[Part]]:
    """Read the plans and parts of several folders, which must have used the same scenes.

    Args:
        folders: of benchmarks, finished or not.

    Returns:
        One plan, and all parts; where two have the same one, that of the last folder.

    Raises:
        ConfigError: a folder holds no benchmark, or one of other scenes or another version.
    """
    joined: dict[str, Any] = {}
    parts: dict[tuple[Cell, int], Part] = {}
    for folder in folders:
        content = reading.read_file(folder / PLAN_FILE, MAX_PLAN_BYTES)
        try:
            plan: dict[str, Any] = reading.parse_json(content)
            sound = plan["schema"] == BENCHMARK_SCHEMA
        except (ConfigError, TypeError, LookupError):
            sound = False
        if not sound:
            raise ConfigError(f"{folder / PLAN_FILE}: isn't a benchmark's plan of this version")
        parts |= {(part.cell, part.first): part for part in Store(folder).open(plan)}
        joined = _join_plans(joined, plan, folder) if joined else plan
    return joined, list(parts.values())


def _join_plans(one: dict[str, Any], other: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Join two plans; of the same set of scenes, the larger number counts."""
    scenes = {env_id: dict(sets) for env_id, sets in one["scenes"].items()}
    for env_id, sets in other["scenes"].items():
        own = scenes.setdefault(env_id, {})
        for name, about in sets.items():
            known = own.setdefault(name, about)
            if known | {"count": 0} != about | {"count": 0}:
                raise ConfigError(
                    f"{folder}: {env_id} {name}: scene set of another version than in the first "
                    "folder"
                )
            own[name] = max(known, about, key=lambda each: each["count"])
    agents = {name: list(policies) for name, policies in one["agents"].items()}
    for name, policies in other["agents"].items():
        mine = agents.setdefault(name, [])
        hashes = {(each["id"], each["training_seed"]): each["sha256"] for each in mine}
        for each in policies:
            place = each["id"], each["training_seed"]
            if place not in hashes:
                mine.append(each)
            elif hashes[place] != each["sha256"]:
                raise ConfigError(f"{folder}: {name} on {each['id']} was another policy file there")
    return one | {
        "scenes": scenes,
        "agents": agents,
        "conditions": one["conditions"] | other["conditions"],
        "links": [*dict.fromkeys([*one["links"], *other["links"]])],
        "port_scenes": max(one["port_scenes"], other["port_scenes"]),
    }


def write_row(told: Told, name: str, folder: Path) -> Path:
    """Sign and write the row of an agent.

    Args:
        told: result of a benchmark of one policy.
        name: of the agent.
        folder: to write to.

    Returns:
        The file.
    """
    path = folder / f"{name}{ROW_SUFFIX}"
    write_result(path, {**told, "sha256": hash_row(told)})
    return path


def hash_row(told: Told) -> str:
    """Hash a row without its own hash."""
    rest = {key: value for key, value in told.items() if key != "sha256"}
    text = json.dumps(rest, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def check_row(path: Path) -> str:
    """Check a row.

    Args:
        path: of its file.

    Returns:
        What was checked, in one line.

    Raises:
        ConfigError: it isn't a row, or says something that isn't so; names what.
    """
    data = reading.read_file(path, MAX_ROW_BYTES)
    try:
        told = reading.parse_json(data)
    except ConfigError as error:
        raise ConfigError(f"{path}: {NOT_A_ROW}: {error}") from error
    try:
        if told["schema"] != BENCHMARK_SCHEMA:
            raise ConfigError(f"{path}: a row of another version of the benchmark")
        if told["sha256"] != hash_row(told):
            raise ConfigError(f"{path}: was changed after it was written: its hash is another one")
        header = told["header"]
        _check_header(path, header)
        parts = []
        for cell in told["cells"]:
            own = Cell(**{each.name: cell[each.name] for each in fields(Cell)})
            driven = episode_records(cell["episodes"])
            parts.append(Part(own, 0, driven, cell["seconds"], cell["refused"]))
        _check_cells(path, header, parts)
        kinds = {name: each["kind"] for name, each in header["agents"].items()}
        said = {
            key: value for key, value in told.items() if key not in ("schema", "header", "sha256")
        }
        for name, one, other in _differences("", said, compute_figures(parts, kinds)):
            raise ConfigError(
                f"{path}: {escape_unprintable(name)} = {show_value(one)} isn't that of its "
                f"episodes, {show_value(other)}"
            )
        version = header["versions"]["acsar_gym"]
        names = [
            f"{name} (sha256 {str(each['policies'][0]['sha256'])[:16]})"
            for name, each in header["agents"].items()
        ]
        note = "" if version == acsar_gym.__version__ else f" (this is {acsar_gym.__version__})"
        count = sum(len(part.episodes) for part in parts)
        return escape_unprintable(
            f"{path}: sound: {', '.join(names)}, {count} episodes, acsar_gym {version}{note}, "
            "scenes of this version, figures as computed from the episodes"
        )
    except (
        ValueError,
        TypeError,
        LookupError,
        AttributeError,
        ArithmeticError,
        RecursionError,
    ) as error:
        raise ConfigError(f"{path}: {NOT_A_ROW}") from error


def _check_header(path: Path, header: Told) -> None:
    """Compare scenes and conditions with those of this package; given worlds have no hash."""
    if not (header["scenes"] and header["agents"] and header["links"] and header["conditions"]):
        raise ConfigError(f"{path}: its header names no scenes, agents, links or conditions")
    for env_id, sets in header["scenes"].items():
        own = _known_sets(path, env_id)
        for name, about in sets.items():
            if not 1 <= about["count"] <= about["last"] - about["first"] + 1:
                raise ConfigError(f"{path}: {env_id} {name}: has no scenes, or too many")
            base = own.get(name.removesuffix(PUBLISHED_SUFFIX))
            if about["split"] == GIVEN and base is not None:
                equal = all(about[key] == base.about[key] for key in ("robot", "score"))
            else:
                equal = base is not None and about == base.about | {"count": about["count"]}
            if not equal:
                raise ConfigError(
                    f"{path}: {show_value(env_id)} {show_value(name)}: scene set of another version"
                )
    if not {*header["links"]} <= {*LINK_KINDS} or (
        PORT in header["links"] and header["port_scenes"] < 1
    ):
        raise ConfigError(
            f"{path}: its header names other links than {', '.join(LINK_KINDS)}, or no port scenes"
        )
    for name, said in header["conditions"].items():
        known = CONDITIONS.get(name)
        if known is None or said != json.loads(json.dumps(condition_fields(known))):
            raise ConfigError(f"{path}: condition {show_value(name)}: of another version")


def _known_sets(path: Path, env_id: str) -> dict[str, SceneSet]:
    """Return the sets of an id by name; ConfigError for one that nothing here has registered."""
    full = env_id if "/" in env_id else f"{OWN_NAMESPACE}{env_id}"
    if full not in SCENE_CHOICES:
        raise ConfigError(
            f"{path}: {show_value(env_id)}: no scenes of this id are known: name the module that "
            "registers it, as in --env mine.module:mine/Task-v0"
        )
    return {some.name: some for some in find_sets(full)}


def _check_cells(path: Path, header: Told, parts: Sequence[Part]) -> None:
    """Check that there are all cells of the header and no others, each with all its scenes."""

    def name_cell(cell: Cell) -> str:
        told = f"{cell.agent} on {cell.id} {cell.scenes}, {cell.link}, {cell.condition}"
        return escape_unprintable(shorten_text(told, 100))

    waiting = dict(_promised_cells(header))
    for part in parts:
        scenes = waiting.pop(part.cell, None)
        if scenes is None:
            raise ConfigError(f"{path}: {name_cell(part.cell)}: isn't a cell of its header")
        wanted = range(0) if part.refused else scenes
        driven = [(each.scene, each.seed) for each in part.episodes]
        if len(driven) != len(wanted) or any(
            pair != (number, number) for pair, number in zip(driven, wanted, strict=True)
        ):
            raise ConfigError(
                f"{path}: {name_cell(part.cell)}: its episodes aren't those of the first "
                f"{len(wanted)} scenes"
            )
    for cell in waiting:
        raise ConfigError(f"{path}: {name_cell(cell)}: is missing")


def _promised_cells(header: Told) -> Iterator[tuple[Cell, range]]:
    """Yield the cells that a header promises, and the numbers of their scenes."""
    for env_id, link, condition in product(header["scenes"], header["links"], header["conditions"]):
        for name, about in header["scenes"][env_id].items():
            count = min(about["count"], header["port_scenes"]) if link == PORT else about["count"]
            numbers = range(about["first"], about["first"] + count)
            for agent, seeds in header["agents"].items():
                for each in seeds["policies"]:
                    if each["id"] == env_id:
                        seed = each["training_seed"]
                        yield Cell(agent, seed, env_id, link, condition, name), numbers


def _differences(name: str, one: Any, other: Any) -> Iterator[tuple[str, Any, Any]]:
    """Yield the name and both values of what differs by more than rounding."""
    if isinstance(one, dict) and isinstance(other, dict):
        for key in sorted({*one, *other}):
            inner = f"{name}.{key}" if name else key
            pair = one.get(key, MISSING_VALUE), other.get(key, MISSING_VALUE)
            yield from _differences(inner, *pair)
    elif isinstance(one, list) and isinstance(other, list) and len(one) == len(other):
        for place, pair in enumerate(zip(one, other, strict=True)):
            yield from _differences(f"{name}[{place}]", *pair)
    elif isinstance(one, int | float) and isinstance(other, int | float):
        if not math.isclose(one, other, rel_tol=ROUNDING_TOLERANCE, abs_tol=ROUNDING_TOLERANCE):
            yield name, one, other
    elif one != other:
        yield name, one, other
