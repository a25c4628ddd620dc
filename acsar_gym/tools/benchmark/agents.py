"""The agents of a benchmark: policies by name, for each id and training seed."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from acsar_gym.errors import ConfigError, show_value, suggest_name
from acsar_gym.resources import AGENTS, hash_modules
from acsar_gym.sensors import MOVERS
from acsar_gym.tools.baselines import AMONG_MOVERS, BASELINES, PRIVILEGED_BASELINES
from acsar_gym.tools.benchmark.scenes import SceneSet, make_planar, short_id
from acsar_gym.tools.evaluation import runs
from acsar_gym.tools.policies import CallablePolicy, FilePolicy, is_callable

PACKAGED = "packaged"
"""Name of the agent that consists of the policies of this package."""
LEARNED = "learned"
BASELINE = "baseline"
PRIVILEGED = "privileged"
"""Kinds of agents. A privileged agent is a baseline that knows the simulator's truth."""
MAX_NAME_LENGTH = 60
"""Most characters of an agent's name; tables stay readable."""


@dataclass(frozen=True)
class Agent:
    """A policy that drives on one id: one training seed of a named agent."""

    name: str
    kind: str
    """ "learned", "baseline" or "privileged"."""
    env: str
    """Id of the env, with the module that registers it if the user named one."""
    policy: FilePolicy = field(repr=False)
    training_seed: int | None = None

    @property
    def id(self) -> str:
        """Id of the env as results name it; see `scenes.short_id`."""
        return short_id(self.env)

    @property
    def about(self) -> dict[str, Any]:
        """What results contain about it."""
        return {
            "kind": self.kind,
            "id": self.id,
            "training_seed": self.training_seed,
            "file": self.policy.path.name,
            "sha256": _hash_policy(self.policy),
        }


def _hash_policy(policy: FilePolicy) -> str | None:
    """Hash a policy's file, or the source of its code and of the user's modules that it imports."""
    if not isinstance(policy, CallablePolicy) or policy.instance is not None:
        return policy.sha256
    path = policy.path
    module = f"acsar_gym_policy_{path.stem}" if path.suffix == ".py" else f"{path}".split(":")[0]
    return hash_modules(module)


def choose_agents(
    names: Sequence[str], sets: Sequence[SceneSet], trained: Path | None, seeds: int
) -> list[Agent]:
    """Find agents by their names.

    Args:
        names: "packaged", baselines, folders in `trained`, ONNX files, and functions or classes
            such as mine.planner:Planner; empty for those of the first three that can drive,
            without baselines that know the simulator's truth.
        sets: Scenes that they drive.
        trained: Folder with NAME/SEED/policy.onnx; None for none.
        seeds: Most training seeds of each.

    Raises:
        ConfigError: A named agent doesn't exist, or has no policy for the id of a set.
        PolicyError: A policy can't be loaded.
    """
    envs = list(dict.fromkeys(scenes.env for scenes in sets))
    files = {} if trained is None else find_trained(trained)
    files = {name: policies[:seeds] for name, policies in files.items()}
    files[PACKAGED] = [(None, file) for file in sorted((AGENTS / "policies").glob("*.onnx"))]

    agents: list[Agent] = []
    for name in dict.fromkeys(names or [PACKAGED, *files, *BASELINES]):
        if name in files:
            policies = [_read_agent(name, str(file), envs, seed) for seed, file in files[name]]
        elif name in BASELINES:
            policies = _make_baselines(name, envs, is_named=name in names)
        elif ":" in name or Path(name).suffix in (".py", ".onnx"):
            policies = _read_given(name, envs)
        else:
            raise ConfigError(
                f"--agents {show_value(name)}{suggest_name(name[:40], [*files, *BASELINES])}"
            )
        if name in names:
            _check_ids(name, policies, sets)
        agents += [agent for agent in policies if agent.env in envs]

    counts = Counter((agent.name, agent.env, agent.training_seed) for agent in agents)
    for (name, env_id, _), count in counts.items():
        if count > 1:
            raise ConfigError(
                f"--agents: {count} of them are called {show_value(name)} on {env_id}: rename a "
                "file, function or class"
            )
    if not agents:
        raise ConfigError("--agents: none of them drives these --sets")
    return agents


def _check_ids(name: str, agents: Sequence[Agent], sets: Sequence[SceneSet]) -> None:
    """Raise ConfigError if an agent that the user named has no policy for the id of a set."""
    ids = sorted({agent.id for agent in agents})
    for scenes in sets:
        if scenes.id not in ids:
            raise ConfigError(
                f"--agents {name}: has no policy for {scenes.id} of set {scenes.name}, but for "
                f"{', '.join(ids)}: name other --sets, or leave it out"
            )


def _make_baselines(name: str, envs: Sequence[str], *, is_named: bool) -> list[Agent]:
    """Make a baseline for each id; without its name only if it is made for the id."""
    kind = PRIVILEGED if name in PRIVILEGED_BASELINES else BASELINE
    if not is_named and kind == PRIVILEGED:
        return []
    return [
        Agent(name, kind, env_id, runs.load_policy(name, trust=False, env=env_id))
        for env_id in envs
        if is_named or name not in AMONG_MOVERS or _senses_movers(env_id)
    ]


def _senses_movers(env_id: str) -> bool:
    return any(sensor.name == MOVERS for sensor in make_planar(env_id).sensors)


def _read_given(policy: str, envs: Sequence[str]) -> list[Agent]:
    """Return a file, or Python code, as an agent on the id that it names, else on all."""
    path, _, function = policy.rpartition(":")
    is_file = not path or Path(path).suffix == ".py"
    name = Path(path or policy).stem if is_file else function
    if is_callable(policy) and not CallablePolicy(policy, envs[0]).said_id:
        return [
            Agent(name, LEARNED, env_id, runs.load_policy(policy, trust=False, env=env_id))
            for env_id in envs
        ]
    return [_read_agent(name, policy, envs)]


def find_trained(folder: Path) -> dict[str, list[tuple[int | None, Path]]]:
    """Find trained policies, `folder`/NAME/SEED/policy.onnx: seeds and files by name, in order."""
    files: dict[str, list[tuple[int | None, Path]]] = {}
    for file in folder.glob("*/*/policy.onnx"):
        match = re.search(r"(\d+)\D*$", file.parent.name)
        if match is None:
            raise ConfigError(
                f"{file}: its folder must be named after the seed, such as 0 or seed-0"
            )
        files.setdefault(file.parts[-3], []).append((int(match[1]), file))
    if not files:
        raise ConfigError(f"--trained {folder}: holds no NAME/SEED/policy.onnx")
    return {name: sorted(files[name]) for name in sorted(files)}


def _read_agent(name: str, policy: str, envs: Sequence[str], seed: int | None = None) -> Agent:
    """Load a policy for the id that it names; only users name ids of other packages."""
    loaded = runs.load_policy(policy, trust=False)
    env = next((env for env in envs if short_id(env) == short_id(loaded.env_id)), loaded.env_id)
    if env in envs:
        loaded = runs.load_policy(policy, trust=False, env=env)
    return Agent(name[:MAX_NAME_LENGTH], LEARNED, env, loaded, seed)
