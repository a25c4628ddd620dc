"""Sets and pools: every form of worlds=, made when needed or given, and what is refused."""

from __future__ import annotations

import copy
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from acsar_gym.errors import WorldError
from acsar_gym.worlds import files, generators
from acsar_gym.worlds.pool import Pool
from acsar_gym.worlds.sets import WorldSet, name_alone
from acsar_gym.worlds.world import Region, World, make_rectangle

PILLAR = np.array([[0.0, 0.0, 0.5]])
SOUND = World(PILLAR, start=Region(-2.0, 0.0), goal=Region(2.0, 0.0), name="pillar")
CELL = World(segments=make_rectangle(-1, -1, 1, 1), goal=Region(4.0, 0.0), name="cell")


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty working directory, so that no name here is that of a file."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("source", "numbers", "title"),
    [
        ("rooms", range(1000, 1400), "rooms 1000 to 1399 (train split)"),
        ("barn:test", range(300), "barn 0 to 299 (test split)"),
        ([SOUND, SOUND], range(2), "given 0 to 1"),
        (WorldSet("open", range(3)), range(3), "open 0 to 2 (test split)"),
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


def test_pool_makes_worlds_when_they_are_needed_and_once(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: Counter[tuple[Any, ...]] = Counter()
    generate_world = generators.generate_world

    def count(*arguments: Any) -> World:
        calls[arguments] += 1
        return generate_world(*arguments)

    monkeypatch.setattr(generators, "generate_world", count)
    pool = Pool.of("clutter:100-149", 0.2, 0.3)
    assert (len(pool), len(calls)) == (50, 0)
    first = pool[107]
    assert first.name == "clutter 107"
    assert pool[107] is first
    for number in (-1, 99, 150):
        with pytest.raises(WorldError, match=rf"world {number}: must be of clutter 100 to 149"):
            pool[number]
    assert calls == {("clutter", 107, 0.2, 0.3): 1}
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


def test_pool_ranks_worlds_by_difficulty() -> None:
    pool = Pool.of(["open:100-139", "clutter:20"], (0.2, 0.8))
    order, levels = pool.by_difficulty
    assert sorted(order.tolist()) == list(range(60))
    assert (np.diff(levels) >= 0.0).all()
    drawn = []
    for place in order.tolist():
        kind, number = str(pool.key(place)).split()
        drawn.append(generators.draw_difficulty(kind, int(number), (0.2, 0.8)))
    assert levels.tolist() == drawn
    ranks = pool.ranks((0.3, 0.5))
    assert list(ranks) == [rank for rank in range(60) if 0.3 <= drawn[rank] <= 0.5]
    assert pool.ranks((0.0, 1.0)) == range(60)


def test_pool_gives_a_world_without_a_path_one() -> None:
    pool = Pool.of(SOUND, radius=0.3)
    assert (pool.numbers, pool[0].name) == (range(1), "pillar")
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
    assert name_alone("clutter", "test") == "clutter:test"
    named = name_alone(["barn", "open:3", "a.world", SOUND], "test")
    assert named == ["barn:test", "open:3", "a.world", SOUND]


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("clutter:3,barn:3", "worlds = 'clutter:3,barn:3': names several sets: give a list, or"),
        ("clutter+6:3", "worlds = 'clutter+6:3': must be like"),
        ("cluter:5", "unknown kind of world 'cluter'; did you mean 'clutter'?"),
        ("clutter:5-3", "worlds = 'clutter:5-3': must hold 1 to"),
        ([], "worlds = []: must be a file"),
        ({"path": "open:3", "goal": (1, 2)}, "worlds = 'open:3': generated worlds have a start"),
        ("nowhere.world", "nowhere.world: there is no such file"),
        (Path(), "bad.json: not valid JSON"),
        ([SOUND, CELL, SOUND], "cell: no way from start to goal"),
    ],
    ids=lambda source: repr(source)[:20],
)
def test_pool_refuses_other_sources_in_one_line(source: Any, message: str, folder: Path) -> None:
    (folder / "bad.json").write_text("{", encoding="utf-8")
    with pytest.raises(WorldError) as caught:
        Pool.of(source)
    assert str(caught.value).startswith(message)
    assert "\n" not in str(caught.value)
