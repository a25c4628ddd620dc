"""Pools: every form of worlds=, made when needed or given, and what is refused."""

from __future__ import annotations

import copy
import functools
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from acsar_gym.errors import WorldError
from acsar_gym.worlds import files, generators
from acsar_gym.worlds.pool import Pool
from acsar_gym.worlds.world import Region, World, make_rectangle

ENDS: dict[str, Any] = {"start": Region(-2.0, 0.0), "goal": Region(2.0, 0.0)}
PILLAR = np.array([[0.0, 0.0, 0.5]])
SOUND = World(PILLAR, **ENDS, name="pillar")
CELL = World(segments=make_rectangle(-1, -1, 1, 1), goal=Region(4.0, 0.0), name="cell")
WAY = np.array([[-2.0, 0.0], [0.0, 1.0], [2.0, 0.0]])


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty working directory, so that no name here is that of a file."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> Counter[tuple[Any, ...]]:
    """How often each world was made."""
    counter: Counter[tuple[Any, ...]] = Counter()
    real = generators.generate_world

    def counted(*arguments: Any) -> World:
        counter[arguments] += 1
        return real(*arguments)

    monkeypatch.setattr(generators, "generate_world", counted)
    return counter


@pytest.mark.parametrize(
    ("source", "numbers", "title"),
    [
        ("rooms", range(1000, 1400), "rooms 1000 to 1399 (train split)"),
        ("clutter:test", range(200), "clutter 0 to 199 (test split)"),
        ("clutter:50-99", range(50, 100), "clutter 50 to 99 (test split)"),
        ("open:007", range(7), "open 0 to 6 (test split)"),
        ([SOUND, SOUND], range(2), "given 0 to 1"),
        (
            "clutter:train,barn:train",
            range(800),
            "clutter 1000 to 1399 (train split) and barn 1000 to 1399 (train split)",
        ),
    ],
)
def test_names_numbers_and_splits(source: Any, numbers: range, title: str) -> None:
    found = Pool.of(source)
    assert (len(found), found.numbers, str(found)) == (len(numbers), numbers, title)
    assert f"({found.split} split)" in title or not found.split


def test_worlds_are_made_when_they_are_needed_and_once(calls: Counter[tuple[Any, ...]]) -> None:
    found = Pool.of("clutter:100-149", 0.2, 0.3)
    assert len(found) == 50
    assert not calls
    first = found[107]
    assert first.name == "clutter 107"
    assert calls == {("clutter", 107, 0.2, 0.3): 1}
    assert found[107] is first
    for number in (-1, 7, 99, 150):
        with pytest.raises(WorldError, match=f"world {number}"):
            found[number]
    assert calls.total() == 1
    assert Pool.of("clutter:100-149", 1.0, 0.3)[107].obstacles > first.obstacles
    assert [world.name for world in Pool.of("open:2")] == ["open 0", "open 1"]


def test_worlds_of_several_generators_are_one_pool() -> None:
    joined = Pool.of("clutter:7-8,open:3,clutter+2:1", 0.2, 0.3)
    names = ["clutter 7", "clutter 8", "open 0", "open 1", "open 2", "clutter+2 0"]
    assert [world.name for world in joined] == names
    assert (joined.kind, joined.split) == ("clutter,open,clutter+2", "test")
    assert joined.moves
    assert not Pool.of("clutter:7-8,open:3").moves
    assert Pool.of("clutter:train,barn:test").split == ""
    assert joined.name_split("validation") == (
        "clutter:validation,open:validation,clutter+2:validation"
    )
    copied = copy.deepcopy(joined)
    assert [world.name for world in copied] == names
    with pytest.raises(WorldError, match="must be 0 to 5"):
        joined[7]


def test_worlds_of_several_generators_are_ordered_by_difficulty_together() -> None:
    joined = Pool.of("clutter:20,barn:20")
    order, levels = joined.by_difficulty
    assert sorted(order) == list(range(40))
    for kind, first in (("clutter", 0), ("barn", 20)):
        alone, own_levels = Pool.of(f"{kind}:20").by_difficulty
        of_kind = (order >= first) & (order < first + 20)
        assert (order[of_kind] - first).tolist() == alone.tolist()
        assert levels[of_kind].tolist() == own_levels.tolist()


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("clutter:3,cluter:3", "worlds = 'clutter:3,cluter:3': must be like"),
        ("cluter:5", "unknown kind of world 'cluter'; did you mean 'clutter'?"),
        ("xyzzy", "unknown kind of world 'xyzzy'; known: barn, clutter, crowd, crowd_reacting"),
        ("clutter:valid", "worlds = 'clutter:valid'"),
        *((bad, "worlds = ") for bad in ("clutter:-5", "", "a\0b", "clutter:" + "9" * 300)),
        ("nowhere.world", "nowhere.world: there is no such file"),
        ("notes", "notes: a world is read from"),
        ("empty", "empty: holds no worlds"),
        (Path(), "bad.json: not valid JSON"),
        ("cell.yaml", "cell: no way from start to goal"),
        ([SOUND, CELL, SOUND], "cell: no way from start to goal"),
    ],
    ids=lambda source: repr(source)[:20],
)
def test_what_is_no_source_is_refused_at_once(source: Any, message: str, folder: Path) -> None:
    (folder / "empty").mkdir()
    (folder / "notes").write_text("no world", encoding="utf-8")
    (folder / "bad.json").write_text("{", encoding="utf-8")
    files.save_world(CELL, folder / "cell.yaml")
    with pytest.raises(WorldError) as caught:
        Pool.of(source)
    assert str(caught.value).startswith(message)
    assert "\n" not in str(caught.value)


def test_worlds_of_a_range_of_difficulty() -> None:
    found = Pool.of("open:100-139", (0.2, 0.8))
    order, levels = found.by_difficulty
    assert sorted(order.tolist()) == list(range(40))
    assert (np.diff(levels) >= 0.0).all()
    ranks = found.ranks((0.3, 0.5))
    inside = {100 + int(place) for place in order[ranks.start : ranks.stop]}
    level = functools.partial(generators.draw_difficulty, "open", difficulty=(0.2, 0.8))
    assert inside == {number for number in found.numbers if 0.3 <= level(number) <= 0.5}
    assert found.ranks((0.0, 1.0)) == range(40)


@pytest.mark.parametrize("source", [SOUND, [SOUND], (SOUND,)], ids=["a world", "a list", "a tuple"])
def test_a_given_world_without_a_path_gets_one(source: Any) -> None:
    found = Pool.of(source, radius=0.3)
    world = found[0]
    assert (found.kind, len(found), world.name) == ("given", 1, "pillar")
    assert world.length == pytest.approx(4.4, abs=0.2)
    assert np.array_equal(world.circles, PILLAR)
    assert found[0] is world
    given = World(PILLAR, **ENDS, path=WAY)
    assert Pool.of(given)[0] is given


def test_files_and_folders(folder: Path) -> None:
    files.save_world(SOUND, folder / "mine.json")
    for source in ("./mine.json", folder / "mine.json"):
        found = Pool.of(source)
        assert (found.kind, found[0].name, found[0].goal) == (str(source), "pillar", SOUND.goal)
        assert found[0].path is not None
    (folder / "open").mkdir()
    for number in (1, 2, 10):
        world = World(name=f"number {number}")
        files.save_world(world, folder / "open" / f"world_{number}.yaml")
    for source in ("open/", folder / "open"):
        assert [world.name for world in Pool.of(source)] == ["number 1", "number 2", "number 10"]
    assert Pool.of("open:2").kind == "open"  # a kind is that whatever files there are
