"""What a benchmark measures: agents on sets of scenes, behind links, under conditions."""

from __future__ import annotations

import math
import re
import warnings
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import acsar_gym
from acsar_gym.errors import AcsarWarning, ConfigError, PolicyError, show_value, suggest_name
from acsar_gym.physics.bodies import BODIES
from acsar_gym.physics.randomization import randomization_level
from acsar_gym.registration import IDS
from acsar_gym.resources import AGENTS, PACKAGE, hash_modules, hash_sources
from acsar_gym.sensors import MOVERS
from acsar_gym.tasks import Task
from acsar_gym.tasks.factory import task_name
from acsar_gym.tasks.options import check_names
from acsar_gym.tasks.task import info_names, says_shortest_path
from acsar_gym.tools.baselines import AMONG_MOVERS, BASELINES, PRIVILEGED_BASELINES
from acsar_gym.tools.benchmark.scenes import (
    COMPLETION_TIME,
    GIVEN,
    SUCCESS,
    SceneSet,
    make_planar,
    short_id,
)
from acsar_gym.tools.evaluation.episode import Episode
from acsar_gym.tools.evaluation.runs import EpisodeJob, load_policy, send_policy
from acsar_gym.tools.policies import CallablePolicy, FilePolicy, is_callable

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


CROSS_TRACK = "cross_track"
WORST_CROSS_TRACK = 0.1
"""Mean cross-track error from which on following a path scores nothing [m]."""


def check_score(task: Task, name: str) -> None:
    """Raise ConfigError unless a task's episodes can be scored so."""
    if name == COMPLETION_TIME and not says_shortest_path(task):
        raise ConfigError(
            f"{task_name(task)}: score {COMPLETION_TIME!r}: the task has no method "
            "shortest_path(): write one, or score 'success'"
        )
    names = (COMPLETION_TIME, CROSS_TRACK, SUCCESS, *info_names(task))
    check_names(f"{task_name(task)}: score {{}}", [name], names)


def score_episode(episode: Episode, name: str, *, top_speed: float, tolerance: float) -> float:
    """Return the score of an episode, 0 without success.

    COMPLETION_TIME is success weighted by completion time (Yokoyama, Ha & Batra 2021): T* / max(T,
    T*), where T is the time that it took, and T* that of the shortest path, up to the goal's
    tolerance, at the robot's top speed. It is 1 if the shortest path isn't known. CROSS_TRACK is 1
    minus the mean cross-track error / 10 cm, SUCCESS 1. Any other name is that of a number which
    the task reports at the end, such as "barn_score".

    Args:
        episode: The episode.
        name: Name of the score, see `check_score`.
        top_speed: Top speed of the robot [m/s].
        tolerance: Distance to the goal that is a success [m].
    """
    # Every failure counts as 0, so that agents which give up early gain nothing.
    if not episode.success:
        return 0.0
    if name == CROSS_TRACK:
        return max(0.0, 1.0 - episode.cross_track / WORST_CROSS_TRACK)
    if name not in (COMPLETION_TIME, SUCCESS):
        return episode.told[name]
    if name == SUCCESS or math.isnan(episode.shortest):
        return 1.0

    # The robot has arrived when the goal is as near as the tolerance.
    fastest = max(episode.shortest - tolerance, 0.0) / top_speed
    # A goal that is reached at once takes no time: 1e-9 avoids 0 / 0.
    return fastest / max(episode.time, fastest, 1e-9)


PACKAGED = "packaged"
"""Name of the agent that consists of the policies of this package."""
LEARNED = "learned"
BASELINE = "baseline"
PRIVILEGED = "privileged"
"""Kinds of agents. A privileged agent is a baseline that knows the simulator's truth."""
MAX_NAME_LENGTH = 60
"""Most characters of an agent's name, so that tables stay readable."""
Sources = list[tuple[int | None, str]]
"""Training seeds, and what `load_policy` takes."""


@dataclass(frozen=True)
class Agent:
    """A policy that drives on an id: a training seed of a named agent."""

    name: str
    kind: str
    """ "learned", "baseline" or "privileged"."""
    env: str
    """Id of the env, with the module that registers it if the user named that."""
    policy: FilePolicy = field(repr=False)
    training_seed: int | None = None

    @property
    def about(self) -> dict[str, Any]:
        """What results contain about it."""
        return {
            "kind": self.kind,
            "id": short_id(self.env),
            "training_seed": self.training_seed,
            "file": self.policy.path.name,
            "sha256": _hash_policy(self.policy),
        }


def _hash_policy(policy: FilePolicy) -> str | None:
    """Hash a policy's file, or the source of its code and of the user's modules that it imports."""
    if not isinstance(policy, CallablePolicy) or policy.instance is not None:
        return policy.sha256

    # Code may import modules of the user, whose changes matter as well.
    path = policy.path
    module = f"acsar_gym_policy_{path.stem}" if path.suffix == ".py" else f"{path}".split(":")[0]
    return hash_modules(module)


def choose_agents(
    names: Sequence[str], sets: Sequence[SceneSet], trained: Path | None, seeds: int
) -> list[Agent]:
    """Find agents by their names.

    Args:
        names: "packaged", baselines, folders in `trained`, ONNX files, and functions or classes
            such as mine.planner:Planner. If there are none, those of the first three that can
            drive, without baselines that know the simulator's truth.
        sets: Scenes that they drive.
        trained: Folder with NAME/SEED/policy.onnx. None for none.
        seeds: Most training seeds of each.

    Raises:
        ConfigError: A named agent doesn't exist, or has no policy for the id of a set.
        PolicyError: A policy can't be loaded.
    """
    envs = list(dict.fromkeys(scenes.env for scenes in sets))
    packaged = sorted((AGENTS / "policies").glob("*.onnx"))
    files: dict[str, Sources] = {PACKAGED: [(None, str(file)) for file in packaged]}
    if trained is not None:
        files |= find_trained(trained, seeds)

    # An agent that the user named must drive in every set: a missing row is easily overlooked.
    agents: list[Agent] = []
    for name in dict.fromkeys(names or [*files, *BASELINES]):
        chosen = list(_load_agents(name, files, envs))
        driven = {agent.env for agent in chosen}
        missing = [scenes for scenes in sets if scenes.env not in driven]
        if names and missing:
            raise ConfigError(
                f"--agents {name}: has no policy for {missing[0].id} of set {missing[0].name}: "
                "name other --sets, or leave it out"
            )
        # Trained policies may be for other ids, but their user would wait for a row.
        if not chosen and name not in (PACKAGED, *BASELINES):
            warnings.warn(
                f"--trained: {name} has no policy for {', '.join(map(short_id, envs))} and doesn't "
                "drive: name its --env or --sets",
                AcsarWarning,
                stacklevel=2,
            )
        # An agent that the user named drives even if it knows the simulator's truth.
        agents += chosen if names else filter(_is_default, chosen)

    # Rows are named after agents.
    counts = Counter((agent.name, agent.env, agent.training_seed) for agent in agents)
    for (name, env_id, _), count in counts.items():
        if count > 1:
            raise ConfigError(
                f"--agents: {count} of them are called {show_value(name)} on {env_id}: rename a "
                "file, function or class, or name trained policies by their folder with --trained"
            )
    return agents


def _load_agents(name: str, files: dict[str, Sources], envs: Sequence[str]) -> Iterator[Agent]:
    """Load an agent for each id that it drives."""
    # A name is that of a folder or a baseline, or means a policy of the user.
    label = name
    kind = LEARNED
    sources: Sources = [(None, name)]
    if name in files:
        sources = files[name]
    elif name in BASELINES:
        kind = PRIVILEGED if name in PRIVILEGED_BASELINES else BASELINE
    elif ":" in name or Path(name).suffix in (".py", ".onnx"):
        path, _, function = name.rpartition(":")
        is_file = not path or Path(path).suffix == ".py"
        label = Path(path or name).stem if is_file else function
    else:
        raise ConfigError(
            f"--agents {show_value(name)}{suggest_name(name[:40], [*files, *BASELINES])}"
        )

    # A policy drives on the id that it names. Baselines, and code that names none, drive on all.
    for seed, source in sources:
        named_id = "" if kind != LEARNED else _read_id(source, envs[0])
        _check_id(source, named_id, envs)
        for env_id in envs:
            if named_id in ("", short_id(env_id)):  # only users name ids of other packages
                # A zip can run code while it is loaded, so it is refused here.
                policy = load_policy(source, trust=False, env=env_id)
                yield Agent(label[:MAX_NAME_LENGTH], kind, env_id, policy, seed)


def _read_id(source: str, env_id: str) -> str:
    """Return the id that a policy is for. Empty for code that names none."""
    if is_callable(source):
        return short_id(CallablePolicy(source, env_id).said_id)
    return short_id(load_policy(source, trust=False).env_id)


def _check_id(source: str, named_id: str, envs: Sequence[str]) -> None:
    """Raise PolicyError for a file that is for an id of another package, if the user names none."""
    # Otherwise its agent would have no row, and no message.
    if named_id in IDS or named_id in ("", *map(short_id, envs)) or is_callable(source):
        return
    raise PolicyError(
        f"{source}: made for {show_value(named_id)}, which isn't acsar_gym's: if you trust that "
        "package, name it with --env"
    )


def _is_default(agent: Agent) -> bool:
    """Whether an agent drives if none are named."""
    if agent.name in AMONG_MOVERS:
        return any(sensor.name == MOVERS for sensor in make_planar(agent.env).sensors)
    return agent.kind != PRIVILEGED


def find_trained(folder: Path, seeds: int) -> dict[str, Sources]:
    """Find trained policies, `folder`/NAME/SEED/policy.onnx: the first seeds and files by name."""
    files: dict[str, Sources] = {}
    # The name of the folder is the name of the agent, the number in that below it the seed.
    for file in sorted(folder.glob("*/*/policy.onnx")):
        digits = re.findall(r"\d+", file.parent.name)
        if not digits:
            raise ConfigError(
                f"{file}: its folder must be named after the seed, such as 0 or seed-0"
            )
        files.setdefault(file.parts[-3], []).append((int(digits[-1]), str(file)))
    if not files:
        raise ConfigError(f"--trained {folder}: holds no NAME/SEED/policy.onnx")
    return {name: sorted(sources)[:seeds] for name, sources in files.items()}


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

    def score(self, episodes: Sequence[Episode]) -> list[Episode]:
        """Return episodes of the cell with their scores."""
        top_speed = self.scenes.config.max_linear
        tolerance = make_planar(self.scenes.env).task.goal_tolerance
        score = partial(
            score_episode, name=self.scenes.score, top_speed=top_speed, tolerance=tolerance
        )
        return [replace(episode, score=score(episode)) for episode in episodes]

    @property
    def job(self) -> EpisodeJob:
        """The job of its episodes."""
        # A condition changes the robot, the physics, or the wire.
        condition = CONDITIONS[self.place.condition]
        config = self.scenes.config.with_(**condition.changes)
        level = condition.randomization

        # None leaves an option to the env.
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
        for scenes in self.sets:  # a missing score is an error before anything drives
            check_score(make_planar(scenes.env).task, scenes.score)

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
