"""Pools of worlds that exist already: given ones, files and folders."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from acsar_gym.errors import WorldError
from acsar_gym.worlds import files
from acsar_gym.worlds.pool import Pool, check_world
from acsar_gym.worlds.world import Region, World, make_rectangle

PILLAR = np.array([[0.0, 0.0, 0.5]])
SOUND = World(PILLAR, start=Region(-2.0, 0.0), goal=Region(2.0, 0.0), name="pillar")
CELL = World(
    segments=make_rectangle(-1.0, -1.0, 1.0, 1.0),
    start=Region(0.0, 0.0),
    goal=Region(4.0, 0.0),
    name="cell",
)
WAY = np.array([[-2.0, 0.0], [0.0, 1.0], [2.0, 0.0]])


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty working directory, so that no name here is that of a file."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_a_pool_can_be_walked_through() -> None:
    try:
        names = [world.name for world in Pool.of("open:3")]
    except WorldError as error:
        pytest.fail(str(error))
    assert names == ["open 0", "open 1", "open 2"]


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


def test_a_file_without_a_suffix_is_refused_as_a_file(folder: Path) -> None:
    (folder / "notes").write_text("no world", encoding="utf-8")
    with pytest.raises(WorldError, match=r"^notes: a world is read from \.world"):
        Pool.of("notes")


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


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_a_folder_that_may_not_be_read_is_refused(folder: Path) -> None:
    (folder / "secret").mkdir(mode=0o000)
    with pytest.raises(WorldError, match="secret"):
        Pool.of("secret")


def test_an_unsolvable_file_is_named(folder: Path) -> None:
    files.save_world(CELL, folder / "cell.yaml")
    with pytest.raises(WorldError, match=r"^cell: no way from start to goal"):
        Pool.of("cell.yaml")[0]
