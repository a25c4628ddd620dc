"""Fixed, versioned sets of scenes for each id: for training, validation and test.

    SCENES["Barn-v1"].test.sha256

A scene is a generated world, or, on an open floor, the goal that a seed draws. Scenes of the test
sets are worlds 100000 to 100999 of a generator, so that 1,000 of them overlap neither the training
worlds (1000 to 1399) nor the validation worlds (900 to 963) nor those that `acsar-gym evaluate`
tests in by default (0 to 199, BARN 0 to 299), which were looked at while methods were chosen. On
the open floor they are the seeds 2^33 to 2^33 + 999. Training uses seeds below 2^32, validation
the next 64. The published worlds of BARN are sets of their own, read from a folder.

`scenes.json` has a hash for every 100 scenes, computed from their rounded obstacles, start and goal
(and the path if nothing stands or moves). If the generator, or the footprint of the robot that
worlds are made for, has changed, the hashes differ and the set is refused, because results from it
couldn't be compared. After a change that is wanted, count up the generator's version in
CHANGED_VERSIONS and write the hashes again with `tests/measure/record_scenes.py`. Sets of other
packages have the hash of their first 100 scenes, which is part of each result, and nothing to
compare it with.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
from gymnasium.utils import seeding

from acsar_gym.config import RobotConfig
from acsar_gym.config.robot import hash_config
from acsar_gym.envs.ids import find_id, strip_module
from acsar_gym.envs.robot_env import RobotEnv
from acsar_gym.errors import ConfigError, explain_error, show_value
from acsar_gym.registration import IDS, SCENE_CHOICES, SceneChoice
from acsar_gym.tasks import PointGoal
from acsar_gym.tasks.episode import Spawn
from acsar_gym.tasks.options import check_names
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
"""Splits of generated scenes. Given scenes are read from a folder."""
OWN_NAMESPACE = "acsar_gym/"
"""Namespace of this package's ids, which tables leave out."""
DEFAULT_ROBOT = "acsar"
WIDE_ROBOT_DIFFICULTY = 0.2
"""Difficulty of BARN worlds for robots wider than its own: none of the fuller fields can be made
for these."""
PUBLISHED_BARN = ("barn", "barn-fast")
PUBLISHED_SUFFIX = "-published"
"""Sets that are driven in the published worlds as well, and the end of their names there."""
OPEN_FLOOR_SEEDS = {
    TRAIN: range(2**32),
    VALIDATION: range(2**32, 2**32 + 64),
    TEST: range(2**33, 2**33 + 1000),
}
"""Seeds of the scenes on an open floor."""
WORLD_SPLITS = {TRAIN: registry.TRAIN, VALIDATION: registry.VALIDATION, TEST: registry.BENCHMARK}
COMPLETION_TIME = "completion_time"
SUCCESS = "success"
"""Scores of tasks with and without a shortest path, see `plan.score_episode`."""
HASHES = Path(__file__).with_name("scenes.json")

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
    """Generator of the worlds, or their folder. "" for an open floor."""
    numbers: range
    """Numbers of the worlds, or seeds on an open floor."""
    split: str = TEST
    """ "train", "validation", "test" or "given"."""
    robot: str = DEFAULT_ROBOT
    """What `RobotConfig.of` takes."""
    score: str = "completion_time"
    """See `plan.score_episode`."""
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
        """Id of the env as results name it, see `short_id`."""
        return short_id(self.env)

    @property
    def worlds(self) -> str | None:
        """What an env takes as `worlds=`. None on an open floor."""
        if not self.source or self.split == GIVEN:
            return self.source or None
        return f"{self.source}:{self.numbers[0]}-{self.numbers[-1]}"

    @cached_property
    def config(self) -> RobotConfig:
        """The robot. ConfigError if there is none of this name."""
        return RobotConfig.of(self.robot)

    @property
    def difficulty(self) -> float | None:
        """Difficulty of the worlds. None varies it."""
        is_wide = self.source == "barn" and footprint_radius(self.config) > BARN_ROBOT_RADIUS
        return WIDE_ROBOT_DIFFICULTY if is_wide else None

    @property
    def resets(self) -> list[tuple[int, dict[str, Any]]]:
        """Seed and options of the resets that start the scenes."""
        return [(number, {"world": number} if self.source else {}) for number in self.numbers]

    @property
    def key(self) -> str:
        """Name in `scenes.json`: of the generator, and of a robot that isn't the default one."""
        is_other = self.source and self.robot != DEFAULT_ROBOT
        return f"{self.source} {self.robot}" if is_other else self.source or "open"

    @property
    def recorded(self) -> list[str]:
        """The hash of every 100 scenes in `scenes.json`. Empty for scenes that aren't in it."""
        splits: dict[str, list[str]] = json.loads(HASHES.read_text()).get(self.key, {})
        return [] if self.split == GIVEN else splits.get(self.split, [])

    @cached_property
    def blocks(self) -> list[str]:
        """The recorded hashes. Of other worlds those of a folder, or of the first 100."""
        count = len(self) if self.split == GIVEN else min(len(self), SCENES_PER_HASH)
        return self.recorded or (hash_scenes(self, count) if self.source else [])

    @property
    def sha256(self) -> str:
        """Hash of the whole set, from those of its blocks."""
        text = json.dumps([self.split, self.version, self.blocks])
        return hashlib.sha256(text.encode()).hexdigest()

    @property
    def about(self) -> dict[str, Any]:
        """What results contain about their scenes."""
        return {
            "set": self.name,
            "split": self.split,
            "kind": "folder" if self.split == GIVEN else self.source or "seeds",
            "robot": Path(self.robot).name,
            "robot_sha256": hash_config(self.config),
            "task_sha256": hash_source(type(make_planar(self.env).task)),
            "score": self.score,
            "first": self.numbers[0],
            "last": self.numbers[-1],
            "version": self.version,
            "sha256": self.sha256,
        }

    def check(self, count: int) -> None:
        """Compare the first scenes with the recorded hashes, which makes their worlds once.

        Raises:
            ConfigError: There are fewer than `count`, or they are of another version.
        """
        if not 1 <= count <= len(self):
            raise ConfigError(f"{self}: has {len(self):,} scenes, {count:,} were asked for")

        # Hashes that differ mean that results from these scenes can't be compared.
        hashes = hash_scenes(self, count) if self.recorded else []
        for place, (now, recorded) in enumerate(zip(hashes, self.recorded, strict=False)):
            if now != recorded:
                first = self.numbers[place * SCENES_PER_HASH]
                raise ConfigError(
                    f"{self}: scene set of another version: scenes from {first} on differ from "
                    f"version {self.version}. Use the acsar_gym that the results are to be "
                    "compared with"
                )


class Scenes(NamedTuple):
    """The scenes of an id by split, for the default robot."""

    train: SceneSet
    """For training."""
    validation: SceneSet
    """For the choice among checkpoints and parameters."""
    test: SceneSet
    """For results."""


def split_numbers(source: str, split: str) -> range:
    """Return the numbers of a split's scenes: of worlds, or seeds if `source` is ""."""
    if not source:
        return OPEN_FLOOR_SEEDS[split]
    return registry.split_numbers(source, WORLD_SPLITS[split])


def _make_splits(env_id: str) -> Scenes:
    """Return the splits of an id in the worlds of its first set."""
    source = next(iter(PACKAGED_CHOICES[env_id].values())).worlds or ""
    return Scenes(*(SceneSet(env_id, s, source, split_numbers(source, s), s) for s in WORLD_SPLITS))


SCENES: Mapping[str, Scenes] = {name: _make_splits(f"{OWN_NAMESPACE}{name}") for name in IDS}
"""The scenes by id, without its namespace."""


def short_id(env_id: str) -> str:
    """Return the id that results name: without a module, and without this package's namespace."""
    return strip_module(env_id).removeprefix(OWN_NAMESPACE)


def find_sets(env_id: str, robots: Sequence[str] = ()) -> list[SceneSet]:
    """Return the benchmark's sets of scenes of an id, one set for each robot.

    Args:
        env_id: Id, with the module that registers it if that isn't imported yet.
        robots: Robots instead of those that the sets name.

    Raises:
        ConfigError: It isn't an environment of acsar_gym, or its worlds can't be found.
    """
    env_id = find_id(env_id)
    name = strip_module(env_id)
    choices = PACKAGED_CHOICES.get(name) or SCENE_CHOICES.get(name) or {"test": SceneChoice()}
    # Generated worlds have a split for the benchmark, a folder is driven completely.
    sets: dict[str, SceneSet] = {}
    for name, choice in choices.items():
        source = task_worlds(env_id) if choice.worlds is None else choice.worlds

        # Worlds of generators and seeds never end, so a part of them is the benchmark's.
        is_generated = not source or bool(registry.parse_known_name(source))
        numbers = split_numbers(source, TEST) if is_generated else number_worlds(source)
        score = choice.score
        if not score:
            has_way = says_shortest_path(make_planar(env_id).task)
            score = COMPLETION_TIME if has_way else SUCCESS

        # A set of several robots has a name for each.

        for robot in dict.fromkeys(robots or choice.robots):
            label = Path(robot).stem
            full_name = name if choice.robots == (robot,) else f"{name}/{label}"
            if full_name in sets:
                raise ConfigError(f"--robots: two of them are {label}: rename a file")
            sets[full_name] = SceneSet(
                env=env_id,
                name=full_name,
                source=source,
                numbers=numbers,
                split=TEST if is_generated else GIVEN,
                robot=robot,
                score=score,
                version=CHANGED_VERSIONS.get(source, SCENES_VERSION),
            )
    return list(sets.values())


def choose_sets(
    envs: Sequence[str], names: Collection[str], robots: Sequence[str] = ()
) -> list[SceneSet]:
    """Choose sets by name: "clutter" means those of all its robots, "clutter/husky" one of them.

    Args:
        envs: Ids, by default all of this package.
        names: Names of sets, by default all of the ids, or DEFAULT_SETS if no ids are named.
        robots: As for `find_sets`.

    Raises:
        ConfigError: There is no such id or set.
    """
    # Each set by its full name, and those of several robots by their common name.
    sets: dict[str, list[SceneSet]] = {}
    for env_id in dict.fromkeys(envs or PACKAGED_CHOICES):
        for scenes in find_sets(env_id, robots):
            for name in dict.fromkeys((scenes.name.partition("/")[0], scenes.name)):
                sets.setdefault(name, []).append(scenes)
    wanted = names or ([] if envs else DEFAULT_SETS) or sets
    check_names("--sets {}", wanted, sets)
    return list(dict.fromkeys(scenes for name in wanted for scenes in sets[name]))


def task_worlds(env_id: str) -> str:
    """Return the generator or folder that an id's task takes its worlds from. "" for none."""
    # Results name their worlds, so these must have one name.
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
    """Make an env of an id, closed. ConfigError if it isn't an env of acsar_gym."""
    # Only its task, sensors and worlds are looked at.
    try:
        env = gymnasium.make(env_id, link="planar")
        env.close()
    except (gymnasium.error.Error, ImportError, TypeError) as error:
        raise ConfigError(f"--env {show_value(env_id)}: {explain_error(error)}") from error
    if not isinstance(env.unwrapped, RobotEnv):
        raise ConfigError(f"--env {show_value(env_id)}: not an environment of acsar_gym")
    return env.unwrapped


def published_sets(sets: Iterable[SceneSet], folder: Path) -> list[SceneSet]:
    """Return copies of BARN's sets, of those that are driven in the published worlds, in these.

    `folder` has `world_N.world` and `path_N.npy` or `path_files`. WorldError if not.
    """
    return [
        replace(
            scenes,
            name=f"{scenes.name}{PUBLISHED_SUFFIX}",
            source=str(folder),
            numbers=number_worlds(str(folder)),
            split=GIVEN,
        )
        for scenes in sets
        if scenes.id.startswith("Barn-") and scenes.name in PUBLISHED_BARN
    ]


@cache
def hash_scenes(scenes: SceneSet, count: int) -> list[str]:
    """Hash every 100 scenes as far as `count` needs. The last block may be a short one."""
    # Whole blocks, because each has one hash.
    numbers = scenes.numbers[: -(-count // SCENES_PER_HASH) * SCENES_PER_HASH]
    if scenes.source:
        # Worlds depend on the footprint of the robot.
        pool = read_pool(scenes.worlds or "", scenes.difficulty, scenes.robot)
        hashes = [hash_world(pool[number]) for number in numbers]
    else:
        # On an open floor a scene is the goal that its seed draws.
        spawn = Spawn(PointGoal(), None, None, scenes.config)
        goals = [spawn.draw(seeding.np_random(seed)[0], {}).goal for seed in numbers]
        hashes = [hash_numbers([goal]) for goal in goals]
    blocks = [hashes[i : i + SCENES_PER_HASH] for i in range(0, len(hashes), SCENES_PER_HASH)]
    return [hashlib.sha256(b"".join(block)).hexdigest() for block in blocks]


@cache
def read_pool(source: str, difficulty: float | None, robot: str) -> Pool:
    """Read or generate worlds for the footprint of a robot."""
    return Pool.of(source, difficulty, footprint_radius(RobotConfig.of(robot)))


def number_worlds(folder: str) -> range:
    """Return the numbers of the worlds in a folder."""
    return range(len(read_pool(folder, None, DEFAULT_ROBOT)))
