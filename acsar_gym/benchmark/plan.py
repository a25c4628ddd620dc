"""What a benchmark is asked to do: its cells, and the jobs that they are cut into."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path
from typing import Any

import acsar_gym
from acsar_gym.benchmark import scenes
from acsar_gym.benchmark.agents import Agent
from acsar_gym.benchmark.conditions import CONDITIONS, NOMINAL, Condition
from acsar_gym.benchmark.scenes import SCENES, SceneSet
from acsar_gym.benchmark.store import SCHEMA, Cell
from acsar_gym.errors import ConfigError, shown, suggestion
from acsar_gym.evaluation import runs
from acsar_gym.scaling.sent import Sent

PLANAR, BULLET, PORT = "planar", "bullet", "port"
LINKS = (PLANAR, BULLET, PORT)
CHUNKS = {PLANAR: 50, BULLET: 50, PORT: 5}
"""Scenes of a job, at most: what is lost when a benchmark is interrupted."""


@dataclass(frozen=True, slots=True)
class Job:
    """Some scenes of a cell, for one process."""

    cell: Cell
    policy: Sent
    """The policy, with what its file contains: another machine may not have the file."""
    scenes: SceneSet
    first: int
    """Place of the first scene in the set."""
    count: int


@dataclass(frozen=True)
class Plan:
    """Everything that a benchmark measures.

    Raises ConfigError for an unknown link, or more scenes than there are.
    """

    agents: tuple[Agent, ...]
    ids: tuple[str, ...]
    links: tuple[str, ...] = (PLANAR, BULLET)
    conditions: tuple[str, ...] = (NOMINAL,)
    count: int = 200
    """Scenes of every cell."""
    port_count: int = 40
    """Scenes of every cell behind the emulated port, which takes real time."""
    barn: Path | None = None
    """Folder with the published worlds of BARN; None for none."""

    def __post_init__(self) -> None:
        for link in self.links:
            if link not in LINKS:
                raise ConfigError(f"--links {shown(link)}{suggestion(link[:40], LINKS)}")
        if PORT in self.links and self.port_count < 1:
            raise ConfigError(f"--port-scenes {self.port_count}: must be at least 1")
        if not self.agents:
            raise ConfigError("--agents: none of them drives on any of these --ids")

    def sets(self, env_id: str) -> list[tuple[SceneSet, int]]:
        """Return the sets of scenes of an id, and how many of each are used."""
        found = [(SCENES[env_id].test, self.count)]
        if self.barn is not None and env_id.startswith("Barn-"):
            own = scenes.published(env_id, self.barn)
            found.append((own, min(self.count, len(own))))
        return found

    def check(self) -> None:
        """Compare the scenes with the recorded ones; ConfigError if they are others."""
        for env_id in self.ids:
            for some, count in self.sets(env_id):
                some.check(count)

    def as_dict(self) -> dict[str, Any]:
        """Return the plan for JSON; equal plans give equal results."""
        told: dict[str, list[dict[str, Any]]] = {}
        for each in self.agents:
            told.setdefault(each.name, []).append({"kind": each.kind, **each.about})
        return {
            "schema": SCHEMA,
            "version": acsar_gym.__version__,
            "agents": told,
            "ids": list(self.ids),
            "links": list(self.links),
            "conditions": {name: plain(CONDITIONS[name]) for name in self.conditions},
            "scenes": {
                env_id: {some.name: some.about | {"count": count} for some, count in sets}
                for env_id, sets in ((env_id, self.sets(env_id)) for env_id in self.ids)
            },
            "port_scenes": self.port_count if PORT in self.links else 0,
        }

    def jobs(self) -> Iterator[Job]:
        """Yield the jobs, cells of one id and link after the other.

        Raises:
            PolicyError: a policy's file can't be read any more.
        """
        policies = {each: _sent(each) for each in self.agents}
        for env_id, condition, link in product(self.ids, self.conditions, self.links):
            for some, count in self.sets(env_id):
                used = min(count, self.port_count) if link == PORT else count
                for each in self.agents:
                    if each.id == env_id:
                        cell = Cell(
                            each.name, each.training_seed, env_id, link, condition, some.name
                        )
                        yield from _cut(cell, policies[each], some, used)


def _sent(one: Agent) -> Sent:
    """Read an agent's policy."""
    return Sent.of(runs.load(one.policy, trust=False, env=f"acsar_gym/{one.id}"))


def _cut(cell: Cell, policy: Sent, some: SceneSet, count: int) -> Iterator[Job]:
    """Yield the jobs of a cell."""
    chunk = CHUNKS[cell.link]
    for first in range(0, count, chunk):
        yield Job(cell, policy, some, first, min(chunk, count - first))


def plain(condition: Condition) -> dict[str, Any]:
    """Return the fields of a condition for JSON, without empty ones."""
    return {name: value for name, value in asdict(condition).items() if value}
