"""Sets, pools, the cache and registered generators: every form of worlds=, and what is refused."""

from __future__ import annotations

import copy
import json
from dataclasses import asdict
from importlib import metadata
from pathlib import Path
from typing import Any

import corridors as example
import gymnasium
import numpy as np
import pytest

from acsar_gym.errors import ConfigError, WorldError
from acsar_gym.resources import CACHE_VARIABLE
from acsar_gym.worlds import cache, files, generators, registry
from acsar_gym.worlds.pool import Pool
from acsar_gym.worlds.registry import register
from acsar_gym.worlds.sets import WorldSet, name_alone
from acsar_gym.worlds.world import Region, World, make_rectangle

PILLAR = np.array([[0.0, 0.0, 0.5]])
SOUND = World(PILLAR, start=Region(-2.0, 0.0), goal=Region(2.0, 0.0), name="pillar")
CELL = World(segments=make_rectangle(-1, -1, 1, 1), goal=Region(4.0, 0.0), name="cell")


CORRIDORS = registry.REGISTERED.pop("corridors")
"""The example. No other test shall know it."""
WALLS = np.array([[1.0, -1.0, 1.0, -0.2], [1.0, 0.2, 1.0, 1.0], *make_rectangle(-1, -1, 3, 1)])
GAP = World(segments=WALLS, goal=Region(2.0, 0.0))
THROUGH = World(segments=WALLS, path=np.array([[0.0, 0.0], [2.0, 0.0]]))


@pytest.fixture(autouse=True)
def registered(monkeypatch: pytest.MonkeyPatch) -> None:
    """The example is registered. What a test registers is forgotten after it."""
    monkeypatch.setattr(registry, "REGISTERED", {"corridors": CORRIDORS})


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty working directory, so that no name here is that of a file, and an empty cache."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "cache"))
    return tmp_path


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """The arguments of generated worlds, in order."""
    calls: list[Any] = []
    generate = generators.generate_world

    def counting(*arguments: Any) -> World:
        calls.append(arguments)
        return generate(*arguments)

    monkeypatch.setattr(generators, "generate_world", counting)
    return calls


@pytest.mark.parametrize(
    ("source", "numbers", "title"),
    [
        ("rooms", range(1000, 1400), "rooms 1000 to 1399 (train split)"),
        ("barn:test", range(300), "barn 0 to 299 (test split)"),
        ([SOUND, SOUND], range(2), "given 0 to 1"),
        (["open:3", "barn:train"], None, "open 0 to 2 (test split) and barn 1000 to 1399 (tr"),
    ],
)
def test_pool_of_a_source_has_numbers_and_a_title(
    source: Any, numbers: range | None, title: str
) -> None:
    pool = Pool.of(source)
    assert pool.numbers == numbers
    assert str(pool).startswith(title)
    assert len(pool) == (403 if numbers is None else len(numbers))


def test_pool_makes_worlds_when_they_are_needed_and_once(made: list[Any]) -> None:
    pool = Pool.of("clutter:100-149", 0.2, 0.3)
    assert (len(pool), made) == (50, [])
    first = pool[107]
    assert first.name == "clutter 107"
    assert pool[107] is first
    assert made == [("clutter", 107, 0.2, 0.3)]
    for number in (-1, 99, 150):
        with pytest.raises(WorldError, match=rf"world {number}: must be of clutter 100 to 149"):
            pool[number]
    assert Pool.of("clutter:100-149", 1.0, 0.3)[107].obstacles > first.obstacles


def test_pool_of_several_sets_has_worlds_by_name() -> None:
    pool = Pool.of(["clutter:7-8", "open:3", SOUND], 0.2, 0.3)
    names = ["clutter 7", "clutter 8", "open 0", "open 1", "open 2", "given 0"]
    assert [pool.key(place) for place in range(len(pool))] == names
    for worlds in (pool, copy.deepcopy(pool), map(pool.__getitem__, names)):
        assert [world.name for world in worlds] == [*names[:5], "pillar"]
    assert (pool.split, pool.generated, pool.moves) == ("", False, False)
    for key in (7, "clutter 9", "open"):
        with pytest.raises(WorldError, match="must be a name like 'clutter 17', of clutter 7 to 8"):
            pool[key]


@pytest.mark.parametrize(
    ("sets", "name"),
    [
        ([SOUND, "open:3", SOUND], "given 0"),
        ([WorldSet.parse("clutter:5-9", 0.1), WorldSet.parse("clutter:8-12", 0.9)], "clutter 8"),
    ],
)
def test_pool_refuses_two_worlds_of_one_name(sets: list[Any], name: str) -> None:
    """By its name only the first was found, and the second was never driven."""
    with pytest.raises(WorldError, match=f"two sets have a world '{name}'"):
        Pool.of(sets)
    assert len(Pool.of(["clutter:5-9", "clutter:8-12"])) == 10


def test_pool_ranks_worlds_by_difficulty() -> None:
    pool = Pool.of(["open:100-139", "clutter:20"], (0.2, 0.8))
    order, levels = pool.by_difficulty
    assert sorted(order.tolist()) == list(range(60))
    assert (np.diff(levels) >= 0.0).all()
    for place, level in zip(order.tolist(), levels.tolist(), strict=True):
        kind, number = str(pool.key(place)).split()
        assert level == generators.draw_difficulty(kind, int(number), (0.2, 0.8))
    first, *_, last = pool.ranks((0.3, 0.5))
    assert levels[first - 1] < 0.3 <= levels[first]
    assert levels[last] <= 0.5 < levels[last + 1]


def test_pool_gives_a_world_without_a_path_one() -> None:
    pool = Pool.of(SOUND, radius=0.3)
    assert pool[0].length == pytest.approx(4.4, abs=0.2)
    assert pool[0] is pool[0]


def test_pool_prefers_a_generator_to_a_folder_of_its_name(folder: Path) -> None:
    (folder / "open").mkdir()
    for number in (1, 2, 10):
        files.save_world(World(name=f"number {number}"), folder / "open" / f"w_{number}.yaml")
    assert str(Pool.of("open")) == "open 1000 to 1399 (train split)"
    for source in ("open/", folder / "open", {"path": "./open"}):
        assert [world.name for world in Pool.of(source)] == ["number 1", "number 2", "number 10"]


def test_name_alone_adds_a_split_to_names_without_numbers() -> None:
    named = name_alone(["barn", "open:3", "a.world", SOUND], "test")
    assert named == ["barn:test", "open:3", "a.world", SOUND]


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("clutter:3,barn:3", "worlds = 'clutter:3,barn:3': names several sets: give a list, or"),
        ("clutter:5-3", "worlds = 'clutter:5-3': must hold 1 to"),
        ([], "worlds = []: must be a file"),
        ({"path": "open:3", "goal": (1, 2)}, "worlds = 'open:3': generated worlds have a start"),
        ("nowhere.world", "nowhere.world: there is no such file"),
        ([SOUND, CELL, SOUND], "cell: no way from start to goal"),
    ],
    ids=lambda source: repr(source)[:20],
)
def test_pool_refuses_other_sources_in_one_line(source: Any, message: str) -> None:
    with pytest.raises(WorldError) as caught:
        Pool.of(source)
    assert str(caught.value).startswith(message)
    assert "\n" not in str(caught.value)


# Worlds kept on disk


def content(world: World) -> str:
    """All of a world to the bit. Raises ValueError for a world that can be changed."""
    with pytest.raises(ValueError, match="read-only"):
        world.circles.sort()
    with np.printoptions(floatmode="unique", threshold=10**9):
        return repr(asdict(world))


@pytest.mark.parametrize("kind", ["rooms", "barn", "crowd"])
def test_cached_worlds_are_the_generated_ones_to_the_bit(kind: str, made: list[Any]) -> None:
    first = list(map(content, Pool.of(f"{kind}:98-100")))
    again = list(map(content, Pool.of(f"{kind}:98-101")))
    assert [number for _, number, _, _ in made] == [98, 99, 100, 101]
    assert again[:3] == first
    assert Pool.of(f"{kind}:98-98", 0.5)[98].name == f"{kind} 98"
    assert len(made) == 5


def test_cache_makes_worlds_again_for_a_broken_file_and_a_changed_generator(
    folder: Path, monkeypatch: pytest.MonkeyPatch, made: list[Any]
) -> None:
    world = content(Pool.of("open:1")[0])
    (file,) = folder.rglob("*.pickle")
    file.write_bytes(b"")
    assert content(Pool.of("open:1")[0]) == content(Pool.of("open:1")[0]) == world
    assert len(made) == 2
    monkeypatch.setattr(cache, "fingerprint", lambda: "other sources")
    assert content(Pool.of("open:1")[0]) == world
    assert len(made) == 3


def test_cache_needs_no_installed_package(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(name: str) -> None:
        raise metadata.PackageNotFoundError(name)

    monkeypatch.setattr(metadata.Distribution, "from_name", refuse)
    cache.fingerprint.cache_clear()
    assert Pool.of("open:1")[0].name == "open 0"


def test_cache_has_no_worlds_of_a_users_own_generator(folder: Path, made: list[Any]) -> None:
    register("mine", lambda rng, difficulty, radius: World())
    assert [Pool.of("mine:1")[0].name for _ in range(2)] == ["mine 0"] * 2
    assert len(made) == 2
    assert not (folder / "cache").exists()


def test_cache_is_pruned_by_a_process_that_makes_worlds(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert list(Pool.of("open:5"))
    monkeypatch.setattr(cache, "MAX_CACHE_BYTES", 1)
    cache._prune.cache_clear()
    assert Pool.of("open:10-10")[10]
    assert [path.name for path in folder.rglob("*.pickle")] == ["open 10 None 0.25.pickle"]


# Generators that other packages register


def test_register_lets_envs_and_batches_drive_in_a_users_worlds() -> None:
    worlds = "corridors:corridors:3-4"
    env: Any = gymnasium.make("acsar_gym/ObstacleGoal-v1", link="planar", worlds=worlds)
    batch: Any = gymnasium.make_vec(
        "acsar_gym/ObstacleGoal-v1", 4, vectorization_mode="vector_entry_point", worlds=worlds
    )
    observation, info = env.reset(seed=3)
    observations, infos = batch.reset(seed=0)
    assert info["world"] == infos["world"][3]
    assert observations[3] == pytest.approx(observation, abs=1e-6)
    assert json.loads(env.spec.to_json())["kwargs"]["worlds"] == worlds


@pytest.mark.parametrize(
    ("name", "make", "reason"),
    [
        ("corridors", lambda rng, difficulty, radius: GAP, "corridors has a generator"),
        ("clutter", example.corridors, "acsar_gym has a generator"),
        ("a:b", example.corridors, "lower-case"),
        ("mine", lambda rng, difficulty: GAP, "footprint_radius"),
    ],
)
def test_register_refuses_bad_names_and_generators(name: Any, make: Any, reason: str) -> None:
    with pytest.raises(ConfigError, match=reason):
        register(name, make)


def test_register_may_replace_a_name_of_the_same_module() -> None:
    register("mine", lambda rng, difficulty, radius: GAP)
    register("mine", lambda rng, difficulty, radius: World(goal=Region(3.0, 0.0)))
    assert Pool.of("mine:1")[0].goal.x == 3.0


def raising(rng: Any, difficulty: float, radius: float) -> World:
    raise KeyError("no\nsuch thing")


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (raising, r"'mine' of .*test_pool: raised KeyError: 'no\\nsuch thing'"),
        (lambda rng, difficulty, radius: [GAP], r"returned \[World.*, must return a World"),
        (lambda rng, difficulty, radius: GAP, "^mine: no world .*no way from start to goal"),
        (lambda rng, difficulty, radius: THROUGH, "path passes 0.20 m from an obstacle"),
    ],
)
def test_generate_world_names_a_generator_that_goes_wrong(
    make: Any, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(generators, "MAX_ATTEMPTS", 3)
    register("mine", make)
    with pytest.raises(WorldError, match=message) as caught:
        generators.generate_world("mine", 0, 0.5)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("no_such.module:mine", "can't import no_such.module: .*; install it, or name its folder"),
        ("math:mine:0-9", "importing math registers no 'mine'"),
        ("corridor:5", "unknown kind of world 'corridor'; did you mean 'corridors'"),
    ],
)
def test_pool_names_modules_that_register_nothing(source: str, message: str) -> None:
    with pytest.raises(WorldError, match=message):
        Pool.of(source)
