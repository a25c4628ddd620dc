"""Fixed, versioned sets of scenes for each id: for training, validation and test.

    SCENES["Barn-v1"].test.sha256

A scene is a generated world, or, on an open floor, the goal that a seed draws. Scenes of the test
sets are worlds 100000 to 100999 of a generator, so that 1,000 of them overlap neither the training
worlds (1000 to 1399) nor the validation worlds (900 to 963) nor those that `acsar-gym evaluate`
tests in by default (0 to 199, BARN 0 to 299), which were looked at while methods were chosen. On
the open floor they are the seeds 2^33 to 2^33 + 999; trainings use seeds below 2^32, validation
begins there.

The published worlds of BARN are a set of their own, read from a folder (`published`). They don't
come along, and nothing is trained on them.

`scenes.json` has a hash for every 100 scenes, computed from their rounded obstacles, start and goal
(and the path where there is nothing else). Where the generator, or the footprint of the robot that
worlds are made for, has changed, the hashes differ and the set is refused: results from it couldn't
be compared. A change that is wanted has to count SCENES_VERSION up and write the hashes anew:
`record_hashes()`.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.utils import seeding

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError
from acsar_gym.registration import IDS
from acsar_gym.tasks import PointGoal
from acsar_gym.tasks.episode import Spawn
from acsar_gym.worlds import World, registry
from acsar_gym.worlds.cache import keep_worlds
from acsar_gym.worlds.pool import Pool
from acsar_gym.worlds.search import footprint_radius

SCENES_VERSION = 1
"""Version of all sets; counts up where any scene changes."""
SCENES_PER_HASH = 100
"""Scenes that share a hash."""
TRAIN, VALIDATION, TEST, PUBLISHED = "train", "validation", "test", "published"
WORLD_KINDS = {
    "PointGoal": "",
    "ObstacleGoal": "clutter",
    "Barn": "barn",
    "PathFollow": "smooth_path",
}
"""Generator of each task's worlds; "" is an open floor."""
OPEN_FLOOR_SEEDS = {
    TRAIN: range(2**32),
    VALIDATION: range(2**32, 2**32 + 64),
    TEST: range(2**33, 2**33 + 1000),
}
"""Seeds of the scenes on an open floor."""
WORLD_SPLITS = {TRAIN: registry.TRAIN, VALIDATION: registry.VALIDATION, TEST: registry.BENCHMARK}
_FILE = Path(__file__).with_name("scenes.json")


@dataclass(frozen=True)
class SceneSet:
    """Scenes of one id, by number.

    Raises ConfigError, in `check`, where they aren't those that were recorded.
    """

    id: str
    """Id of the env without its namespace."""
    name: str
    """ "train", "validation", "test" or "published"."""
    source: str
    """Generator of the worlds, or their folder; "" for an open floor."""
    numbers: range
    """Numbers of the worlds, or seeds on an open floor."""
    version: int = SCENES_VERSION
    """Version of the set, which changes where its worlds do."""

    def __str__(self) -> str:
        """Such as "Barn-v1 test (barn 100000 to 100999)"."""
        kind = self.source or "seeds"
        return f"{self.id} {self.name} ({kind} {self.numbers[0]} to {self.numbers[-1]})"

    def __len__(self) -> int:
        return len(self.numbers)

    @property
    def worlds(self) -> str | None:
        """What an env takes as `worlds=`; None on an open floor."""
        if not self.source or self.name == PUBLISHED:
            return self.source or None
        return f"{self.source}:{self.numbers[0]}-{self.numbers[-1]}"

    def reset(self, place: int) -> tuple[int, dict[str, Any]]:
        """Return seed and options of the reset that begins a scene.

        Args:
            place: of the scene in this set, from 0.
        """
        number = self.numbers[place]
        return number, {"world": number} if self.source else {}

    @cached_property
    def blocks(self) -> list[str]:
        """Recorded hash of every 100 scenes; of a folder, the hashes of what it holds."""
        if self.name == PUBLISHED:
            return hash_scenes(self, len(self))
        recorded: dict[str, Any] = json.loads(_FILE.read_text())
        return list(recorded.get(self.source or "open", {}).get(self.name, []))

    @property
    def sha256(self) -> str:
        """Hash of the whole set, from the recorded ones."""
        told = json.dumps([self.name, self.version, self.blocks])
        return hashlib.sha256(told.encode()).hexdigest()

    @property
    def about(self) -> dict[str, Any]:
        """What results say about their scenes."""
        kind = "folder" if self.name == PUBLISHED else self.source or "seeds"
        return {
            "set": self.name,
            "kind": kind,
            "first": self.numbers[0],
            "last": self.numbers[-1],
            "version": self.version,
            "sha256": self.sha256,
        }

    def check(self, count: int) -> None:
        """Compare the first scenes with the recorded hashes; makes their worlds once.

        Args:
            count: number of scenes that will be used.

        Raises:
            ConfigError: there are fewer, or they are of another version.
        """
        if not 1 <= count <= len(self):
            raise ConfigError(f"{self}: has {len(self):,} scenes, {count:,} were asked for")
        if self.name == PUBLISHED:
            return
        hashes = zip(hash_scenes(self, count), self.blocks, strict=False)
        for place, (now, before) in enumerate(hashes):
            if now != before:
                first = self.numbers[place * SCENES_PER_HASH]
                raise ConfigError(
                    f"{self}: scene set of another version: scenes from {first} on differ from "
                    f"version {self.version}; use the acsar_gym that the results are to be "
                    "compared with"
                )


@dataclass(frozen=True)
class Scenes:
    """The sets of scenes of one id."""

    train: SceneSet
    """For training."""
    validation: SceneSet
    """For the choice among checkpoints and parameters."""
    test: SceneSet
    """For results."""

    @classmethod
    def of(cls, env_id: str, source: str) -> Scenes:
        """Return the sets of an id.

        Args:
            env_id: without its namespace.
            source: generator of the worlds; "" for an open floor.
        """
        sets = {
            name: SceneSet(env_id, name, source, registry.split_numbers(source, WORLD_SPLITS[name]))
            if source
            else SceneSet(env_id, name, source, OPEN_FLOOR_SEEDS[name])
            for name in (TRAIN, VALIDATION, TEST)
        }
        return cls(**sets)


SCENES: Mapping[str, Scenes] = {
    name: Scenes.of(name, WORLD_KINDS[name.partition("-")[0]]) for name in IDS
}
"""The sets by id, without its namespace."""


def published_scenes(env_id: str, folder: Path) -> SceneSet:
    """Read the published worlds of BARN from a folder, as a set of their own.

    Args:
        env_id: id of the env without its namespace.
        folder: with `world_N.world` and `path_N.npy` or `path_files`.

    Raises:
        WorldError: they can't be read.
    """
    return SceneSet(env_id, PUBLISHED, str(folder), range(len(read_pool(str(folder)))))


def record_hashes() -> None:
    """Write the hashes of all generated sets to `scenes.json`; takes a minute."""
    told: dict[str, Any] = {}
    for scenes in SCENES.values():
        sets = [
            one for one in (scenes.train, scenes.validation, scenes.test) if len(one) <= 100_000
        ]
        told[scenes.test.source or "open"] = {one.name: hash_scenes(one, len(one)) for one in sets}
    _FILE.write_text(json.dumps({"version": SCENES_VERSION, **told}, indent=1) + "\n")


@cache
def hash_scenes(scenes: SceneSet, count: int) -> list[str]:
    """Hash every 100 scenes as far as `count` needs; the last block may be a short one."""
    numbers = scenes.numbers[: -(-count // SCENES_PER_HASH) * SCENES_PER_HASH]
    with keep_worlds():
        if scenes.source:
            pool = read_pool(scenes.worlds or "")
            hashes = [hash_world(pool[number]) for number in numbers]
        else:
            spawn = Spawn(PointGoal(), None, None, RobotConfig.of(None))
            goals = (spawn.draw(seeding.np_random(seed)[0], {}).goal for seed in numbers)
            hashes = [_hash_numbers([goal]) for goal in goals]
    return [
        hashlib.sha256(b"".join(hashes[first : first + SCENES_PER_HASH])).hexdigest()
        for first in range(0, len(hashes), SCENES_PER_HASH)
    ]


@cache
def read_pool(source: str) -> Pool:
    """Worlds for the footprint of the default robot."""
    return Pool.of(source, None, footprint_radius(RobotConfig.of(None)))


def hash_world(world: World) -> bytes:
    """Hash the numbers that define a world; its path only where it is all that there is."""
    start, goal = world.start, world.goal
    theta = -10.0 if start.theta is None else start.theta
    path = world.path if world.path is not None and not world.obstacles else ()
    ends = (start.x, start.y, start.radius, theta), (goal.x, goal.y, goal.radius)
    return _hash_numbers([world.circles, world.segments, *ends, path])


def _hash_numbers(parts: Sequence[Any]) -> bytes:
    """Hash numbers and their shapes, rounded to micrometres.

    Sums of floats differ in the last digits between machines.
    """
    said = hashlib.sha256()
    for part in parts:
        whole = np.rint(np.asarray(part, np.float64) * 1e6).astype("<i8")
        said.update(repr(whole.shape).encode() + whole.tobytes())
    return said.digest()
