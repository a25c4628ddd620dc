"""Pools: every form of worlds=, made when needed or given, and what is refused."""

from __future__ import annotations

import functools
import pickle
import re
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
PILLAR = np.array([[0.0, 0.0, 0.5]])
SOUND = World(PILLAR, start=Region(-2.0, 0.0), goal=Region(2.0, 0.0), name="pillar")


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
    ("source", "kind", "numbers"),
    [
        *((kind, kind, range(1000, 1400)) for kind in KINDS),
        *((f"{kind}:train", kind, range(1000, 1400)) for kind in KINDS),
        *((f"{kind}:test", kind, range(200)) for kind in KINDS if kind != "barn"),
        ("barn:test", "barn", range(300)),
        ("open:5", "open", range(5)),
        ("open:1", "open", range(1)),
        ("open:100-104", "open", range(100, 105)),
        ("open:7-7", "open", range(7, 8)),
        ("open:0-2", "open", range(3)),
        ("open:007", "open", range(7)),
        ("waypoint_path:3", "waypoint_path", range(3)),
        ("smooth_path:1000000-1000001", "smooth_path", range(1_000_000, 1_000_002)),
    ],
)
def test_names_and_numbers(source: str, kind: str, numbers: range) -> None:
    found = Pool.of(source)
    assert (found.kind, len(found), found.numbers) == (kind, len(numbers), numbers)


def test_a_world_has_the_generators_number() -> None:
    found = Pool.of("open:1250-1254")
    assert [found[number].name for number in (1250, 1254)] == ["open 1250", "open 1254"]
    assert [world.name for world in found] == [f"open {number}" for number in found.numbers]


@pytest.mark.parametrize(
    ("source", "split", "title"),
    [
        ("clutter", "train", "clutter 1000 to 1399 (train split)"),
        ("clutter:test", "test", "clutter 0 to 199 (test split)"),
        ("clutter:50-99", "test", "clutter 50 to 99 (test split)"),
        ("barn:200-299", "test", "barn 200 to 299 (test split)"),
        ("rooms:200-299", "", "rooms 200 to 299"),
        ("clutter:0-1399", "", "clutter 0 to 1399"),
        ([SOUND, SOUND], "", "given 0 to 1"),
    ],
)
def test_a_pool_knows_its_split(source: Any, split: str, title: str) -> None:
    found = Pool.of(source)
    assert (found.split, str(found)) == (split, title)


def test_no_world_is_in_two_splits() -> None:
    for kind in KINDS:
        every = [
            number for name in registry.SPLITS for number in registry.split_numbers(kind, name)
        ]
        assert len(every) == len(set(every))


@pytest.mark.parametrize(
    ("source", "tested"),
    [
        ("clutter", "clutter:test"),
        ("barn:train", "barn:train"),
        ("rooms:test", "rooms:test"),
        ("clutter:1000-1099", "clutter:1000-1099"),
        ("mine/worlds", "mine/worlds"),
        ("mine:train", "mine:train"),
        (None, None),
        (SOUND, SOUND),
    ],
)
def test_the_split_to_test_in(source: Any, tested: Any) -> None:
    found = registry.add_test_split(source)
    assert found is tested or found == tested


def test_the_usual_count_may_be_changed() -> None:
    assert len(Pool.of("open", count=7)) == 7
    assert len(Pool.of("open:3", count=7)) == 3
    assert len(Pool.of("open:3-9", count=2)) == 7
    with pytest.raises(WorldError, match=r"worlds = 'open': holds no world"):
        Pool.of("open", count=0)


def test_worlds_are_made_when_they_are_needed_and_once(calls: Counter[tuple[Any, ...]]) -> None:
    found = Pool.of("clutter:100-149", 0.2, 0.3)
    assert len(found) == 50
    assert not calls
    first = found[107]
    assert calls == {("clutter", 107, 0.2, 0.3): 1}
    assert found[107] is first
    found[108]
    assert calls.total() == 2
    for number in (-1, 7, 99, 150):
        with pytest.raises(WorldError):
            found[number]
    assert calls.total() == 2


def test_pools_remember_their_own_worlds(calls: Counter[tuple[Any, ...]]) -> None:
    one, other = Pool.of("open:5"), Pool.of("open:5", 1.0)
    assert one[0] is not other[0]
    assert one[0].goal != other[0].goal
    assert calls.total() == 2


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
    ("source", "allowed"),
    [
        ("open:3", "0 to 2 (open)"),
        ([SOUND] * 3, "0 to 2 (given)"),
        ("open:1000-1399", "1000 to 1399 (open)"),
    ],
    ids=["name", "list", "numbers"],
)
def test_a_number_out_of_range_is_one_clear_error(source: Any, allowed: str, number: int) -> None:
    with pytest.raises(WorldError) as caught:
        Pool.of(source)[number]
    assert str(caught.value) == f"world {number}: must be {allowed}"


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("cluter", "unknown kind of world 'cluter'; did you mean 'clutter'?"),
        ("cluter:5", "unknown kind of world 'cluter'; did you mean 'clutter'?"),
        ("barm:1-2", "unknown kind of world 'barm'; did you mean 'barn'?"),
        ("xyzzy", "unknown kind of world 'xyzzy'; known: barn, clutter, open, rooms"),
        ("clutter:0", "worlds = 'clutter:0': holds no world"),
        ("clutter:5-3", "worlds = 'clutter:5-3': holds no world"),
        ("clutter:valid", "worlds = 'clutter:valid': must be like 'clutter:test', 'clutter:50'"),
    ],
)
def test_bad_names_are_refused_at_once(source: str, message: str) -> None:
    with pytest.raises(WorldError) as caught:
        Pool.of(source)
    assert str(caught.value).startswith(message)


@pytest.mark.parametrize(
    "source",
    [
        "Clutter",
        "clutter:",
        "clutter:-5",
        "clutter:5-",
        "clutter:x",
        "clutter 5",
        " clutter",
        "a\0b",
    ],
)
def test_what_is_neither_a_name_nor_a_path_is_refused_at_once(source: str) -> None:
    with pytest.raises(WorldError, match=re.escape(repr(source)[1:-1])):
        Pool.of(source)


@pytest.mark.parametrize(
    "source",
    [None, 5, 1.5, True, [], (), {}, {SOUND}, [1], ["open"], [SOUND, None], World, b"open", PILLAR],
    ids=lambda source: str(source)[:20],
)
def test_other_types_are_refused(source: Any) -> None:
    with pytest.raises(WorldError) as caught:
        Pool.of(source)
    assert str(caught.value).startswith("worlds = ")
    expected = "must be a file, a folder, a list of World, or a kind of world (open, clutter, rooms"
    assert expected in str(caught.value)


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
def test_a_range_of_difficulty_that_holds_none_is_one_clear_error(
    source: Any, message: str
) -> None:
    with pytest.raises(WorldError, match=message):
        Pool.of(source).ranks((0.9999, 1.0))


CELL = World(
    segments=make_rectangle(-1.0, -1.0, 1.0, 1.0),
    start=Region(0.0, 0.0),
    goal=Region(4.0, 0.0),
    name="cell",
)
WAY = np.array([[-2.0, 0.0], [0.0, 1.0], [2.0, 0.0]])


@pytest.mark.parametrize("source", [SOUND, [SOUND], (SOUND,)], ids=["a world", "a list", "a tuple"])
def test_a_given_world_without_a_path_gets_one(source: Any) -> None:
    found = Pool.of(source, radius=0.3)
    assert (found.kind, len(found)) == ("given", 1)
    world = found[0]
    assert world.path is not None
    assert world.length == pytest.approx(4.4, abs=0.2)
    assert world.name == "pillar"
    assert np.array_equal(world.circles, PILLAR)
    assert SOUND.path is None
    assert found[0] is world


def test_a_given_path_is_kept() -> None:
    given = World(PILLAR, start=Region(-2.0, 0.0), goal=Region(2.0, 0.0), path=WAY)
    assert Pool.of(given)[0] is given
    assert check_world(given, 0.25) is given


def test_given_worlds_are_looked_at_at_once() -> None:
    found = Pool.of([SOUND, SOUND])
    assert found[1].path is not None
    with pytest.raises(WorldError, match="cell: no way from start to goal"):
        Pool.of([SOUND, CELL, SOUND])


def test_a_kind_of_world_is_that_whatever_files_there_are(folder: Path) -> None:
    (folder / "open").mkdir()
    (folder / "barn").write_text("no world", encoding="utf-8")
    assert Pool.of("open:2").kind == "open"
    assert Pool.of("barn").kind == "barn"
    files.save_world(SOUND, folder / "open" / "mine.json")
    for source in ("./open", Path("open")):
        assert Pool.of(source)[0].name == "pillar"


@pytest.mark.parametrize("path", [None, WAY], ids=["without a path", "with a path"])
@pytest.mark.parametrize(
    ("start", "goal", "message"),
    [
        (Region(0.1, 0.0), Region(2.0, 0.0), r"the start \(0\.1, 0\) lies 0\.00 m"),
        (Region(-2.0, 0.0), Region(0.7, 0.0), r"the goal \(0\.7, 0\) lies 0\.20 m"),
        (Region(-2.0, 0.0, 1.3), Region(2.0, 0.0), r"the start .* needs 1\.55 m"),
        (Region(-2.0, 0.0), Region(2.0, 0.0, 1.3), r"the goal .* needs 1\.55 m"),
    ],
)
def test_given_worlds_whose_ends_are_not_free_are_refused(
    start: Region, goal: Region, message: str, path: Any
) -> None:
    world = World(PILLAR, start=start, goal=goal, path=path, name="mine")
    with pytest.raises(WorldError, match=f"^mine: {message}"):
        Pool.of(world)[0]


def test_the_footprint_decides_whether_a_given_world_can_be_used() -> None:
    gap = World(
        segments=np.array([[0.0, 0.3, 0.0, 5.0], [0.0, -0.3, 0.0, -5.0]]),
        start=Region(-1.0, 1.0),
        goal=Region(1.0, 1.0),
    )
    assert Pool.of(gap, radius=0.2)[0].length < 3.0
    assert Pool.of(gap, radius=0.4)[0].length > 8.0


def test_files(folder: Path) -> None:
    path = folder / "mine.json"
    files.save_world(SOUND, path)
    for source in ("mine.json", str(path), path, Path("mine.json"), "./mine.json"):
        found = Pool.of(source)
        assert (found.kind, len(found)) == (str(source), 1)
        assert (found[0].name, found[0].goal) == ("pillar", SOUND.goal)
        assert found[0].path is not None


def test_folders(folder: Path) -> None:
    (folder / "mine").mkdir()
    for number in (1, 2, 10):
        files.save_world(World(name=f"number {number}"), folder / "mine" / f"world_{number}.yaml")
    for source in ("mine", "mine/", folder / "mine", Path("mine")):
        found = Pool.of(source)
        assert (found.kind, len(found)) == (str(source), 3)
        names = [found[index].name for index in range(3)]
        assert names == ["number 1", "number 2", "number 10"]


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("nowhere.world", r"^nowhere\.world: there is no such file"),
        ("nowhere/mine.json", r"^nowhere/mine\.json: there is no such file"),
        (Path("nowhere.json"), r"^nowhere\.json: there is no such file"),
        ("nowhere/", "^nowhere: a world is read from"),
        (Path("clutter"), "^clutter: a world is read from"),
        ("mine.txt", r"^mine\.txt: a world is read from"),
        ("empty", r"^empty: holds no worlds"),
        (Path("empty"), r"^empty: holds no worlds"),
    ],
    ids=str,
)
def test_bad_paths_are_refused_at_once(source: Any, message: str, folder: Path) -> None:
    (folder / "empty").mkdir()
    with pytest.raises(WorldError, match=message):
        Pool.of(source)


def test_a_broken_file_is_refused_at_once(folder: Path) -> None:
    (folder / "bad.json").write_text("{", encoding="utf-8")
    with pytest.raises(WorldError, match=r"bad\.json: not valid JSON"):
        Pool.of("bad.json")
    with pytest.raises(WorldError, match=r"bad\.json: not valid JSON"):
        Pool.of(folder)


def test_an_unsolvable_file_is_named(folder: Path) -> None:
    files.save_world(CELL, folder / "cell.yaml")
    with pytest.raises(WorldError, match=r"^cell: no way from start to goal"):
        Pool.of("cell.yaml")[0]
