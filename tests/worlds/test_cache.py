"""Worlds kept on disk: the same to the bit, never old ones, and no harm from what lies there."""

from __future__ import annotations

import os
from collections.abc import Callable
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import pytest

from acsar_gym.worlds import World, cache, generators
from acsar_gym.worlds.pool import Pool

KINDS = "open", "clutter", "rooms", "barn", "smooth_path", "waypoint_path"
RADIUS = 0.25


@pytest.fixture(autouse=True)
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of this test's worlds."""
    monkeypatch.setenv(cache.CACHE_VARIABLE, str(tmp_path))
    cache.read_file_worlds.cache_clear()
    return tmp_path / "worlds"


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The numbers of worlds that were generated."""
    numbers: list[int] = []
    generate = generators.generate_world

    def counting(kind: str, number: int, *rest: Any) -> World:
        numbers.append(number)
        return generate(kind, number, *rest)

    monkeypatch.setattr(generators, "generate_world", counting)
    return numbers


def everything(world: World) -> tuple[object, ...]:
    """All of a world, bytes and types included."""
    assert world.path is not None
    arrays = world.circles, world.segments, world.path
    shapes = [(a.tobytes(), a.shape, a.dtype, a.flags.writeable, a.strides) for a in arrays]
    return (*shapes, repr(world.start), repr(world.goal), world.name, world.length.hex())


def kept(source: str, difficulty: generators.Level = None) -> list[World]:
    with cache.keep_worlds():
        return list(Pool.of(source, difficulty, RADIUS))


@pytest.mark.parametrize("kind", KINDS)
def test_a_kept_world_is_the_generated_one_to_the_bit(kind: str, made: list[int]) -> None:
    first = kept(f"{kind}:98-102")
    assert made == [98, 99, 100, 101, 102]
    again = kept(f"{kind}:98-103")
    assert made == [98, 99, 100, 101, 102, 103]
    assert [everything(world) for world in again[:5]] == [everything(world) for world in first]


def test_worlds_are_written_where_asked_and_found_anywhere(place: Path, made: list[int]) -> None:
    list(Pool.of("open:4", None, RADIUS))
    assert not place.exists()
    kept("open:4")
    assert len(list(place.iterdir())) == 1
    assert Pool.of("open:4", None, RADIUS)[3].name == "open 3"
    assert made == [0, 1, 2, 3] * 2


def test_what_is_made_before_an_interrupt_is_kept(made: list[int]) -> None:
    with pytest.raises(KeyboardInterrupt), cache.keep_worlds():
        for number in range(3):
            cache.cached_world("open", number, None, RADIUS)
        raise KeyboardInterrupt
    kept("open:4")
    assert made == [0, 1, 2, 3]


@pytest.mark.parametrize(
    "other",
    [("barn", None, 0.2), ("open", 0.5, 0.2), ("open", (0.2, 0.5), 0.2), ("open", None, 0.21)],
)
def test_another_kind_difficulty_or_footprint_is_another_file(other: Any) -> None:
    kind, difficulty, radius = other
    assert cache.cache_file("open", 0, None, 0.2) != cache.cache_file(kind, 0, difficulty, radius)


def test_a_changed_generator_never_finds_old_worlds(
    monkeypatch: pytest.MonkeyPatch, made: list[int], tmp_path: Path
) -> None:
    kept("open:2")
    (tmp_path / "package").mkdir()
    for source in Path(cache.__file__).parent.glob("*.py"):
        changed = source.read_bytes() + (b"# changed\n" if source.name == "world.py" else b"")
        (tmp_path / "package" / source.name).write_bytes(changed)
    monkeypatch.setattr(cache, "__file__", str(tmp_path / "package" / "cache.py"))
    cache.hash_generators.cache_clear()
    kept("open:2")
    cache.hash_generators.cache_clear()
    assert made == [0, 1, 0, 1]


def put_pipe(file: Path) -> None:
    file.unlink()
    os.mkfifo(file)


def put_folder(file: Path) -> None:
    file.unlink()
    file.mkdir()


BROKEN: dict[str, Callable[[Path], object]] = {
    "empty": lambda file: file.write_bytes(b""),
    "cut short": lambda file: file.write_bytes(file.read_bytes()[:-8]),
    "one bit": lambda file: file.write_bytes(file.read_bytes()[:-1] + b"\x01"),
    "nonsense": lambda file: file.write_bytes(os.urandom(500)),
    "a pipe": put_pipe,
    "a folder": put_folder,
    "too large": lambda file: os.truncate(file, cache.MAX_CACHE_FILE + 1),
}


@pytest.mark.parametrize("how", BROKEN)
def test_a_broken_file_is_made_anew(how: str, place: Path, made: list[int]) -> None:
    before = kept("open:2")
    (file,) = place.iterdir()
    BROKEN[how](file)
    after = kept("open:2")
    assert [everything(world) for world in after] == [everything(world) for world in before]
    assert made == [0, 1, 0, 1]
    kept("open:2")
    assert len(made) == (6 if how in ("a folder", "a pipe") else 4)  # nothing can be written there
    assert [each.name for each in place.iterdir()] == [file.name]


@pytest.mark.parametrize("asked", ["off", "", "0", "/dev/null/folder", "/proc/nowhere"])
def test_where_nothing_can_be_kept_worlds_are_made(
    asked: str, made: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(cache.CACHE_VARIABLE, asked)
    kept("open:2")
    kept("open:2")
    assert made == [0, 1, 0, 1]


def test_the_folder_is_the_users_cache(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv(cache.CACHE_VARIABLE)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache.cache_folder() == tmp_path / "acsar_gym" / "worlds"


def test_the_files_used_least_recently_go_first(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for number in range(3):
        kept(f"open:{100 * number}-{100 * number}")
    files = sorted(place.iterdir(), key=lambda file: file.name)
    for age, file in enumerate(reversed(files)):
        os.utime(file, (1e9 - age, 1e9 - age))
    monkeypatch.setattr(cache, "MAX_CACHE", int(3.5 * files[0].stat().st_size))
    cache.read_file_worlds.cache_clear()
    kept("open:0-0")  # used just now
    kept("open:300-300")
    left = {int(file.stem.rpartition("-")[2]) for file in place.iterdir()}
    assert left == {0, 2, 3}


def keep_some(first: int) -> None:
    for number in range(first, 40, 4):
        kept(f"open:{number}-{number}")


def test_several_processes_write_at_once(place: Path, made: list[int]) -> None:
    context = get_context("fork")
    processes = [context.Process(target=keep_some, args=(first,)) for first in range(4)]
    for process in processes:
        process.start()
    for process in processes:
        process.join(60.0)
    assert [process.exitcode for process in processes] == [0] * 4
    assert [file.suffix for file in place.iterdir()] == [".worlds"]
    assert len(kept("open:40")) == 40  # whichever were there can be read
    assert len(made) < 40
