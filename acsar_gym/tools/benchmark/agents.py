"""The agents of a benchmark: policies by name, for each id and training seed."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from acsar_gym.errors import ConfigError, show_value, suggest_name
from acsar_gym.resources import AGENTS, hash_modules
from acsar_gym.sensors import MOVERS
from acsar_gym.tools.baselines import AMONG_MOVERS, BASELINES, PRIVILEGED_BASELINES
from acsar_gym.tools.benchmark.scenes import SceneSet, make_planar, short_id
from acsar_gym.tools.evaluation.runs import load_policy
from acsar_gym.tools.policies import CallablePolicy, FilePolicy, is_callable

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
    for name, sources in find_trained(trained).items() if trained is not None else ():
        files[name] = sources[:seeds]

    # An agent that the user named must drive in every set: a missing row is easily overlooked.
    agents: list[Agent] = []
    for name in dict.fromkeys(names or [*files, *BASELINES]):
        chosen = list(_load_agents(name, files, envs))
        if not names:
            chosen = [agent for agent in chosen if _is_default(agent)]
        for scenes in sets if names else ():
            if scenes.env not in [agent.env for agent in chosen]:
                raise ConfigError(
                    f"--agents {name}: has no policy for {scenes.id} of set {scenes.name}: name "
                    "other --sets, or leave it out"
                )
        agents += chosen

    # Rows are named after agents.
    counts = Counter((agent.name, agent.env, agent.training_seed) for agent in agents)
    for (name, env_id, _), count in counts.items():
        if count > 1:
            raise ConfigError(
                f"--agents: {count} of them are called {show_value(name)} on {env_id}: rename a "
                "file, function or class"
            )
    return agents


def _load_agents(name: str, files: dict[str, Sources], envs: Sequence[str]) -> Iterator[Agent]:
    """Load an agent for each id that it drives."""
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
        for env_id in envs:
            if named_id in ("", short_id(env_id)):  # only users name ids of other packages
                policy = load_policy(source, trust=False, env=env_id)
                yield Agent(label[:MAX_NAME_LENGTH], kind, env_id, policy, seed)


def _read_id(source: str, env_id: str) -> str:
    """Return the id that a policy is for. Empty for code that names none."""
    if is_callable(source):
        return short_id(CallablePolicy(source, env_id).said_id)
    return short_id(load_policy(source, trust=False).env_id)


def _is_default(agent: Agent) -> bool:
    """Whether an agent drives if none are named."""
    if agent.name in AMONG_MOVERS:
        return any(sensor.name == MOVERS for sensor in make_planar(agent.env).sensors)
    return agent.kind != PRIVILEGED


def find_trained(folder: Path) -> dict[str, Sources]:
    """Find trained policies, `folder`/NAME/SEED/policy.onnx: seeds and files by name, in order."""
    files: dict[str, Sources] = {}
    for file in sorted(folder.glob("*/*/policy.onnx")):
        digits = re.findall(r"\d+", file.parent.name)
        if not digits:
            raise ConfigError(
                f"{file}: its folder must be named after the seed, such as 0 or seed-0"
            )
        files.setdefault(file.parts[-3], []).append((int(digits[-1]), str(file)))
    if not files:
        raise ConfigError(f"--trained {folder}: holds no NAME/SEED/policy.onnx")
    return {name: sorted(sources) for name, sources in files.items()}
