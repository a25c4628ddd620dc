"""The cells of a benchmark, and the folder in which finished ones are kept.

| file | content |
|---|---|
| `cells/` | a file for each finished cell; see `CellResult` |
| `benchmark.json` | the result; see `figures.make_result` |
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from acsar_gym import reading
from acsar_gym.errors import ConfigError, explain_error
from acsar_gym.tools.evaluation.episode import Episode
from acsar_gym.tools.evaluation.metrics import replace_nonfinite

BENCHMARK_SCHEMA = 4  # version of these files
MAX_CELL_BYTES = 20_000_000  # largest accepted file [bytes]; 1,000 episodes have 0.3 MB
CELLS_FOLDER = "cells"
COLUMNS = tuple(
    column.name for column in fields(Episode) if column.name not in ("pose", "timing", "told")
)
"""Fields of an `Episode` that are kept, besides what the task told."""
DERIVED_COLUMNS = ("time", "spl", "soft_spl")  # what follows from them, for readers of the JSON


@dataclass(frozen=True, slots=True)
class Cell:
    """One cell of the benchmark's table: an agent on an id's scenes, behind one kind of link."""

    agent: str  # name of the agent, such as "dwa"
    training_seed: int | None
    """Seed of the training; None for a baseline, and for a policy that doesn't say."""
    id: str  # id of the env without its namespace, such as "Barn-v1"
    link: str  # name of a simulated body, or "port"
    condition: str  # "nominal", or another name of `plan.CONDITIONS`
    scenes: str  # set of scenes, such as "barn-fast" or "clutter/husky"; see `scenes.SceneSet`


@dataclass(frozen=True, slots=True)
class CellResult:
    """The episodes of a cell, in the order of its scenes: a file of the benchmark's folder."""

    cell: Cell
    episodes: list[Episode] = field(default_factory=list)
    seconds: float = 0.0  # CPU time that it took, without that of an emulator [s]
    refused: str = ""  # why the agent couldn't be run here; empty if it was

    def as_dict(self) -> dict[str, Any]:
        """Return it for JSON."""
        return {
            **asdict(self.cell),
            "refused": self.refused,
            "seconds": self.seconds,
            "episodes": episode_columns(self.episodes),
        }

    @classmethod
    def of(cls, line: Mapping[str, Any]) -> CellResult:
        """Make it from `as_dict`; ValueError, TypeError or KeyError if that is broken."""
        cell = Cell(**{column.name: line[column.name] for column in fields(Cell)})
        return cls(cell, read_episodes(line["episodes"]), line["seconds"], line["refused"])


def episode_columns(episodes: Sequence[Episode]) -> dict[str, Any]:
    """Return episodes as lists by field, for JSON: NaN and infinity become None."""
    columns: dict[str, Any] = {
        name: [getattr(episode, name) for episode in episodes]
        for name in (*COLUMNS, *DERIVED_COLUMNS)
    }
    names = episodes[0].told if episodes else ()
    columns["told"] = {name: [episode.told[name] for episode in episodes] for name in names}
    cleaned: dict[str, Any] = replace_nonfinite(columns)
    return cleaned


def read_episodes(columns: Mapping[str, Any]) -> list[Episode]:
    """Return the episodes of `episode_columns`; None becomes NaN, but of seeds and worlds."""

    def read_value(name: str, value: Any) -> Any:
        return math.nan if value is None and name not in ("seed", "world") else value

    return [
        Episode(
            **{name: read_value(name, columns[name][number]) for name in COLUMNS},
            told={n: read_value(n, values[number]) for n, values in columns["told"].items()},
        )
        for number in range(len(columns["success"]))
    ]


class Store:
    """The folder of a benchmark, which must exist; it keeps finished cells.

    A cell's file is named by a hash of all that its result depends on, so a cell of another policy,
    scene set or version is another cell.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def find(self, key: str) -> CellResult | None:
        """Read a finished cell; None where there is none, ConfigError where it can't be read."""
        file = self._file(key)
        if not file.exists():
            return None
        data = reading.read_file(file, MAX_CELL_BYTES)
        try:
            return CellResult.of(reading.parse_json(data))
        except (ConfigError, ValueError, TypeError, LookupError, AttributeError) as error:
            raise ConfigError(f"{file}: isn't a benchmark's: remove it") from error

    def add(self, key: str, result: CellResult) -> CellResult:
        """Write a cell, whole or not at all; returns it as it will be read.

        Raises ConfigError where it can't be written, as on a full disk.
        """
        file = self._file(key)
        try:
            file.parent.mkdir(exist_ok=True)
        except OSError as error:
            raise ConfigError(f"{file.parent}: {explain_error(error)}") from error
        line = json.dumps(result.as_dict(), allow_nan=False, separators=(",", ":"))
        reading.write_atomically(file, line.encode())
        return CellResult.of(reading.parse_json(line.encode()))

    def _file(self, key: str) -> Path:
        name = hashlib.sha256(key.encode()).hexdigest()[:16]
        return self.folder / CELLS_FOLDER / f"{name}.json"
