"""The agents of a benchmark: packaged policies, trained seeds, baselines, and anybody's file."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from acsar_gym.baselines import BASELINES
from acsar_gym.envs.ids import full_id
from acsar_gym.errors import ConfigError, PolicyError, shown, suggestion
from acsar_gym.evaluation import runs
from acsar_gym.registration import IDS
from acsar_gym.resources import AGENTS

PACKAGED = "packaged"
"""Name of the agent that consists of the policies which come with the package."""
LEARNED, BASELINE = "learned", "baseline"
MOST_NAME = 60
"""Most characters of an agent's name."""
_NUMBER = re.compile(r"(\d+)\D*$")


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


def short(env_id: str) -> str:
    """Remove the namespace from an id of this package: "barn" is "Barn-v1".

    Raises:
        ConfigError: the benchmark has no scenes for it.
    """
    name = full_id(env_id).removeprefix("acsar_gym/")
    if name not in IDS:
        raise ConfigError(f"--ids {shown(env_id)}{suggestion(name[:40], IDS)}")
    return name


def baseline_names() -> tuple[str, ...]:
    """Names of the baselines that come with the package."""
    return tuple(BASELINES)


def chosen(
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
    learned = [*packaged(), *(() if trained is None else in_folder(trained, seeds))]
    found = [each for each in (*learned, *baselines(ids)) if each.id in ids]
    known = list(dict.fromkeys([*(each.name for each in learned), *baseline_names()]))
    for name in names:
        if name not in known:
            raise ConfigError(f"--agents {shown(name)}{suggestion(name[:40], known)}")
    return [each for each in found if not names or each.name in names]


def packaged() -> Iterator[Agent]:
    """Yield the policies that come with the package."""
    for file in sorted((AGENTS / "policies").glob("*.onnx")):
        yield from _of_file(PACKAGED, file, None)


def baselines(ids: Iterable[str]) -> list[Agent]:
    """Return every baseline on every id; those that can't drive there are refused later."""
    return [Agent(name, BASELINE, each, name) for name in baseline_names() for each in ids]


def in_folder(folder: Path, seeds: int) -> list[Agent]:
    """Find trained policies: `folder`/NAME/SEED/policy.onnx.

    Args:
        folder: as `--trained`.
        seeds: most seeds of each name, the smallest first.

    Raises:
        ConfigError: there is none.
    """
    files = list(folder.glob("*/*/policy.onnx"))
    if not files:
        raise ConfigError(f"--trained {folder}: holds no NAME/SEED/policy.onnx")
    found: list[Agent] = []
    for name in sorted({file.parts[-3] for file in files}):
        own = sorted((_seed(file), file) for file in files if file.parts[-3] == name)
        for seed, file in own[:seeds]:
            found.extend(_of_file(name, file, seed))
    return found


def _seed(file: Path) -> int:
    """The number at the end of the name of a policy's folder."""
    match = _NUMBER.search(file.parent.name)
    if match is None:
        raise ConfigError(f"{file}: its folder must be named after the seed, such as 0 or seed-0")
    return int(match[1])


def submitted(policy: str) -> Agent:
    """Return anybody's policy as an agent.

    Args:
        policy: an ONNX file, or a function such as mine.py:act.

    Raises:
        PolicyError: it can't be used, or is for an id without scenes.
    """
    (found,) = _of_file(Path(policy.rpartition(":")[0] or policy).stem[:MOST_NAME], policy, None)
    return found


def _of_file(name: str, file: str | Path, seed: int | None) -> list[Agent]:
    """Read what a policy says about itself."""
    loaded = runs.load(str(file), trust=False)
    env_id = loaded.env_id.removeprefix("acsar_gym/")
    if env_id not in IDS:
        raise PolicyError(
            f"{file}: made for {shown(loaded.env_id)}, for which there are no scenes; there are "
            f"some for {', '.join(IDS)}"
        )
    return [Agent(name[:MOST_NAME], LEARNED, env_id, str(file), seed, loaded.sha256)]
