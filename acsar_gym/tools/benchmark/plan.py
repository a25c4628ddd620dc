"""What a benchmark measures: agents on sets of scenes, behind links, under conditions."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from itertools import product
from typing import Any, NamedTuple

import acsar_gym
from acsar_gym.errors import ConfigError
from acsar_gym.physics.bodies import BODIES
from acsar_gym.physics.randomization import randomization_level
from acsar_gym.resources import PACKAGE, hash_sources
from acsar_gym.tasks.options import check_names
from acsar_gym.tools.benchmark.agents import Agent
from acsar_gym.tools.benchmark.figures import Scoring
from acsar_gym.tools.benchmark.scenes import GIVEN, SceneSet, make_planar
from acsar_gym.tools.evaluation.runs import EpisodeJob, send_policy

NOMINAL = "nominal"
ROS2 = "ros2"
LINKS = (*BODIES, ROS2)


@dataclass(frozen=True)
class Condition:
    """What differs from the robot and the wire as configured."""

    changes: Mapping[str, Any] = field(default_factory=dict)
    """Fields of the robot's config that differ, as `RobotConfig.with_` takes them."""
    randomization: int = 0
    """Level of `physics.randomization`: 1 is half that of training, 2 the same, 3 twice that."""
    faults: Mapping[str, float] = field(default_factory=dict)
    """Faults of the wire, see `links.faults.Faults`. Such robots are driven one at a time."""


CONDITIONS: dict[str, Condition] = {
    NOMINAL: Condition(),
    "randomization-1": Condition(randomization=1),
    "randomization-2": Condition(randomization=2),
    "randomization-3": Condition(randomization=3),
    "dropped-2": Condition(faults={"dropped_lines": 0.02}),
    "dropped-5": Condition(faults={"dropped_lines": 0.05}),
    "level-2-dropped-2": Condition(randomization=2, faults={"dropped_lines": 0.02}),
    "late-lines": Condition(faults={"late_lines": 0.05}),
    "scan-dropouts": Condition({"lidar": {"dropouts": 0.1}}),
    "feedback-30": Condition({"firmware": {"feedback_rate": 30.0}}),
    "feedback-20": Condition({"firmware": {"feedback_rate": 20.0}}),
    "baud-38400": Condition({"baud_rate": 38400}),
    "command-delay": Condition({"firmware": {"command_delay": 0.05}}),
}
"""Conditions by name. Rates are in Hz, the delay in s, all others are shares."""


class Place(NamedTuple):
    """What agents that are compared share."""

    id: str
    """Id of the env without its namespace, such as "Barn-v1"."""
    scenes: str
    """Set of scenes, such as "barn-fast" or "clutter/husky"."""
    link: str
    condition: str


@dataclass(frozen=True)
class Cell:
    """An agent's policy at a place: a job of the benchmark."""

    agent: Agent
    scenes: SceneSet
    """The scenes that are driven."""
    place: Place

    @property
    def about(self) -> dict[str, Any]:
        """What identifies its result."""
        seed = self.agent.training_seed
        return {"agent": self.agent.name, "training_seed": seed, **self.place._asdict()}

    @property
    def scoring(self) -> Scoring:
        """How its episodes are scored. ConfigError if the task doesn't report the score."""
        task = make_planar(self.scenes.env).task
        return Scoring.of(task, self.scenes.score, self.scenes.config.max_linear)

    @property
    def job(self) -> EpisodeJob:
        """The job of its episodes."""
        condition = CONDITIONS[self.place.condition]
        config = self.scenes.config.with_(**condition.changes)
        level = condition.randomization
        options = {
            "worlds": self.scenes.worlds,
            "difficulty": self.scenes.difficulty,
            "randomization": randomization_level(config, level) if level else None,
            "faults": dict(condition.faults) or None,
        }
        load = send_policy(self.agent.policy)
        return EpisodeJob(load, self.place.link, config, options=options, resets=self.scenes.resets)


@dataclass(frozen=True)
class Plan:
    """Everything that a benchmark measures.

    Raises:
        ConfigError: A link or condition is unknown, a robot in ROS can't have a condition, or a
            task doesn't report the score of its scenes.
    """

    agents: tuple[Agent, ...]
    sets: tuple[SceneSet, ...]
    links: tuple[str, ...] = ("planar", "bullet")
    conditions: tuple[str, ...] = (NOMINAL,)
    count: int = 200
    """Scenes of every cell, fewer if a folder holds fewer."""

    def __post_init__(self) -> None:
        check_names("--links {}", self.links, LINKS)
        check_names("--conditions {}", self.conditions, CONDITIONS)
        if ROS2 in self.links and self.conditions != (NOMINAL,):
            raise ConfigError("--links ros2: drives under the condition nominal only")
        for cell in self.cells():
            cell.scoring  # noqa: B018 - a missing score is an error before anything drives

    def count_scenes(self, scenes: SceneSet) -> int:
        """Return how many scenes of a set are driven."""
        return min(self.count, len(scenes)) if scenes.split == GIVEN else self.count

    def cells(self) -> Iterator[Cell]:
        """Yield the cells, of one set and link after the other."""
        for scenes, link, condition in product(self.sets, self.links, self.conditions):
            driven = replace(scenes, numbers=scenes.numbers[: self.count_scenes(scenes)])
            place = Place(scenes.id, scenes.name, link, condition)
            for agent in self.agents:
                if agent.env == scenes.env:
                    yield Cell(agent, driven, place)

    def as_dict(self) -> dict[str, Any]:
        """Return the plan for JSON, with hashes. Equal plans give equal results."""
        # Training seeds of an agent share its name.
        agents: dict[str, list[dict[str, Any]]] = {}
        for agent in self.agents:
            agents.setdefault(agent.name, []).append(agent.about)
        return {
            "version": acsar_gym.__version__,
            "sources": hash_sources(PACKAGE),
            "agents": agents,
            "links": list(self.links),
            "conditions": {name: asdict(CONDITIONS[name]) for name in self.conditions},
            "scenes": {
                f"{scenes.id} {scenes.name}": scenes.about | {"count": self.count_scenes(scenes)}
                for scenes in self.sets
            },
        }
