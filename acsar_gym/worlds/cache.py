"""Generated worlds kept on disk: a batch needs hundreds of them, which take seconds to make.

They are in a folder whose name has this package's version, hashes of the generators' sources and of
their table of left-out draws, and NumPy's version. It is in the user's cache folder or in the
folder of ACSAR_GYM_CACHE. "off" keeps none. Worlds of users' generators aren't kept.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import pickle
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np

from acsar_gym.resources import cache_folder, hash_sources, package_version
from acsar_gym.worlds import generators, moving, registry
from acsar_gym.worlds.world import World

MAX_CACHE_BYTES = 200 * 2**20
"""Limit of all worlds together. Those that were made first are deleted first."""


def cached_world(kind: str, number: int, difficulty: generators.Level, radius: float) -> World:
    """Make a world as `generators.generate_world`, or read it from disk."""
    folder = None if kind in registry.REGISTERED else cache_folder("worlds")
    if folder is None:
        return generators.generate_world(kind, number, difficulty, radius)

    path = folder / fingerprint() / f"{kind} {number} {difficulty} {radius}.pickle"
    try:
        world: World = pickle.loads(path.read_bytes())  # noqa: S301 - written below
        return replace(world, movers=tuple(map(replace, world.movers)))  # read-only again
    except Exception:  # noqa: BLE001 - unpickling a damaged file raises anything
        world = generators.generate_world(kind, number, difficulty, radius)
    with contextlib.suppress(OSError):  # a folder that is write-protected, or a full disk
        path.parent.mkdir(parents=True, exist_ok=True)
        _prune(folder)
        new = path.with_suffix(f".{os.getpid()}.pickle")
        new.write_bytes(pickle.dumps(world))
        new.replace(path)
    return world


@cache
def fingerprint() -> str:
    """What generated worlds depend on: this package's version and sources, and NumPy's version."""
    sources = hash_sources(Path(__file__).parent)[:16]
    redrawn = hashlib.sha256(moving.REDRAWN.read_bytes()).hexdigest()[:8]
    return f"{package_version()}-{sources}-{redrawn}-numpy-{np.__version__}"


@cache
def _prune(folder: Path) -> None:
    """Delete worlds beyond the limit, once in a process."""
    total = 0
    for path in sorted(folder.glob("*/*.pickle"), key=os.path.getmtime, reverse=True):
        total += path.stat().st_size
        if total > MAX_CACHE_BYTES:
            path.unlink(missing_ok=True)
