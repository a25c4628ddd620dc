"""The result of a benchmark, from one folder or several: the content of `benchmark.json`."""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from itertools import product
from pathlib import Path
from typing import Any

import acsar_gym
from acsar_gym import reading
from acsar_gym.errors import ConfigError, escape_unprintable, shorten_text, show_value
from acsar_gym.registration import IDS
from acsar_gym.tools.benchmark import cards, figures, plan, runner
from acsar_gym.tools.benchmark.figures import summarise_records
from acsar_gym.tools.benchmark.plan import (
    CONDITIONS,
    LINK_KINDS,
    PORT,
    BenchmarkPlan,
    condition_fields,
)
from acsar_gym.tools.benchmark.scenes import PUBLISHED, SCENES, TEST
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
from acsar_gym.tools.evaluation import metrics, provenance, report

MAX_PLAN_BYTES = 10_000_000
"""Largest accepted plan [bytes]."""
RESULT_FILE, TABLE_FILE = "benchmark.json", "benchmark.md"


def make_result(plan: Mapping[str, Any], parts: Sequence[Part]) -> dict[str, Any]:
    """Compute everything that `store` describes.

    Args:
        plan: as `Plan.as_dict`.
        parts: finished parts of its cells.
    """
    kinds = {name: seeds[0]["kind"] for name, seeds in plan["agents"].items()}
    return {
        "schema": BENCHMARK_SCHEMA,
        "header": result_header(plan),
        **compute_figures(parts, kinds),
    }


def compute_figures(parts: Sequence[Part], kinds: Mapping[str, str]) -> dict[str, Any]:
    """Compute everything but the header.

    Args:
        parts: finished parts of cells.
        kinds: "learned" or "baseline" by agent.
    """
    cells = figures.group_cells(parts)
    grouped = figures.group_rows(cells, kinds)
    told = {
        "cells": [_cell(each) for each in cells],
        "rows": [row.as_dict() for row in grouped],
        "improvements": figures.compare_pairs(grouped),
        "best": figures.compare_best(grouped),
        "taus": figures.TAUS,
    }
    cleaned: dict[str, Any] = metrics.replace_nonfinite(told)
    return cleaned


def write_result(path: Path, told: Mapping[str, Any]) -> None:
    """Write JSON on one line: lists of episodes with a line for each number would be long.

    Raises:
        ConfigError: it can't be written.
    """
    text = json.dumps(told, allow_nan=False, separators=(",", ":"))
    reading.write_atomically(path, f"{text}\n".encode())


def result_header(plan: Mapping[str, Any]) -> dict[str, Any]:
    """Return what is needed to repeat a benchmark."""
    agents = {
        name: {"kind": seeds[0]["kind"], "policies": seeds}
        for name, seeds in plan["agents"].items()
    }
    return {
        "versions": provenance.library_versions(*provenance.DRIVING_LIBRARIES),
        "agents": agents,
        "scenes": plan["scenes"],
        "conditions": plan["conditions"],
        "links": plan["links"],
        "port_scenes": plan["port_scenes"],
    }


def _cell(each: figures.CellResult) -> dict[str, Any]:
    """Return a cell with its episodes."""
    told = asdict(each.cell) | {"refused": each.refused, "seconds": round(each.seconds, 3)}
    means = summarise_records(each.episodes) if each.episodes else {}
    return told | {"summary": means, "episodes": episode_columns(each.episodes)}


def combine_folders(folders: Sequence[Path]) -> tuple[dict[str, Any], list[Part]]:
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
        for folder, each in zip(folders, plans, strict=True)
        for part in Store(folder).open(each)
    }
    told = plans[0]
    for folder, each in zip(folders[1:], plans[1:], strict=True):
        told = _joined(told, each, folder)
    return told, list(parts.values())


def _plan(folder: Path) -> dict[str, Any]:
    """Read the plan of a folder."""
    content = reading.read_file(folder / PLAN_FILE, MAX_PLAN_BYTES)
    try:
        plan: dict[str, Any] = reading.parse_json(content)
        sound = plan["schema"] == BENCHMARK_SCHEMA
    except (ConfigError, TypeError, LookupError):
        sound = False
    if not sound:
        raise ConfigError(f"{folder / PLAN_FILE}: isn't a benchmark's plan of this version")
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


# A submission: the row of anybody's policy, which others can check.
#
# `acsar-gym benchmark --policy mine.onnx` writes `mine.row.json`: the JSON of its benchmark and
# `sha256`, the hash of all the rest. `check` compares that hash, the hashes of the scenes with
# those
# of this package, the cells with those that the header promises, and all figures with those
# computed
# anew from the episodes. It can't know whether the episodes were really driven: whoever doubts it
# runs the policy, whose hash is in the row.

Told = Mapping[str, Any]
ROW_SUFFIX = ".row.json"
MAX_ROW_BYTES = 30_000_000
"""Largest accepted row [bytes]; 40,000 episodes have 10 MB."""
NOT_A_ROW = "isn't a row of 'acsar-gym benchmark --policy'"
ROUNDING_TOLERANCE = 1e-6
"""Largest relative difference of a figure that is computed anew from rounded episodes."""
MISSING_VALUE = "nothing"
"""Stands for a value that one side doesn't have."""


def write_row(told: Mapping[str, Any], name: str, folder: Path) -> Path:
    """Sign and write a row.

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


def hash_row(told: Mapping[str, Any]) -> str:
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
        raise ConfigError(f"{path}: {NOT_A_ROW}: {error}") from None
    try:
        if told["schema"] != BENCHMARK_SCHEMA:
            raise ConfigError(f"{path}: a row of another version of the benchmark")
        if told["sha256"] != hash_row(told):
            raise ConfigError(f"{path}: was changed after it was written: its hash is another one")
        _check_header(path, told["header"])
        parts = [_part(cell) for cell in told["cells"]]
        _check_cells(path, told["header"], parts)
        _check_figures(path, told, parts)
        return _sound(path, told["header"], sum(len(part.episodes) for part in parts))
    except (ValueError, TypeError, LookupError, AttributeError, ArithmeticError, RecursionError):
        raise ConfigError(f"{path}: {NOT_A_ROW}") from None


def _sound(path: Path, header: Told, count: int) -> str:
    """Say what was checked."""
    version = header["versions"]["acsar_gym"]
    names = [
        f"{name} (sha256 {str(each['policies'][0]['sha256'])[:16]})"
        for name, each in header["agents"].items()
    ]
    note = "" if version == acsar_gym.__version__ else f" (this is {acsar_gym.__version__})"
    return escape_unprintable(
        f"{path}: sound: {', '.join(names)}, {count} episodes, acsar_gym {version}{note}, scenes "
        "of this version, figures as computed from the episodes"
    )


def _check_header(path: Path, header: Told) -> None:
    """Compare scenes and conditions with those of this package; published worlds have no hash."""
    if not (header["scenes"] and header["agents"] and header["links"] and header["conditions"]):
        raise ConfigError(f"{path}: its header names no scenes, agents, links or conditions")
    for env_id, sets in header["scenes"].items():
        about = sets[TEST]
        if env_id not in SCENES or about != SCENES[env_id].test.about | {"count": about["count"]}:
            raise ConfigError(f"{path}: {show_value(env_id)}: scene set of another version")
        if not {*sets} <= {TEST, PUBLISHED} or not all(map(_counted, sets.values())):
            raise ConfigError(f"{path}: {env_id}: has no scenes, or others than the benchmark's")
    if not {*header["links"]} <= {*LINK_KINDS} or (
        PORT in header["links"] and header["port_scenes"] < 1
    ):
        raise ConfigError(
            f"{path}: its header names other links than {', '.join(LINK_KINDS)}, or no port scenes"
        )
    known = {
        name: json.loads(json.dumps(condition_fields(each))) for name, each in CONDITIONS.items()
    }
    for name, said in header["conditions"].items():
        if said != known.get(name):
            raise ConfigError(f"{path}: condition {show_value(name)}: of another version")


def _counted(about: Told) -> bool:
    """Whether a set of scenes has at least one, and no more than there are."""
    return bool(1 <= about["count"] <= about["last"] - about["first"] + 1)


def _part(cell: Told) -> Part:
    """Take a cell for its only part."""
    own = Cell(**{each.name: cell[each.name] for each in fields(Cell)})
    return Part(own, 0, episode_records(cell["episodes"]), cell["seconds"], cell["refused"])


def _check_cells(path: Path, header: Told, parts: Sequence[Part]) -> None:
    """Check that there are all cells of the header and no others, each with all its scenes."""
    waiting = dict(_cells(header))
    for part in parts:
        scenes = waiting.pop(part.cell, None)
        if scenes is None:
            raise ConfigError(f"{path}: {_named(part.cell)}: isn't a cell of its header")
        wanted = range(0) if part.refused else scenes
        driven = [(each.scene, each.seed) for each in part.episodes]
        if len(driven) != len(wanted) or any(
            pair != (number, number) for pair, number in zip(driven, wanted, strict=True)
        ):
            raise ConfigError(
                f"{path}: {_named(part.cell)}: its episodes aren't those of the first "
                f"{len(wanted)} scenes"
            )
    for cell in waiting:
        raise ConfigError(f"{path}: {_named(cell)}: is missing")


def _cells(header: Told) -> Iterator[tuple[Cell, range]]:
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


def _named(cell: Cell) -> str:
    """Name a cell in an error message."""
    told = f"{cell.agent} on {cell.id} {cell.scenes}, {cell.link}, {cell.condition}"
    return escape_unprintable(shorten_text(told, 100))


def _check_figures(path: Path, told: Told, parts: Sequence[Part]) -> None:
    """Compute everything but the header anew, and compare."""
    kinds = {name: each["kind"] for name, each in told["header"]["agents"].items()}
    own = compute_figures(parts, kinds)
    said = {key: value for key, value in told.items() if key not in ("schema", "header", "sha256")}
    for name, one, other in _differences("", said, own):
        raise ConfigError(
            f"{path}: {escape_unprintable(name)} = {show_value(one)} isn't that of its "
            f"episodes, {show_value(other)}"
        )


def _differences(name: str, one: Any, other: Any) -> Iterator[tuple[str, Any, Any]]:
    """Yield the name and both values of what differs by more than rounding."""
    if isinstance(one, dict) and isinstance(other, dict):
        for key in sorted({*one, *other}):
            inner = f"{name}.{key}" if name else key
            yield from _differences(
                inner, one.get(key, MISSING_VALUE), other.get(key, MISSING_VALUE)
            )
    elif isinstance(one, list) and isinstance(other, list) and len(one) == len(other):
        for place, pair in enumerate(zip(one, other, strict=True)):
            yield from _differences(f"{name}[{place}]", *pair)
    elif not _alike(one, other):
        yield name, one, other


def _alike(one: Any, other: Any) -> bool:
    """Whether two values are equal, but for rounding."""
    if isinstance(one, int | float) and isinstance(other, int | float):
        return math.isclose(one, other, rel_tol=ROUNDING_TOLERANCE, abs_tol=ROUNDING_TOLERANCE)
    return bool(one == other)


# What the command `benchmark` does: run, combine, and write.


@dataclass(frozen=True)
class BenchmarkOutput:
    """Where the results of a benchmark go."""

    out: Path
    """Folder of the store, the table and the JSON."""
    table: Path | None = None
    """Another file for the table."""
    json: Path | None = None
    """Another file for the JSON."""
    cards: Path | None = None
    """Folder for a page of each packaged policy."""
    html: Path | None = None
    """File for the HTML report."""
    worst: int = 10
    """How many of the worst episodes the HTML report shows."""

    def run(
        self,
        plan: BenchmarkPlan,
        policy: str = "",
        workers: int | None = None,
        address: str | None = None,
        *,
        resume: bool = True,
    ) -> None:
        """Run a plan, and write everything.

        Args:
            plan: what to measure.
            policy: the only policy, if it is a submission.
            workers: most processes at a time.
            address: of a Ray cluster.
            resume: go on where the folder's benchmark ended.

        Raises:
            AcsarError: as `runner.run`, and where a file can't be written.
        """
        report.make_folder(self.out)
        if not resume:
            self._forget()
        parts = runner.run_plan(plan, Store(self.out), workers=workers, address=address)
        told = make_result(plan.as_dict(), parts)
        if policy:
            said = write_row(told, plan.agents[0].name, self.out)
            print(escape_unprintable(f"row to submit: {said}"))
        self._write(told, plan.agents)

    def combine(self, folders: Sequence[Path], trained: Path | None, seeds: int) -> None:
        """Write everything from the folders of several benchmarks.

        Args:
            folders: of the benchmarks.
            trained: folder of the trained policies, for films of their worst episodes.
            seeds: most training seeds of each.

        Raises:
            ConfigError: a folder can't be used, or a file can't be written.
        """
        report.make_folder(self.out)
        told = make_result(*combine_folders(folders))
        self._write(told, plan.choose_agents((), tuple(IDS), trained, seeds) if self.html else ())

    def _forget(self) -> None:
        """Remove the results of an earlier run."""
        for name in (PLAN_FILE, RESULTS_FILE):
            with contextlib.suppress(FileNotFoundError):
                try:
                    (self.out / name).unlink()
                except PermissionError as error:
                    raise ConfigError(
                        f"{self.out / name}: {reading.explain_error(error)}"
                    ) from None

    def _write(self, told: Mapping[str, Any], some: Sequence[plan.Agent]) -> None:
        """Write JSON, tables, cards and report, and say where they are."""
        page = format_tables(told)
        for path in (self.out / RESULT_FILE, self.json):
            if path is not None:
                write_result(path, told)
        for path in (self.out / TABLE_FILE, self.table):
            if path is not None:
                reading.write_atomically(path, page.encode())
                print(escape_unprintable(f"tables: {path}"))
        if self.cards is not None:
            report.make_folder(self.cards)
            for path in cards.write(told, self.cards):
                print(escape_unprintable(f"card: {path}"))
        if self.html is not None:
            from acsar_gym.tools.benchmark.page import report as html  # noqa: PLC0415 - optional

            html.write(told, self.html, some, self.worst)
            print(escape_unprintable(f"report: {self.html}"))
