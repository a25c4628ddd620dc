"""Pools: every form of worlds=, made when needed or given, and what is refused."""

from __future__ import annotations

import functools
import pickle
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from acsar_gym.errors import WorldError
from acsar_gym.worlds import files, generators, pool, registry
from acsar_gym.worlds.pool import Pool, check_world
from acsar_gym.worlds.world import Region, World, make_rectangle

KINDS = ("open", "clutter", "rooms", "barn", "smooth_path", "waypoint_path")
ENDS: dict[str, Any] = {"start": Region(-2.0, 0.0), "goal": Region(2.0, 0.0)}
PILLAR = np.array([[0.0, 0.0, 0.5]])
SOUND = World(PILLAR, **ENDS, name="pillar")
CELL = World(segments=make_rectangle(-1, -1, 1, 1), goal=Region(4.0, 0.0), name="cell")
NO_SOURCES: tuple[Any, ...] = (
    *("Clutter", "clutter:", "clutter:-5", " clutter", "", "a\0b", "x" * 300, "clutter\n"),
    *("clutter:" + "9" * 300, None, 5, True, [], {}, {SOUND}, [1], [SOUND, None]),
    *(World, b"open", PILLAR),
)
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
        ("clutter:train", range(1000, 1400), "clutter 1000 to 1399 (train split)"),
        ("clutter:test", range(200), "clutter 0 to 199 (test split)"),
        ("barn:test", range(300), "barn 0 to 299 (test split)"),
        ("rooms:200-299", range(200, 300), "rooms 200 to 299"),
        ("clutter:50-99", range(50, 100), "clutter 50 to 99 (test split)"),
        ("clutter:0-1399", range(1400), "clutter 0 to 1399"),
        ("open:7-7", range(7, 8), "open 7 to 7 (test split)"),
        ("open:007", range(7), "open 0 to 6 (test split)"),
        ("smooth_path:1000000-1000001", range(10**6, 10**6 + 2), "smooth_path 1000000 to 1000001"),
        ([SOUND, SOUND], range(2), "given 0 to 1"),
    ],
)
def test_names_numbers_and_splits(source: Any, numbers: range, title: str) -> None:
    found = Pool.of(source)
    assert (len(found), found.numbers, str(found)) == (len(numbers), numbers, title)
    assert f"({found.split} split)" in title or not found.split


@pytest.mark.parametrize("kind", KINDS)
def test_no_world_is_in_two_splits(kind: str) -> None:
    every = [number for split in registry.SPLITS for number in registry.split_numbers(kind, split)]
    assert len(every) == len(set(every))


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        ("clutter", "clutter:test"),
        ("barn:train", "barn:train"),
        ("clutter:1000-1099", "clutter:1000-1099"),
        ("mine/worlds", "mine/worlds"),
        (SOUND, SOUND),
    ],
)
def test_the_split_to_test_in(source: Any, expected: Any) -> None:
    assert registry.add_test_split(source) == expected


def test_the_usual_count_may_be_changed() -> None:
    counts = {"open": 7, "open:3": 3, "open:3-9": 7}
    assert {source: len(Pool.of(source, count=7)) for source in counts} == counts
    with pytest.raises(WorldError, match=r"worlds = 'open': holds no world"):
        Pool.of("open", count=0)


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


def test_a_pool_forgets_what_was_not_asked_for_lately(
    calls: Counter[tuple[Any, ...]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pool, "KEPT_WORLDS", 2)
    found = Pool.of("open:10")
    before = found[0]
    for index in (1, 2, 0):
        found[index]
    assert calls["open", 0, None, 0.25] == 2
    assert found[0].goal == before.goal


@pytest.mark.parametrize("number", [-1, 3, 10**30])
@pytest.mark.parametrize(
    ("source", "allowed"), [("open:3", "0 to 2 (open)"), ([SOUND] * 3, "0 to 2 (given)")]
)
def test_a_number_out_of_range_is_refused(source: Any, allowed: str, number: int) -> None:
    with pytest.raises(WorldError) as caught:
        Pool.of(source)[number]
    assert str(caught.value) == f"world {number}: must be {allowed}"


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("cluter:5", "unknown kind of world 'cluter'; did you mean 'clutter'?"),
        ("xyzzy", "unknown kind of world 'xyzzy'; known: barn, clutter, open, rooms"),
        ("clutter:0", "worlds = 'clutter:0': holds no world"),
        ("clutter:5-3", "worlds = 'clutter:5-3': holds no world"),
        ("clutter:valid", "worlds = 'clutter:valid'"),
        *((bad, "worlds = ") for bad in NO_SOURCES),
        ("nowhere.world", "nowhere.world: there is no such file"),
        ("nowhere/", "nowhere: a world is read from"),
        (Path("clutter"), "clutter: a world is read from"),
        ("mine.txt", "mine.txt: a world is read from"),
        ("notes", "notes: a world is read from"),
        ("empty", "empty: holds no worlds"),
        (Path("empty"), "empty: holds no worlds"),
        ("bad.json", "bad.json: not valid JSON"),
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


def test_a_bad_difficulty_is_refused_at_once() -> None:
    with pytest.raises(WorldError, match="difficulty = 2"):
        Pool.of("open", 2.0)


@pytest.mark.parametrize("source", ["clutter:3-9", [SOUND]], ids=["name", "list"])
def test_a_copy_of_a_pool_holds_the_same_worlds(source: Any) -> None:
    """As another process gets it."""
    one = Pool.of(source, 0.3 if isinstance(source, str) else None, 0.3)
    world = next(iter(one))
    other = pickle.loads(pickle.dumps(one))  # noqa: S301 - our own bytes
    assert (str(other), other.numbers, other.radius) == (str(one), one.numbers, 0.3)
    assert (other.difficulty, other.generated) == (one.difficulty, one.generated)
    assert np.array_equal(next(iter(other)).circles, world.circles)
    assert np.array_equal(np.asarray(next(iter(other)).path), np.asarray(world.path))


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


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("open:4", "none of the env's worlds; theirs are"),
        ("open:100001", "100,001 worlds, at most 100,000"),
        (World(), "only generated worlds have one"),
    ],
)
def test_a_range_of_difficulty_that_holds_none_is_refused(source: Any, message: str) -> None:
    with pytest.raises(WorldError, match=message):
        Pool.of(source).ranks((0.9999, 1.0))


@pytest.mark.parametrize("source", [SOUND, [SOUND], (SOUND,)], ids=["a world", "a list", "a tuple"])
def test_a_given_world_without_a_path_gets_one(source: Any) -> None:
    found = Pool.of(source, radius=0.3)
    assert (found.kind, len(found)) == ("given", 1)
    world = found[0]
    assert world.length == pytest.approx(4.4, abs=0.2)
    assert world.name == "pillar"
    assert np.array_equal(world.circles, PILLAR)
    assert SOUND.path is None
    assert found[0] is world


def test_a_given_path_is_kept() -> None:
    given = World(PILLAR, **ENDS, path=WAY)
    assert Pool.of(given)[0] is given
    assert check_world(given, 0.25) is given


@pytest.mark.parametrize("path", [None, WAY], ids=["without a path", "with a path"])
@pytest.mark.parametrize(
    ("start", "goal", "message"),
    [
        (Region(0.1, 0.0), ENDS["goal"], r"the start \(0\.1, 0\) lies 0\.00 m"),
        (ENDS["start"], Region(0.7, 0.0), r"the goal \(0\.7, 0\) lies 0\.20 m"),
        (Region(-2.0, 0.0, 1.3), ENDS["goal"], r"the start .* needs 1\.55 m"),
        (ENDS["start"], Region(2.0, 0.0, 1.3), r"the goal .* needs 1\.55 m"),
    ],
)
def test_given_worlds_whose_ends_are_not_free_are_refused(
    start: Region, goal: Region, message: str, path: Any
) -> None:
    world = World(PILLAR, start=start, goal=goal, path=path, name="mine")
    with pytest.raises(WorldError, match=f"^mine: {message}"):
        Pool.of(world)


def test_the_footprint_decides_whether_a_given_world_can_be_used() -> None:
    posts = np.array([[0.0, 0.3, 0.0, 5.0], [0.0, -0.3, 0.0, -5.0]])
    gap = World(segments=posts, start=Region(-1.0, 1.0), goal=Region(1.0, 1.0))
    assert Pool.of(gap, radius=0.2)[0].length < 3.0
    assert Pool.of(gap, radius=0.4)[0].length > 8.0


def test_files_and_folders(folder: Path) -> None:
    files.save_world(SOUND, folder / "mine.json")
    for source in ("mine.json", folder / "mine.json", Path("mine.json"), "./mine.json"):
        found = Pool.of(source)
        assert (found.kind, len(found)) == (str(source), 1)
        assert (found[0].name, found[0].goal) == ("pillar", SOUND.goal)
        assert found[0].path is not None
    (folder / "mine").mkdir()
    for number in (1, 2, 10):
        world = World(name=f"number {number}")
        files.save_world(world, folder / "mine" / f"world_{number}.yaml")
    for source in ("mine", "mine/", folder / "mine"):
        found = Pool.of(source)
        assert [world.name for world in found] == ["number 1", "number 2", "number 10"]


def test_a_kind_of_world_is_that_whatever_files_there_are(folder: Path) -> None:
    (folder / "open").mkdir()
    (folder / "barn").write_text("no world", encoding="utf-8")
    assert [Pool.of(source).kind for source in ("open:2", "barn")] == ["open", "barn"]
    files.save_world(SOUND, folder / "open" / "mine.json")
    for source in ("./open", Path("open")):
        assert Pool.of(source)[0].name == "pillar"
