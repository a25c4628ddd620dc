"""Fixed, versioned sets of scenes for each id: for training, validation and test.

    SCENES["Barn-v1"].test.sha256

A scene is a generated world, or, on an open floor, the goal that a seed draws. Scenes of the test
sets are worlds 100000 to 100999 of a generator, so that 1,000 of them overlap neither the training
worlds (1000 to 1399) nor the validation worlds (900 to 963) nor those that `acsar-gym evaluate`
tests in by default (0 to 199, BARN 0 to 299), which were looked at while methods were chosen. On
the open floor they are the seeds 2^33 to 2^33 + 999; trainings use seeds below 2^32, validation
begins there. The published worlds of BARN are sets of their own, read from a folder.

`scenes.json` has a hash for every 100 scenes, computed from their rounded obstacles, start and goal
(and the path where there is nothing else). Where the generator, or the footprint of the robot that
worlds are made for, has changed, the hashes differ and the set is refused: results from it couldn't
be compared. After a change that is wanted, count up the generator's version in CHANGED_VERSIONS and
write the hashes again: `record_hashes()`. Sets of other packages have the hash of their first 100
scenes, which is part of each result, and nothing to compare it with.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import gymnasium
from gymnasium.utils import seeding

from acsar_gym.config import RobotConfig
from acsar_gym.config.robot import hash_config
from acsar_gym.envs.ids import find_id, full_id, strip_module
from acsar_gym.envs.robot_env import RobotEnv
from acsar_gym.errors import ConfigError, show_value, suggest_name
from acsar_gym.registration import IDS, SCENE_CHOICES, SceneChoice, snake_case
from acsar_gym.tasks import PointGoal
from acsar_gym.tasks.episode import Spawn
from acsar_gym.tasks.task import says_shortest_path
from acsar_gym.tools.evaluation.provenance import hash_numbers, hash_source, hash_world
from acsar_gym.worlds import registry
from acsar_gym.worlds.generators import BARN_ROBOT_RADIUS
from acsar_gym.worlds.pool import Pool
from acsar_gym.worlds.search import footprint_radius

SCENES_VERSION = 1
"""Version of sets whose scenes have never changed."""
CHANGED_VERSIONS = {"crowd_reacting": 2}
"""Versions of sets by generator: since version 2 no two people overlap when an episode starts."""
SCENES_PER_HASH = 100
"""Scenes that share a hash."""
TRAIN = "train"
VALIDATION = "validation"
TEST = "test"
GIVEN = "given"
"""Splits of generated scenes; given ones are read from a folder."""
OWN_NAMESPACE = "acsar_gym/"
"""Namespace of this package's ids, which tables leave out."""
DEFAULT_ROBOT = "acsar"
WIDE_ROBOT_DIFFICULTY = 0.2
"""Difficulty of BARN worlds for robots wider than its own: none of the fuller fields can be made
for these."""
PUBLISHED_BARN = ("barn", "barn-fast")
PUBLISHED_SUFFIX = "-published"
"""Sets that are driven in the published worlds, too, and the end of their names there."""
OPEN_FLOOR_SEEDS = {
    TRAIN: range(2**32),
    VALIDATION: range(2**32, 2**32 + 64),
    TEST: range(2**33, 2**33 + 1000),
}
"""Seeds of the scenes on an open floor."""
WORLD_SPLITS = {TRAIN: registry.TRAIN, VALIDATION: registry.VALIDATION, TEST: registry.BENCHMARK}
MAX_RECORDED = 100_000
"""Sets of more scenes aren't recorded: seeds of a training on an open floor."""
_FILE = Path(__file__).with_name("scenes.json")

TWO_ROBOTS = ("acsar", "jackal")
THREE_ROBOTS = (*TWO_ROBOTS, "husky")
UNSEEN_ROBOTS = tuple(f"drawn:{number}" for number in range(2000, 2005))
"""Robots drawn at random that no policy was trained on."""
PACKAGED_CHOICES: dict[str, dict[str, SceneChoice]] = {
    "acsar_gym/PointGoal-v0": {"open": SceneChoice("", THREE_ROBOTS, "completion_time")},
    "acsar_gym/ObstacleGoal-v1": {
        "clutter": SceneChoice("clutter", THREE_ROBOTS, "completion_time"),
        "clutter-unseen": SceneChoice("clutter", UNSEEN_ROBOTS, "completion_time"),
    },
    "acsar_gym/Barn-v1": {
        "barn": SceneChoice("barn", score="barn_score_own"),
        "barn-fast": SceneChoice("barn", ("jackal",), "barn_score"),
        "barn-husky": SceneChoice("barn", ("husky",), "barn_score_own"),
        "barn-unseen": SceneChoice("barn", UNSEEN_ROBOTS, "barn_score_own"),
    },
    "acsar_gym/Crowd-v0": {
        "crowd": SceneChoice("crowd", TWO_ROBOTS, "completion_time"),
        "crowd-reacting": SceneChoice("crowd_reacting", TWO_ROBOTS, "completion_time"),
    },
    "acsar_gym/DynaBarn-v0": {"dynabarn": SceneChoice("dynabarn", TWO_ROBOTS, "completion_time")},
    "acsar_gym/PathFollow-v0": {"path": SceneChoice("smooth_path", THREE_ROBOTS, "cross_track")},
}
"""The benchmark's sets of scenes by id and name."""


DEFAULT_SETS = ("crowd", "barn-fast")
"""Sets that are driven if neither sets nor ids are named."""


@dataclass(frozen=True)
class SceneSet:
    """Scenes of one id, by number, with the robot that drives them and their score."""

    env: str
    """Id of the env, with the module that registers it if the user named one."""
    name: str
    """Such as "barn-fast", or "clutter/husky" if the set has several robots."""
    source: str
    """Generator of the worlds, or their folder; "" for an open floor."""
    numbers: range
    """Numbers of the worlds, or seeds on an open floor."""
    split: str = TEST
    """ "train", "validation", "test" or "given"."""
    robot: str = DEFAULT_ROBOT
    """What `RobotConfig.of` takes."""
    score: str = "completion_time"
    """See `figures.score_episode`."""
    version: int = SCENES_VERSION
    """Version of the set, which changes with its worlds."""

    def __str__(self) -> str:
        """Such as "Barn-v1 barn (barn 100000 to 100999)"."""
        kind = self.source or "seeds"
        return f"{self.id} {self.name} ({kind} {self.numbers[0]} to {self.numbers[-1]})"

    def __len__(self) -> int:
        return len(self.numbers)

    @property
    def id(self) -> str:
        """Id of the env as results name it; see `short_id`."""
        return short_id(self.env)

    @property
    def worlds(self) -> str | None:
        """What an env takes as `worlds=`; None on an open floor."""
        if not self.source or self.split == GIVEN:
            return self.source or None
        return f"{self.source}:{self.numbers[0]}-{self.numbers[-1]}"

    @cached_property
    def config(self) -> RobotConfig:
        """The robot; ConfigError if there is none of this name."""
        return RobotConfig.of(self.robot)

    @property
    def difficulty(self) -> float | None:
        """Difficulty of the worlds; None varies it."""
        is_wide = self.source == "barn" and footprint_radius(self.config) > BARN_ROBOT_RADIUS
        return WIDE_ROBOT_DIFFICULTY if is_wide else None

    def resets(self, count: int) -> list[tuple[int, dict[str, Any]]]:
        """Return seed and options of the resets that start the first scenes."""
        return [(n, {"world": n} if self.source else {}) for n in self.numbers[:count]]

    @property
    def key(self) -> str:
        """Name in `scenes.json`: of the generator, and of a robot that isn't the default one."""
        is_other = self.source and self.robot != DEFAULT_ROBOT
        return f"{self.source} {self.robot}" if is_other else self.source or "open"

    @property
    def _recorded(self) -> list[str]:
        """The hashes of `scenes.json`; none for scenes that aren't in it."""
        recorded: dict[str, Any] = json.loads(_FILE.read_text())
        return [] if self.split == GIVEN else list(recorded.get(self.key, {}).get(self.split, []))

    @cached_property
    def blocks(self) -> list[str]:
        """Hash of every 100 scenes that are recorded; of others those of a folder, or the first."""
        if recorded := self._recorded:
            return recorded
        count = len(self) if self.split == GIVEN else min(len(self), SCENES_PER_HASH)
        return hash_scenes(self, count) if self.source else []

    @property
    def sha256(self) -> str:
        """Hash of the whole set, from those of its blocks."""
        text = json.dumps([self.split, self.version, self.blocks])
        return hashlib.sha256(text.encode()).hexdigest()

    @property
    def about(self) -> dict[str, Any]:
        """What results contain about their scenes."""
        is_file = Path(self.robot).suffix != ""
        return {
            "set": self.name,
            "split": self.split,
            "kind": "folder" if self.split == GIVEN else self.source or "seeds",
            "robot": Path(self.robot).name if is_file else self.robot,
            "robot_sha256": hash_config(self.config),
            "task_sha256": hash_source(type(make_planar(self.env).task)),
            "score": self.score,
            "first": self.numbers[0],
            "last": self.numbers[-1],
            "version": self.version,
            "sha256": self.sha256,
        }

    def check(self, count: int) -> None:
        """Compare the first scenes with the recorded hashes; makes their worlds once.

        Raises:
            ConfigError: There are fewer than `count`, or they are of another version.
        """
        if not 1 <= count <= len(self):
            raise ConfigError(f"{self}: has {len(self):,} scenes, {count:,} were asked for")
        if not (recorded := self._recorded):
            return
        for place, now in enumerate(hash_scenes(self, count)):
            if now != recorded[place]:
                first = self.numbers[place * SCENES_PER_HASH]
                raise ConfigError(
                    f"{self}: scene set of another version: scenes from {first} on differ from "
                    f"version {self.version}; use the acsar_gym that the results are to be "
                    "compared with"
                )


@dataclass(frozen=True)
class Scenes:
    """The scenes of one id by split, for the default robot."""

    train: SceneSet
    """For training."""
    validation: SceneSet
    """For the choice among checkpoints and parameters."""
    test: SceneSet
    """For results."""

    @classmethod
    def of(cls, name: str, source: str) -> Scenes:
        """Return the sets of an id of this package in worlds of a generator."""
        splits = (TRAIN, VALIDATION, TEST)
        env = f"{OWN_NAMESPACE}{name}"
        return cls(*(SceneSet(env, s, source, split_numbers(source, s), s) for s in splits))


def split_numbers(source: str, split: str) -> range:
    """Return the numbers of a split's scenes: of worlds, or seeds if `source` is ""."""
    if not source:
        return OPEN_FLOOR_SEEDS[split]
    return registry.split_numbers(source, WORLD_SPLITS[split])


SCENES: Mapping[str, Scenes] = {
    name: Scenes.of(
        name, next(iter(PACKAGED_CHOICES[f"{OWN_NAMESPACE}{name}"].values())).worlds or ""
    )
    for name in IDS
}
"""The scenes by id, without its namespace."""


def short_id(env_id: str) -> str:
    """Return the id that results name: without a module, and without this package's namespace."""
    return strip_module(env_id).removeprefix(OWN_NAMESPACE)


def find_env(name: str) -> str:
    """Return the full id of an env: "barn" is "acsar_gym/Barn-v1"; ConfigError if unknown."""
    env_id = full_id(name)
    if env_id.startswith(OWN_NAMESPACE) and env_id.removeprefix(OWN_NAMESPACE) not in IDS:
        names = [*IDS, *(snake_case(short.partition("-")[0]) for short in IDS)]
        raise ConfigError(f"--env {show_value(name)}{suggest_name(name[:40], names)}")
    return find_id(env_id)


def find_sets(env_id: str, robots: Sequence[str] = ()) -> list[SceneSet]:
    """Return the benchmark's sets of scenes of an id, one for each robot.

    Args:
        env_id: Full id, with the module that registers it if that isn't imported yet.
        robots: Robots instead of those that the sets name.

    Raises:
        ConfigError: It isn't an environment of acsar_gym, or its worlds can't be found.
    """
    name = strip_module(find_id(env_id))
    choices = PACKAGED_CHOICES.get(name) or SCENE_CHOICES.get(name) or {"test": SceneChoice()}
    sets: list[SceneSet] = []

    for name, choice in choices.items():
        source = task_worlds(env_id) if choice.worlds is None else choice.worlds
        is_generated = not source or registry.parse_known_name(source)
        if is_generated:
            numbers = split_numbers(source, TEST)
        else:
            numbers = range(len(read_pool(source, None, DEFAULT_ROBOT)))
        for robot in dict.fromkeys(robots or choice.robots):
            label = Path(robot).stem if Path(robot).suffix else robot
            scenes = SceneSet(
                env=env_id,
                name=name if choice.robots == (robot,) else f"{name}/{label}",
                source=source,
                numbers=numbers,
                split=TEST if is_generated else GIVEN,
                robot=robot,
                score=choice.score or default_score(env_id),
                version=CHANGED_VERSIONS.get(source, SCENES_VERSION),
            )
            if scenes.name in [chosen.name for chosen in sets]:
                raise ConfigError(f"--robots: two of them are {label}: rename a file")
            sets.append(scenes)
    return sets


def choose_sets(
    envs: Sequence[str], names: Collection[str], robots: Sequence[str] = ()
) -> list[SceneSet]:
    """Choose sets by name: "clutter" means those of all its robots, "clutter/husky" one of them.

    Args:
        envs: Ids as `find_env` returns them; by default all of this package.
        names: Names of sets; by default all of the ids, or DEFAULT_SETS if no ids are named.
        robots: As for `find_sets`.

    Raises:
        ConfigError: There is no set of this name.
    """
    ids = envs or [f"{OWN_NAMESPACE}{name}" for name in IDS]
    sets: dict[str, list[SceneSet]] = {}
    for scenes in [scenes for env_id in dict.fromkeys(ids) for scenes in find_sets(env_id, robots)]:
        for name in dict.fromkeys((scenes.name.partition("/")[0], scenes.name)):
            sets.setdefault(name, []).append(scenes)
    wanted = names or ([] if envs else DEFAULT_SETS) or sets
    for name in wanted:
        if name not in sets:
            raise ConfigError(f"--sets {show_value(name)}{suggest_name(name[:40], sorted(sets))}")
    return list(dict.fromkeys(scenes for name in wanted for scenes in sets[name]))


def default_score(env_id: str) -> str:
    """Return the score of an id's scenes if its registration names none."""
    return "completion_time" if says_shortest_path(make_planar(env_id).task) else "success"


def task_worlds(env_id: str) -> str:
    """Return the generator or folder that an id's task takes its worlds from; "" for none."""
    pool = make_planar(env_id).pool
    if pool is None:
        return ""
    if len(pool.sets) > 1 or pool.sets[0].generator == "given":
        raise ConfigError(
            f"--env {show_value(env_id)}: its worlds have no name, or several: name one generator "
            "or a folder, as in acsar_gym.register(..., scenes={'test': {'worlds': ...}})"
        )
    return pool.sets[0].generator


@cache
def make_planar(env_id: str) -> RobotEnv:
    """Make an env of an id, closed; ConfigError if it isn't an env of acsar_gym."""
    try:
        env = gymnasium.make(env_id, link="planar").unwrapped
    except (gymnasium.error.Error, ImportError, TypeError) as error:
        reason = " ".join(str(error).split())
        raise ConfigError(
            f"--env {show_value(env_id)}: not an environment of acsar_gym: {reason}"
        ) from error
    env.close()
    if not isinstance(env, RobotEnv):
        raise ConfigError(f"--env {show_value(env_id)}: not an environment of acsar_gym")
    return env


def published_sets(sets: Iterable[SceneSet], folder: Path) -> list[SceneSet]:
    """Return copies of BARN's sets, of those that are driven in the published worlds, in these.

    `folder` has `world_N.world` and `path_N.npy` or `path_files`; WorldError if not.
    """
    return [
        replace(
            scenes,
            name=f"{scenes.name}{PUBLISHED_SUFFIX}",
            source=str(folder),
            numbers=range(len(read_pool(str(folder), None, scenes.robot))),
            split=GIVEN,
        )
        for scenes in sets
        if scenes.id.startswith("Barn-") and scenes.name in PUBLISHED_BARN
    ]


def record_hashes() -> None:
    """Write the hashes of all generated sets to `scenes.json`; takes some minutes."""
    hashes: dict[str, Any] = {}
    splits = [
        s for scenes in SCENES.values() for s in (scenes.train, scenes.validation, scenes.test)
    ]
    driven = [scenes for name in IDS for scenes in find_sets(f"{OWN_NAMESPACE}{name}")]
    for scenes in (*splits, *driven):
        recorded = hashes.setdefault(scenes.key, {})
        if len(scenes) <= MAX_RECORDED and scenes.split not in recorded:
            recorded[scenes.split] = hash_scenes(scenes, len(scenes))
    _FILE.write_text(json.dumps({"version": SCENES_VERSION, **hashes}, indent=1) + "\n")


@cache
def hash_scenes(scenes: SceneSet, count: int) -> list[str]:
    """Hash every 100 scenes as far as `count` needs; the last block may be a short one."""
    numbers = scenes.numbers[: -(-count // SCENES_PER_HASH) * SCENES_PER_HASH]
    if scenes.source:
        pool = read_pool(scenes.worlds or "", scenes.difficulty, scenes.robot)
        hashes = [hash_world(pool[number]) for number in numbers]
    else:
        spawn = Spawn(PointGoal(), None, None, scenes.config)
        goals = [spawn.draw(seeding.np_random(seed)[0], {}).goal for seed in numbers]
        hashes = [hash_numbers([goal]) for goal in goals]
    return [
        hashlib.sha256(b"".join(hashes[first : first + SCENES_PER_HASH])).hexdigest()
        for first in range(0, len(hashes), SCENES_PER_HASH)
    ]


@cache
def read_pool(source: str, difficulty: float | None, robot: str) -> Pool:
    """Read or generate worlds for the footprint of a robot."""
    return Pool.of(source, difficulty, footprint_radius(RobotConfig.of(robot)))
