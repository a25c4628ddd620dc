"""What a benchmark is asked to do.

Agents, conditions, its cells, and the jobs that they are cut into.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from itertools import product
from pathlib import Path
from typing import Any

import acsar_gym
from acsar_gym.config import RobotConfig
from acsar_gym.envs.ids import full_id
from acsar_gym.errors import ConfigError, PolicyError, show_value, suggest_name
from acsar_gym.physics.bodies import BODIES
from acsar_gym.physics.randomization import randomization_level
from acsar_gym.registration import IDS
from acsar_gym.resources import AGENTS
from acsar_gym.tools.baselines import BASELINES
from acsar_gym.tools.benchmark import scenes
from acsar_gym.tools.benchmark.scenes import SCENES, SceneSet
from acsar_gym.tools.benchmark.store import BENCHMARK_SCHEMA, Cell
from acsar_gym.tools.evaluation import runs
from acsar_gym.tools.evaluation.shards import PortablePolicy
from acsar_gym.worlds.generators import BARN_ROBOT_RADIUS
from acsar_gym.worlds.search import footprint_radius

PACKAGED = "packaged"
"""Name of the agent that consists of the policies which come with the package."""
LEARNED, BASELINE = "learned", "baseline"
MAX_NAME_LENGTH = 60
"""Most characters of an agent's name."""


@dataclass(frozen=True, slots=True)
class Agent:
    """A policy that drives on one id: one training seed of a named agent."""

    name: str
    kind: str
    """ "learned" or "baseline"."""
    id: str
    """Id of the env without its namespace."""
    policy: str
    """File, or name of a baseline, as `--policy` takes it."""
    training_seed: int | None = None
    sha256: str | None = None

    @property
    def about(self) -> dict[str, Any]:
        """What results say about it."""
        return {
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


def short_id(env_id: str) -> str:
    """Remove the namespace from an id of this package: "barn" is "Barn-v1".

    Raises:
        ConfigError: the benchmark has no scenes for it.
    """
    name = full_id(env_id).removeprefix("acsar_gym/")
    if name not in IDS:
        raise ConfigError(f"--ids {show_value(env_id)}{suggest_name(name[:40], IDS)}")
    return name


def choose_agents(
    names: Sequence[str], ids: Sequence[str], trained: Path | None, seeds: int
) -> list[Agent]:
    """Find agents by their names.

    Args:
        names: "packaged", baselines, and folders in `trained`; empty for all.
        ids: without namespace.
        trained: folder with NAME/SEED/policy.onnx; None for none.
        seeds: most training seeds of each.

    Raises:
        ConfigError: a name is unknown, or the folder holds no policy.
        PolicyError: a policy can't be used.
    """
    learned = [
        agent
        for file in sorted((AGENTS / "policies").glob("*.onnx"))
        for agent in _read_agent(PACKAGED, file, None)
    ]
    learned += [] if trained is None else trained_agents(trained, seeds)
    found = [each for each in (*learned, *baseline_agents(ids)) if each.id in ids]
    known = list(dict.fromkeys([*(each.name for each in learned), *BASELINES]))
    check_names("--agents", names, known)
    return [each for each in found if not names or each.name in names]


def baseline_agents(ids: Iterable[str]) -> list[Agent]:
    """Return every baseline on every id; those that can't drive there are refused later."""
    return [Agent(name, BASELINE, each, name) for name in BASELINES for each in ids]


def trained_agents(folder: Path, seeds: int) -> list[Agent]:
    """Find trained policies: `folder`/NAME/SEED/policy.onnx.

    Args:
        folder: as `--trained`.
        seeds: most seeds of each name, the smallest first.

    Raises:
        ConfigError: there is none.
    """
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
        agent
        for name in sorted(files)
        for seed, file in sorted(files[name])[:seeds]
        for agent in _read_agent(name, file, seed)
    ]


def submitted_agent(policy: str) -> Agent:
    """Return anybody's policy as an agent.

    Args:
        policy: an ONNX file, or a function such as mine.py:act.

    Raises:
        PolicyError: it can't be used, or is for an id without scenes.
    """
    (found,) = _read_agent(
        Path(policy.rpartition(":")[0] or policy).stem[:MAX_NAME_LENGTH], policy, None
    )
    return found


def _read_agent(name: str, file: str | Path, seed: int | None) -> list[Agent]:
    """Read what a policy says about itself."""
    loaded = runs.load_policy(str(file), trust=False)
    env_id = loaded.env_id.removeprefix("acsar_gym/")
    if env_id not in IDS:
        raise PolicyError(
            f"{file}: made for {show_value(loaded.env_id)}, for which there are no "
            "scenes; there are "
            f"some for {', '.join(IDS)}"
        )
    return [Agent(name[:MAX_NAME_LENGTH], LEARNED, env_id, str(file), seed, loaded.sha256)]


NOMINAL = "nominal"


@dataclass(frozen=True)
class Condition:
    """A robot and a wire under which agents drive."""

    words: str
    """What it is, for tables."""
    robot: str | None = None
    """Preset of the robot; None for the default."""
    changes: Mapping[str, Any] = field(default_factory=dict)
    """Fields of the robot's config that differ, as `RobotConfig.with_` takes them."""
    randomization: int = 0
    """Level of `physics.randomization`; 0 for none."""
    faults: Mapping[str, float] = field(default_factory=dict)
    """Faults of the wire; see `links.faults.Faults`."""
    difficulty: Mapping[str, float] = field(default_factory=dict)
    """Difficulty of a generator's worlds, for a robot that doesn't fit through harder ones."""

    @property
    def config(self) -> RobotConfig:
        """The robot."""
        return RobotConfig.of(self.robot).with_(**self.changes)

    def options(self, config: RobotConfig, source: str = "") -> dict[str, Any]:
        """Return the env's options besides the robot; those that change nothing are left out.

        Args:
            config: of the robot.
            source: generator of the worlds; "" for an open floor.
        """
        found: dict[str, Any] = {}
        if source in self.difficulty:
            found["difficulty"] = self.difficulty[source]
        if self.randomization:
            found["randomization"] = randomization_level(config, self.randomization)
        if self.faults:
            found["faults"] = dict(self.faults)
        return found

    def impossible(self, *, simulated: bool, published: bool) -> str:
        """Say why no agent can be measured under this condition; empty if one can.

        Args:
            simulated: whether the link is a simulation in this process.
            published: whether the worlds are the published ones of BARN, which are as they are.
        """
        if self.randomization and not simulated:
            return f"{self.words}: the emulated board's physics don't vary"
        radius = footprint_radius(self.config)
        if published and radius > BARN_ROBOT_RADIUS:
            return (
                f"{self.words}: the published worlds let a footprint of {BARN_ROBOT_RADIUS:.3g} m "
                f"radius through, this one has {radius:.3g} m"
            )
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
    "husky": Condition(
        "a robot like a Husky, in Barn at difficulty 0.2", robot="husky", difficulty={"barn": 0.2}
    ),
    "jackal": Condition("a robot like a Jackal", robot="jackal"),
}
"""Conditions by name. Robots of another size drive in worlds of the same numbers, made for their
footprint. A Husky is wider than the gaps of most BARN worlds: only those of the least filled fields
(difficulty below 0.25) can be made for it."""


PLANAR, BULLET, PORT = "planar", "bullet", "port"
LINK_KINDS = (*BODIES, PORT)
CHUNK_SIZES = dict.fromkeys(BODIES, 50) | {PORT: 5}
"""Scenes of a job, at most: what is lost when a benchmark is interrupted."""


@dataclass(frozen=True, slots=True)
class BenchmarkJob:
    """Some scenes of a cell, for one process."""

    cell: Cell
    policy: PortablePolicy
    """The policy, with what its file contains: another machine may not have the file."""
    scenes: SceneSet
    first: int
    """Place of the first scene in the set."""
    count: int


@dataclass(frozen=True)
class BenchmarkPlan:
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
        check_names("--links", self.links, LINK_KINDS)
        check_names("--conditions", self.conditions, CONDITIONS)
        if PORT in self.links and self.port_count < 1:
            raise ConfigError(f"--port-scenes {self.port_count}: must be at least 1")
        if not self.agents:
            raise ConfigError("--agents: none of them drives on any of these --ids")

    def sets(self, env_id: str) -> list[tuple[SceneSet, int]]:
        """Return the sets of scenes of an id, and how many of each are used."""
        found = [(SCENES[env_id].test, self.count)]
        if self.barn is not None and env_id.startswith("Barn-"):
            own = scenes.published_scenes(env_id, self.barn)
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
            "schema": BENCHMARK_SCHEMA,
            "version": acsar_gym.__version__,
            "agents": told,
            "ids": list(self.ids),
            "links": list(self.links),
            "conditions": {name: condition_fields(CONDITIONS[name]) for name in self.conditions},
            "scenes": {
                env_id: {some.name: some.about | {"count": count} for some, count in sets}
                for env_id, sets in ((env_id, self.sets(env_id)) for env_id in self.ids)
            },
            "port_scenes": self.port_count if PORT in self.links else 0,
        }

    def jobs(self) -> Iterator[BenchmarkJob]:
        """Yield the jobs, cells of one id and link after the other.

        Raises:
            PolicyError: a policy's file can't be read any more.
        """
        policies = {
            each: PortablePolicy.of(
                runs.load_policy(each.policy, trust=False, env=f"acsar_gym/{each.id}")
            )
            for each in self.agents
        }
        for env_id, condition, link in product(self.ids, self.conditions, self.links):
            for some, count in self.sets(env_id):
                used = min(count, self.port_count) if link == PORT else count
                chunk = CHUNK_SIZES[link]
                for each in (each for each in self.agents if each.id == env_id):
                    cell = Cell(each.name, each.training_seed, env_id, link, condition, some.name)
                    for first in range(0, used, chunk):
                        size = min(chunk, used - first)
                        yield BenchmarkJob(cell, policies[each], some, first, size)


def condition_fields(condition: Condition) -> dict[str, Any]:
    """Return the fields of a condition for JSON, without empty ones."""
    return {name: value for name, value in asdict(condition).items() if value}
