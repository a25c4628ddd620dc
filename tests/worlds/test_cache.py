"""Worlds kept on disk: the same to the bit, never old ones, and no harm from what lies there."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from acsar_gym.resources import CACHE_VARIABLE
from acsar_gym.worlds import World, cache, generators, registry
from acsar_gym.worlds.pool import Pool

KINDS = "open", "clutter", "rooms", "barn", "smooth_path", "waypoint_path", "crowd", "clutter+1"
RADIUS = 0.25


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of this test's worlds."""
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path))
    return tmp_path / "worlds"


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The numbers of worlds that were generated."""
    numbers: list[int] = []
    generate = generators.generate_world

    def counting(kind: str, number: int, *options: Any) -> World:
        numbers.append(number)
        return generate(kind, number, *options)

    monkeypatch.setattr(generators, "generate_world", counting)
    return numbers


def describe(world: World) -> tuple[object, ...]:
    """All of a world, bytes and types included."""
    assert world.path is not None
    arrays = world.circles, world.segments, world.path, *(m.pieces for m in world.movers)
    shapes = [(a.tobytes(), a.shape, a.dtype, a.flags.writeable, a.strides) for a in arrays]
    return (*shapes, repr(world.start), repr(world.goal), world.name, world.length.hex())


def read(source: str, difficulty: generators.Level = None, radius: float = RADIUS) -> list[World]:
    return list(Pool.of(source, difficulty, radius))


@pytest.mark.parametrize("kind", KINDS)
def test_a_kept_world_is_the_generated_one_to_the_bit(kind: str, made: list[int]) -> None:
    first = read(f"{kind}:98-102")
    assert made == [98, 99, 100, 101, 102]
    again = read(f"{kind}:98-103")
    assert made == [98, 99, 100, 101, 102, 103]
    assert [describe(world) for world in again[:5]] == [describe(world) for world in first]
    fresh = generators.generate_world(kind, 98, None, RADIUS)
    assert describe(again[0]) == describe(fresh)


def test_a_changed_generator_never_finds_old_worlds(
    monkeypatch: pytest.MonkeyPatch, made: list[int]
) -> None:
    read("open:2")
    monkeypatch.setattr(cache, "hash_source", lambda kind: "other sources")
    read("open:2")
    assert made == [0, 1, 0, 1]


def test_a_users_own_generator_is_called_every_time(
    monkeypatch: pytest.MonkeyPatch, folder: Path
) -> None:
    monkeypatch.setattr(registry, "_OWN", {})
    calls: list[float] = []

    def make(rng: Any, difficulty: float, radius: float) -> World:
        calls.append(radius)
        return World()

    registry.register("mine", make)
    for _ in range(2):
        Pool.of("mine:1", None, RADIUS)[0]
    assert calls == [RADIUS, RADIUS]
    assert not folder.exists()


@pytest.mark.filterwarnings("ignore:Exception while loading results")
@pytest.mark.parametrize("content", [b"", b"nonsense"])
def test_a_broken_file_is_made_anew(content: bytes, folder: Path, made: list[int]) -> None:
    before = read("open:1")
    (file,) = folder.rglob("output.pkl")
    file.write_bytes(content)
    assert list(map(describe, read("open:1"))) == list(map(describe, before))
    read("open:1")
    assert made == [0, 0]


def test_a_process_that_makes_worlds_prunes_first(
    folder: Path, monkeypatch: pytest.MonkeyPatch, made: list[int]
) -> None:
    read("open:5")
    monkeypatch.setattr(cache, "MAX_CACHE_BYTES", 1)
    cache._prune.cache_clear()
    read("open:10-10")
    assert len(list(folder.rglob("output.pkl"))) == 1
