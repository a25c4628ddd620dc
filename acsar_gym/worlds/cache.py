"""Generated worlds kept on disk: a batch needs hundreds of them, which take seconds to make.

They are found again by kind, number, difficulty and footprint as long as this package's generators,
NumPy, scipy and the machine are the same. Those of a user's own generators are made every time.

The files are in the user's cache folder, or in the folder of ACSAR_GYM_CACHE; "off" keeps none.
"""

from __future__ import annotations

import hashlib
import os
import platform
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import SupportsFloat

from acsar_gym.resources import cache_folder, hash_sources
from acsar_gym.worlds import generators, registry
from acsar_gym.worlds.world import World

MAX_CACHE_BYTES = 200 * 2**20
"""Limit of all worlds together; those used least recently are deleted first."""


def cached_world(kind: str, number: int, difficulty: generators.Level, radius: float) -> World:
    """Make a world as `generators.generate_world`, or read it from disk."""
    folder, sources = cache_folder("worlds"), hash_source(kind)
    find_world = _open_cache(folder) if folder is not None and sources else None
    if find_world is None:
        return generators.generate_world(kind, number, difficulty, radius)
    level: generators.Level = generators.difficulty_limits(difficulty)
    if isinstance(difficulty, SupportsFloat):
        level = float(difficulty)
    world: World = find_world(sources, kind, int(number), level, float(radius))
    movers = tuple(map(replace, world.movers))
    return replace(world, movers=movers)  # validated, and read-only again


@cache
def _open_cache(folder: Path) -> Callable[..., World] | None:
    """What finds or makes a world; None where nothing can be kept."""
    try:
        from joblib import Memory  # noqa: PLC0415 - slow to import

        folder.mkdir(parents=True, exist_ok=True)
        find_world: Callable[..., World] = Memory(folder, verbose=0).cache(_make_world)
    except (ImportError, OSError):
        return None
    return find_world if os.access(folder, os.W_OK) else None


def _make_world(
    sources: str, kind: str, number: int, level: generators.Level, radius: float
) -> World:
    """Make a world that isn't on disk; `sources` is a part of what it is found by."""
    _prune(cache_folder("worlds"))
    return generators.generate_world(kind, number, level, radius)


@cache
def _prune(folder: Path | None) -> None:
    """Delete worlds beyond the limit, once in a process."""
    from joblib import Memory  # noqa: PLC0415

    Memory(folder, verbose=0).reduce_size(bytes_limit=MAX_CACHE_BYTES)


def hash_source(kind: str) -> str:
    """Hash of what the worlds of a kind depend on; empty where that can't be known."""
    return "" if registry.find_own(kind) else _hash_generators()


@cache
def _hash_generators() -> str:
    try:
        versions = (sys.version_info[:2], version("numpy"), version("scipy"))
    except ModuleNotFoundError:  # PackageNotFoundError is one
        return ""
    sources = hash_sources(Path(__file__).parent)
    text = repr((sources, versions, platform.machine(), platform.system()))
    return hashlib.sha256(text.encode()).hexdigest()
