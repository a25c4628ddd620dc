"""A submission: the row of anybody's policy, which others can check.

`acsar-gym benchmark --policy mine.onnx` writes `mine.row.json`: the JSON of its benchmark and
`sha256`, the hash of all the rest. `check` compares that hash, the hashes of the scenes with those
of this package, the cells with those that the header promises, and all figures with those computed
anew from the episodes. It can't know whether the episodes were really driven: whoever doubts it
runs the policy, whose hash is in the row.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields
from itertools import product
from pathlib import Path
from typing import Any

import acsar_gym
from acsar_gym.benchmark import result
from acsar_gym.benchmark.conditions import CONDITIONS
from acsar_gym.benchmark.plan import LINKS, PORT, plain
from acsar_gym.benchmark.scenes import PUBLISHED, SCENES, TEST
from acsar_gym.benchmark.store import SCHEMA, Cell, Part, episodes
from acsar_gym.errors import ConfigError, printable, shortened, shown
from acsar_gym.reading import bounded, structured

Told = Mapping[str, Any]
SUFFIX = ".row.json"
MOST_BYTES = 30_000_000
"""Largest accepted row [bytes]; 40,000 episodes have 10 MB."""
FOREIGN = "isn't a row of 'acsar-gym benchmark --policy'"
CLOSE = 1e-6
"""Largest relative difference of a figure that is computed anew from rounded episodes."""
MISSING = "nothing"
"""Stands for a value that one side doesn't have."""


def write(told: Mapping[str, Any], name: str, folder: Path) -> Path:
    """Sign and write a row.

    Args:
        told: result of a benchmark of one policy.
        name: of the agent.
        folder: to write to.

    Returns:
        The file.
    """
    path = folder / f"{name}{SUFFIX}"
    result.write(path, {**told, "sha256": signature(told)})
    return path


def signature(told: Mapping[str, Any]) -> str:
    """Hash a row without its own hash."""
    rest = {key: value for key, value in told.items() if key != "sha256"}
    text = json.dumps(rest, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def check(path: Path) -> str:
    """Check a row.

    Args:
        path: of its file.

    Returns:
        What was checked, in one line.

    Raises:
        ConfigError: it isn't a row, or says something that isn't so; names what.
    """
    data = bounded.read(path, MOST_BYTES)
    try:
        told = structured.from_json(data)
    except ConfigError as error:
        raise ConfigError(f"{path}: {FOREIGN}: {error}") from None
    try:
        if told["schema"] != SCHEMA:
            raise ConfigError(f"{path}: a row of another version of the benchmark")
        if told["sha256"] != signature(told):
            raise ConfigError(f"{path}: was changed after it was written: its hash is another one")
        _check_header(path, told["header"])
        parts = [_part(cell) for cell in told["cells"]]
        _check_cells(path, told["header"], parts)
        _check_figures(path, told, parts)
        return _sound(path, told["header"], sum(len(part.episodes) for part in parts))
    except (ValueError, TypeError, LookupError, AttributeError, ArithmeticError, RecursionError):
        raise ConfigError(f"{path}: {FOREIGN}") from None


def _sound(path: Path, header: Told, count: int) -> str:
    """Say what was checked."""
    version = header["versions"]["acsar_gym"]
    names = [
        f"{name} (sha256 {str(each['policies'][0]['sha256'])[:16]})"
        for name, each in header["agents"].items()
    ]
    note = "" if version == acsar_gym.__version__ else f" (this is {acsar_gym.__version__})"
    return printable(
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
            raise ConfigError(f"{path}: {shown(env_id)}: scene set of another version")
        if not {*sets} <= {TEST, PUBLISHED} or not all(map(_counted, sets.values())):
            raise ConfigError(f"{path}: {env_id}: has no scenes, or others than the benchmark's")
    if not {*header["links"]} <= {*LINKS} or (
        PORT in header["links"] and header["port_scenes"] < 1
    ):
        raise ConfigError(
            f"{path}: its header names other links than {', '.join(LINKS)}, or no port scenes"
        )
    known = {name: json.loads(json.dumps(plain(each))) for name, each in CONDITIONS.items()}
    for name, said in header["conditions"].items():
        if said != known.get(name):
            raise ConfigError(f"{path}: condition {shown(name)}: of another version")


def _counted(about: Told) -> bool:
    """Whether a set of scenes has at least one, and no more than there are."""
    return bool(1 <= about["count"] <= about["last"] - about["first"] + 1)


def _part(cell: Told) -> Part:
    """Take a cell for its only part."""
    own = Cell(**{each.name: cell[each.name] for each in fields(Cell)})
    return Part(own, 0, episodes(cell["episodes"]), cell["seconds"], cell["refused"])


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
    return printable(shortened(told, 100))


def _check_figures(path: Path, told: Told, parts: Sequence[Part]) -> None:
    """Compute everything but the header anew, and compare."""
    kinds = {name: each["kind"] for name, each in told["header"]["agents"].items()}
    own = result.figures(parts, kinds)
    said = {key: value for key, value in told.items() if key not in ("schema", "header", "sha256")}
    for name, one, other in _differences("", said, own):
        raise ConfigError(
            f"{path}: {printable(name)} = {shown(one)} isn't that of its episodes, {shown(other)}"
        )


def _differences(name: str, one: Any, other: Any) -> Iterator[tuple[str, Any, Any]]:
    """Yield the name and both values of what differs by more than rounding."""
    if isinstance(one, dict) and isinstance(other, dict):
        for key in sorted({*one, *other}):
            inner = f"{name}.{key}" if name else key
            yield from _differences(inner, one.get(key, MISSING), other.get(key, MISSING))
    elif isinstance(one, list) and isinstance(other, list) and len(one) == len(other):
        for place, pair in enumerate(zip(one, other, strict=True)):
            yield from _differences(f"{name}[{place}]", *pair)
    elif not _alike(one, other):
        yield name, one, other


def _alike(one: Any, other: Any) -> bool:
    """Whether two values are equal, but for rounding."""
    if isinstance(one, int | float) and isinstance(other, int | float):
        return math.isclose(one, other, rel_tol=CLOSE, abs_tol=CLOSE)
    return bool(one == other)
