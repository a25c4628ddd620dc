"""What a benchmark measures, as it is kept on disk while it runs, and as it is published.

A benchmark's folder holds

| file | content |
|---|---|
| `plan.json` | what was asked for: agents, scenes, links, conditions; see `BenchmarkPlan` |
| `results.jsonl` | one line for each finished part of a cell; see `Part` |
| `benchmark.json` | the result: see below |
| `benchmark.md` | its tables |

`benchmark.json` has these keys:

| key | content |
|---|---|
| `schema` | `BENCHMARK_SCHEMA` |
| `header` | `versions`; `scenes`, by id and set (`robot`, `score`, `sha256`, ...); `agents`, by |
| | name (`kind` "learned" or "baseline", and `policies` with file and sha256); `conditions`, by |
| | name; `links`; `port_scenes`, how many scenes are driven over the port |
| `cells` | a list: the fields of `Cell`, `refused` (why it couldn't be run, else ""), `seconds`, |
| | `summary` (figures of this cell, see `figures`), `episodes`: for each field of |
| | `EpisodeRecord` a list with an entry for each episode, null for NaN |
| `rows` | figures over all training seeds of an agent, for each id, link and condition, with |
| | `intervals` and `profile`, the share of runs whose score is above each of `taus`; see |
| | `figures.AgentRow` |
| `paired` | for each agent but the best baseline of an id, set and link: how much more it scores, |
| | and succeeds, than that baseline in the same scenes, with `interval` and `p`; see |
| | `figures.compare_pair` |
| `improvements` | probability of improvement between pairs of agents on one id, set and link |
| `taus` | thresholds of the performance profiles |
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from acsar_gym import reading
from acsar_gym.errors import ConfigError

BENCHMARK_SCHEMA = 2
"""Version of these files."""
MAX_STORE_BYTES = 200_000_000
"""Largest accepted file [bytes]."""
PLAN_FILE, RESULTS_FILE = "plan.json", "results.jsonl"


@dataclass(frozen=True, slots=True)
class Cell:
    """One cell of the benchmark's table: an agent on an id's scenes, behind one kind of link."""

    agent: str
    """Name of the agent, such as "dwa"."""
    training_seed: int | None
    """Seed of the training; None for a baseline, and for a policy that doesn't say."""
    id: str
    """Id of the env without its namespace, such as "Barn-v1"."""
    link: str
    """Name of a simulated body, or "port"."""
    condition: str
    """ "nominal", or another name of `plan.CONDITIONS`."""
    scenes: str
    """Set of scenes, such as "barn-fast" or "clutter/husky"; see `scenes.SceneSet`."""


@dataclass(frozen=True, slots=True)
class EpisodeRecord:
    """Result of one episode; NaN where a figure isn't known."""

    scene: int
    """Number of the scene: of the world, or the seed on an open floor."""
    seed: int
    """Seed of the reset."""
    success: bool
    collision: bool
    score: float
    """The set's own figure of merit, 0 without success; see `figures.score_episode`."""
    spl: float
    soft_spl: float
    time: float
    """Duration of the episode [s]."""
    steps: int
    """Policy steps."""
    path: float
    """Length of the path driven, by odometry [m]."""
    driven: float
    """Length of the path driven, by ground truth if known [m]."""
    shortest: float
    """Length of the shortest path [m]."""
    turning: float
    """Sum of absolute heading changes [rad]."""
    jerk: float
    """Smoothness of the commands; see `EpisodeResult`. Smaller is smoother."""
    clearance: float
    """Least distance between footprint and obstacles [m]."""
    energy: float
    """Mechanical work of the motors [J]."""
    odometry_error: float
    """Distance between odometry and ground truth at the end [m]."""
    cross_track: float
    """Mean cross-track error of path following [m]."""
    barn_score: float
    """BARN score with k = 2 and 2 m/s."""
    barn_score_own: float
    """BARN score with k = 2 and the robot's own top speed."""
    episode_return: float
    late_ticks: int
    fault: str
    """What ended the episode early; empty if nothing did."""


@dataclass(frozen=True, slots=True)
class Part:
    """Finished episodes of a cell: a line of `results.jsonl`."""

    cell: Cell
    first: int
    """Place of the first scene in the set."""
    episodes: list[EpisodeRecord] = field(default_factory=list)
    seconds: float = 0.0
    """CPU time that it took, without that of an emulator [s]."""
    refused: str = ""
    """Why the agent couldn't be run here; empty if it was."""

    @classmethod
    def of(cls, told: Mapping[str, Any]) -> Part:
        """Make a part from the object of its line; ValueError, TypeError or KeyError if broken."""
        given = dict(told)
        return cls(
            Cell(**given.pop("cell")), episodes=episode_records(given.pop("episodes")), **given
        )


def episode_columns(some: Sequence[EpisodeRecord]) -> dict[str, list[Any]]:
    """Return episodes as lists by field, for JSON: floats of 6 digits, NaN and infinity as None."""

    def plain(value: Any) -> Any:
        if not isinstance(value, float):
            return value
        return float(f"{value:.6g}") if math.isfinite(value) else None

    return {
        each.name: [plain(getattr(episode, each.name)) for episode in some]
        for each in fields(EpisodeRecord)
    }


def episode_records(table: Mapping[str, Sequence[Any]]) -> list[EpisodeRecord]:
    """Return the episodes of `episode_columns`; None becomes NaN."""
    names = [each.name for each in fields(EpisodeRecord)]
    rows = zip(*(table[name] for name in names), strict=True)
    known: list[list[Any]] = [[math.nan if v is None else v for v in row] for row in rows]
    return [EpisodeRecord(*row) for row in known]


class Store:
    """The folder of a benchmark that may be interrupted, and goes on where it was.

    Args:
        folder: of the benchmark; must exist.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.file = folder / RESULTS_FILE

    def open(self, plan: Mapping[str, Any]) -> list[Part]:
        """Note the plan, or check that it is the one that the folder was begun with.

        Args:
            plan: as JSON.

        Returns:
            The parts that are finished. A last line that was cut is removed from the file.

        Raises:
            ConfigError: the folder has another plan, or can't be read or written.
        """
        noted = self.folder / PLAN_FILE
        if noted.exists():
            _check_plan(noted, plan)
        elif self.file.exists():
            raise ConfigError(f"{self.file}: has no {PLAN_FILE} beside it: use another folder")
        else:
            said = json.dumps(plan, indent=2, sort_keys=True, allow_nan=False) + "\n"
            reading.write_atomically(noted, said.encode())
        if not self.file.exists():
            return []
        data = reading.read_file(self.file, MAX_STORE_BYTES)
        whole = data[: data.rfind(b"\n") + 1]
        if len(whole) < len(data):
            self._truncate(len(whole))
        parts = []
        for number, line in enumerate(whole.splitlines(), start=1):
            try:
                parts.append(Part.of(reading.parse_json(line)))
            except (ConfigError, ValueError, TypeError, LookupError, AttributeError) as error:
                raise ConfigError(
                    f"{self.file}: line {number} isn't a benchmark's: use another folder"
                ) from error
        return parts

    def add(self, part: Part) -> Part:
        """Append a part as one line, flushed to the disk; returns it as it will be read.

        Raises:
            ConfigError: it can't be written, as on a full disk; what was there before is kept.
        """
        told = asdict(part) | {"episodes": episode_columns(part.episodes)}
        data = (json.dumps(told, allow_nan=False, separators=(",", ":")) + "\n").encode()
        before = self.file.stat().st_size if self.file.exists() else 0
        try:
            with open(self.file, "ab") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            self._truncate(before)
            raise ConfigError(
                f"{self.file}: can't be written: {reading.explain_error(error)}; what was finished "
                "is kept: make room and give the same command again"
            ) from error
        return Part.of(json.loads(data))

    def _truncate(self, size: int) -> None:
        """Cut the file of results after `size` bytes; ConfigError where that fails."""
        try:
            if self.file.exists():
                os.truncate(self.file, size)
        except OSError as error:
            raise ConfigError(
                f"{self.file}: can't be written: {reading.explain_error(error)}"
            ) from error


def _check_plan(noted: Path, plan: Mapping[str, Any]) -> None:
    """Check that a plan is the noted one; ConfigError names the first key that differs."""
    content = reading.read_file(noted, MAX_STORE_BYTES)
    try:
        before = reading.parse_json(content)
        keys = sorted({*before, *plan})
    except (ConfigError, TypeError) as error:
        raise ConfigError(f"{noted}: isn't a benchmark's plan: use another folder") from error
    now = json.loads(json.dumps(plan))
    differing = next((key for key in keys if before.get(key) != now.get(key)), None)
    if differing is not None:
        raise ConfigError(
            f"{noted.parent}: holds a benchmark with another plan ({differing} differs): give it "
            "the same options, or another --out"
        )
