"""What a benchmark is asked to do: agents, conditions, and its cells, each of which is a job."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from itertools import product
from pathlib import Path
from typing import Any

import acsar_gym
from acsar_gym.config import RobotConfig
from acsar_gym.envs.ids import find_id, full_id
from acsar_gym.errors import ConfigError, PolicyError, show_value, suggest_name
from acsar_gym.physics.bodies import BODIES
from acsar_gym.physics.randomization import randomization_level
from acsar_gym.registration import IDS, snake_case
from acsar_gym.resources import AGENTS
from acsar_gym.sensors import MOVERS
from acsar_gym.tools.baselines import AMONG_MOVERS, BASELINES, PRIVILEGED_BASELINES
from acsar_gym.tools.benchmark.cells import BENCHMARK_SCHEMA, Cell
from acsar_gym.tools.benchmark.scenes import (
    GIVEN,
    OWN_NAMESPACE,
    SceneSet,
    cell_id,
    has_sensor,
)
from acsar_gym.tools.evaluation import runs
from acsar_gym.tools.evaluation.runs import PortablePolicy
from acsar_gym.tools.policies import CallablePolicy, is_callable

PACKAGED = "packaged"  # name of the agent that consists of the policies which come with the package
LEARNED, BASELINE, PRIVILEGED = "learned", "baseline", "privileged"
"""Kinds of agents. A privileged agent is a baseline that knows what only a simulator does."""
MAX_NAME_LENGTH = 60  # most characters of an agent's name


@dataclass(frozen=True, slots=True)
class Agent:
    """A policy that drives on one id: one training seed of a named agent."""

    name: str
    kind: str  # "learned", "baseline" or "privileged"
    env: str  # id of the env, with the module that registers it where there is one
    policy: str  # file, function, class or name of a baseline, as `evaluate --policy` takes it
    training_seed: int | None = None
    sha256: str | None = None

    @property
    def id(self) -> str:
        """Id of the env as results name it; see `scenes.cell_id`."""
        return cell_id(self.env)

    @property
    def about(self) -> dict[str, Any]:
        """What results say about it."""
        return {
            "kind": self.kind,
            "id": self.id,
            "training_seed": self.training_seed,
            "file": Path(self.policy).name,
            "sha256": self.sha256,
        }


def check_names(option: str, names: Iterable[str], known: Collection[str]) -> None:
    """Raise ConfigError for the first name that isn't known, with the one that may be meant."""
    for name in names:
        if name not in known:
            raise ConfigError(f"{option} {show_value(name)}{suggest_name(name[:40], known)}")


def find_env(name: str) -> str:
    """Return the full id of an env: "barn" is "acsar_gym/Barn-v1"; ConfigError if unknown."""
    env_id = full_id(name)
    if env_id.startswith(OWN_NAMESPACE) and env_id.removeprefix(OWN_NAMESPACE) not in IDS:
        known = [*IDS, *(snake_case(own.partition("-")[0]) for own in IDS)]
        raise ConfigError(f"--env {show_value(name)}{suggest_name(name[:40], known)}")
    return find_id(env_id)


def choose_agents(
    names: Sequence[str], ids: Sequence[str], trained: Path | None, seeds: int
) -> list[Agent]:
    """Find agents by their names.

    Args:
        names: "packaged", baselines, folders in `trained`, ONNX files, and functions or classes
            such as mine.planner:Planner; empty for those of the first three that
            `drives_unnamed`.
        ids: as `find_env` returns them.
        trained: folder with NAME/SEED/policy.onnx; None for none.
        seeds: most training seeds of each.
    """
    given = [
        name
        for name in dict.fromkeys(names)
        if ":" in name or Path(name).suffix in (".py", ".onnx")
    ]
    agents = [
        _read_agent(PACKAGED, str(file), None)
        for file in sorted((AGENTS / "policies").glob("*.onnx"))
    ]
    agents += [] if trained is None else trained_agents(trained, seeds, ids)
    for name in BASELINES:
        kind = PRIVILEGED if name in PRIVILEGED_BASELINES else BASELINE
        agents += [Agent(name, kind, env_id, name) for env_id in ids]
    known = list(dict.fromkeys(agent.name for agent in agents))
    check_names("--agents", [name for name in names if name not in given], known)
    benchmarked = {cell_id(env_id) for env_id in ids}
    chosen = [
        agent
        for agent in agents
        if agent.id in benchmarked and (agent.name in names if names else drives_unnamed(agent))
    ]
    chosen += [agent for name in given for agent in given_agents(name, ids)]
    counts = Counter((agent.name, agent.env, agent.training_seed) for agent in chosen)
    for (name, env_id, _), count in counts.items():
        if count > 1:
            raise ConfigError(
                f"--agents: {count} of them are called {show_value(name)} on {env_id}: rename a "
                "file, function or class"
            )
    return chosen


def drives_unnamed(agent: Agent) -> bool:
    """Whether an agent drives where `--agents` names none.

    Privileged agents don't, and those made for worlds with movers only if the robot senses them.
    """
    if agent.kind == BASELINE and agent.name in AMONG_MOVERS:
        return has_sensor(agent.env, MOVERS)
    return agent.kind != PRIVILEGED


def given_agents(policy: str, ids: Sequence[str]) -> list[Agent]:
    """Return a file, or Python code, as an agent on the id that it names, else on all of `ids`."""
    path, _, function = policy.rpartition(":")
    is_file = not path or Path(path).suffix == ".py"
    name = Path(path or policy).stem if is_file else function
    if is_callable(policy) and not CallablePolicy(policy, ids[0]).said_id:
        return [_read_agent(name, policy, None, env_id) for env_id in ids]
    agent = _read_agent(name, policy, None, named=ids)
    if agent.id not in map(cell_id, ids):
        raise ConfigError(f"--agents {policy}: drives on {agent.id}: name it with --env, too")
    return [agent]


def trained_agents(folder: Path, seeds: int, ids: Iterable[str] = ()) -> list[Agent]:
    """Find trained policies, `folder`/NAME/SEED/policy.onnx: the `seeds` smallest of each name."""
    files: dict[str, list[tuple[int, Path]]] = {}
    for file in folder.glob("*/*/policy.onnx"):
        match = re.search(r"(\d+)\D*$", file.parent.name)
        if match is None:
            raise ConfigError(
                f"{file}: its folder must be named after the seed, such as 0 or seed-0"
            )
        files.setdefault(file.parts[-3], []).append((int(match[1]), file))
    if not files:
        raise ConfigError(f"--trained {folder}: holds no NAME/SEED/policy.onnx")
    return [
        _read_agent(name, str(file), seed, named=ids)
        for name in sorted(files)
        for seed, file in sorted(files[name])[:seeds]
    ]


def _read_agent(
    name: str, policy: str, seed: int | None, env: str = "", named: Iterable[str] = ()
) -> Agent:
    """Read what a policy says about itself; `named` are ids of other packages that it may name."""
    loaded = runs.load_policy(policy, trust=False, env=env)
    for env_id in named:
        if cell_id(env_id) == cell_id(loaded.env_id):
            env = env_id
    if not env and not loaded.env_named and cell_id(loaded.env_id) not in IDS:
        raise PolicyError(
            f"{loaded.path}: made for {show_value(loaded.env_id)}, which isn't acsar_gym's: if you "
            "trust that package, name it with --env"
        )
    return Agent(name[:MAX_NAME_LENGTH], LEARNED, env or loaded.env_id, policy, seed, loaded.sha256)


NOMINAL = "nominal"


@dataclass(frozen=True)
class Condition:
    """What differs from the robot and the wire as configured."""

    words: str  # what it is, for tables
    changes: Mapping[str, Any] = field(default_factory=dict)
    """Fields of the robot's config that differ, as `RobotConfig.with_` takes them."""
    randomization: int = 0  # level of `physics.randomization`; 0 for none
    faults: Mapping[str, float] = field(default_factory=dict)
    """Faults of the wire; see `links.faults.Faults`."""

    def options(self, scenes: SceneSet, config: RobotConfig) -> dict[str, Any]:
        """Return the options of an id's env besides the robot; None where nothing changes."""
        level = self.randomization
        return {
            "worlds": scenes.worlds,
            "difficulty": scenes.difficulty,
            "randomization": randomization_level(config, level) if level else None,
            "faults": dict(self.faults) or None,
        }

    def impossible(self, link: str) -> str:
        """Say why no agent can be measured under this condition; empty if one can."""
        if self.randomization and link == PORT:
            return f"{self.words}: the emulated board's physics don't vary"
        if (self.randomization or self.changes) and link == ROS2:
            return f"{self.words}: a robot in ROS is as it is"
        return ""


CONDITIONS: dict[str, Condition] = {
    NOMINAL: Condition("as configured"),
    "randomization-1": Condition("half the randomization of training", randomization=1),
    "randomization-2": Condition("the randomization of training", randomization=2),
    "randomization-3": Condition("twice the randomization of training", randomization=3),
    "dropped-2": Condition("2 % of the lines lost", faults={"dropped_lines": 0.02}),
    "dropped-5": Condition("5 % of the lines lost", faults={"dropped_lines": 0.05}),
    "level-2-dropped-2": Condition(
        "randomization of training, 2 % of the lines lost",
        randomization=2,
        faults={"dropped_lines": 0.02},
    ),
    "late-lines": Condition("5 % of the lines 50 ms late", faults={"late_lines": 0.05}),
    "scan-dropouts": Condition(
        "10 % of the rays without echo", changes={"lidar": {"dropouts": 0.1}}
    ),
    "feedback-30": Condition("30 Hz feedback", changes={"firmware": {"feedback_rate": 30.0}}),
    "feedback-20": Condition("20 Hz feedback", changes={"firmware": {"feedback_rate": 20.0}}),
    "baud-38400": Condition("38400 baud", changes={"baud_rate": 38400}),
    "command-delay": Condition(
        "commands work 50 ms later", changes={"firmware": {"command_delay": 0.05}}
    ),
}
"""Conditions by name."""


PLANAR, BULLET, PORT, ROS2 = "planar", "bullet", "port", "ros2"
REAL_TIME_LINKS = (PORT, ROS2)
LINK_KINDS = (*BODIES, *REAL_TIME_LINKS)


@dataclass(frozen=True, slots=True)
class BenchmarkJob:
    """A cell, for one process."""

    cell: Cell
    policy: PortablePolicy
    """The policy, with what its file contains: another machine may not have the file."""
    scenes: SceneSet
    count: int  # how many scenes are driven
    key: str = ""
    """All that its result depends on."""


@dataclass(frozen=True)
class BenchmarkPlan:
    """Everything that a benchmark measures; ConfigError for an unknown link or condition."""

    agents: tuple[Agent, ...]
    sets: tuple[SceneSet, ...]  # scenes, robots and scores, each of an agent's id
    links: tuple[str, ...] = (PLANAR, BULLET)
    conditions: tuple[str, ...] = (NOMINAL,)
    count: int = 200  # scenes of every cell; fewer where a folder holds fewer
    port_count: int = 40  # scenes of every cell in real time: behind the emulated port, or in ROS

    def __post_init__(self) -> None:
        check_names("--links", self.links, LINK_KINDS)
        check_names("--conditions", self.conditions, CONDITIONS)
        if self.is_real_time and self.port_count < 1:
            raise ConfigError(f"--port-scenes {self.port_count}: must be at least 1")
        if not self.agents:
            raise ConfigError("--agents: none of them drives on any of these --env")

    @property
    def is_real_time(self) -> bool:
        """Whether any of the links takes real time."""
        return not {*self.links}.isdisjoint(REAL_TIME_LINKS)

    def count_scenes(self, some: SceneSet) -> int:
        """Return how many scenes of a set are used in a simulation."""
        return min(self.count, len(some)) if some.split == GIVEN else self.count

    def check(self) -> None:
        """Compare the scenes with the recorded ones; ConfigError if they are others."""
        for some in self.sets:
            some.check(self.count_scenes(some))

    def as_dict(self) -> dict[str, Any]:
        """Return the plan for JSON; equal plans give equal results."""
        agents: dict[str, list[dict[str, Any]]] = {}
        for agent in self.agents:
            agents.setdefault(agent.name, []).append(agent.about)
        scenes: dict[str, dict[str, Any]] = {}
        for some in self.sets:
            about = some.about | {"count": self.count_scenes(some)}
            scenes.setdefault(some.id, {})[some.name] = about
        return {
            "schema": BENCHMARK_SCHEMA,
            "version": acsar_gym.__version__,
            "agents": agents,
            "links": list(self.links),
            "conditions": {name: condition_fields(CONDITIONS[name]) for name in self.conditions},
            "scenes": scenes,
            "port_scenes": self.port_count if self.is_real_time else 0,
        }

    def jobs(self) -> Iterator[BenchmarkJob]:
        """Yield the jobs, cells of one set and link after the other."""
        policies = [
            PortablePolicy.of(runs.load_policy(agent.policy, trust=False, env=agent.env))
            for agent in self.agents
        ]
        for scenes, condition, link in product(self.sets, self.conditions, self.links):
            count = self.count_scenes(scenes)
            count = min(count, self.port_count) if link in REAL_TIME_LINKS else count
            for agent, policy in zip(self.agents, policies, strict=True):
                if agent.id == scenes.id:
                    cell = Cell(
                        agent.name, agent.training_seed, scenes.id, link, condition, scenes.name
                    )
                    given = {
                        "versions": [BENCHMARK_SCHEMA, acsar_gym.__version__],
                        "cell": asdict(cell),
                        "agent": agent.about,
                        "scenes": scenes.about | {"count": count},
                        "condition": condition_fields(CONDITIONS[condition]),
                    }
                    key = json.dumps(given, sort_keys=True)
                    yield BenchmarkJob(cell, policy, scenes, count, key)


def condition_fields(condition: Condition) -> dict[str, Any]:
    """Return the fields of a condition for JSON, without empty ones."""
    return {name: value for name, value in asdict(condition).items() if value}
