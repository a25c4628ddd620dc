"""Worlds kept on disk: the same to the bit, never old ones, and no harm from what lies there."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from acsar_gym.resources import CACHE_VARIABLE
from acsar_gym.worlds import World, cache, generators, registry
from acsar_gym.worlds.pool import Pool


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
    arrays: Any = world.circles, world.segments, world.path, *(m.pieces for m in world.movers)
    shapes = [(a.tobytes(), a.shape, a.dtype, a.flags.writeable, a.strides) for a in arrays]
    return (*shapes, repr(world.start), repr(world.goal), world.name, world.length.hex())


@pytest.mark.parametrize("kind", ["open", "rooms", "barn", "crowd"])
def test_cached_worlds_are_the_generated_ones_to_the_bit(kind: str, made: list[int]) -> None:
    first = list(map(describe, Pool.of(f"{kind}:98-100")))
    again = list(map(describe, Pool.of(f"{kind}:98-101")))
    assert made == [98, 99, 100, 101]
    assert again[:3] == first
    assert Pool.of(f"{kind}:98-98", 0.5)[98].name == f"{kind} 98"
    assert made[4:] == [98]


def test_cache_never_has_worlds_of_a_changed_generator(
    monkeypatch: pytest.MonkeyPatch, made: list[int]
) -> None:
    assert Pool.of("open:1")[0]
    monkeypatch.setattr(cache, "fingerprint", lambda: "other sources")
    assert Pool.of("open:1")[0]
    assert made == [0, 0]


def test_cache_has_no_worlds_of_a_users_own_generator(
    monkeypatch: pytest.MonkeyPatch, folder: Path, made: list[int]
) -> None:
    monkeypatch.setattr(registry, "REGISTERED", {})
    registry.register("mine", lambda rng, difficulty, radius: World())
    assert [Pool.of("mine:1")[0].name for _ in range(2)] == ["mine 0"] * 2
    assert made == [0, 0]
    assert not folder.exists()


def test_cache_replaces_a_broken_file(folder: Path, made: list[int]) -> None:
    world = describe(Pool.of("open:1")[0])
    (file,) = folder.rglob("*.pickle")
    file.write_bytes(b"")
    assert describe(Pool.of("open:1")[0]) == describe(Pool.of("open:1")[0]) == world
    assert made == [0, 0]


def test_cache_is_pruned_by_a_process_that_makes_worlds(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert list(Pool.of("open:5"))
    monkeypatch.setattr(cache, "MAX_CACHE_BYTES", 1)
    cache._prune.cache_clear()
    assert Pool.of("open:10-10")[10]
    assert [path.name for path in folder.rglob("*.pickle")] == ["open 10 None 0.25.pickle"]
