"""Generated worlds kept on disk: a batch needs hundreds of them, which take seconds to make.

A file has up to 100 consecutive worlds of one kind, difficulty and footprint. Its name has a hash
of these and of the generator's source, so a changed generator never finds old worlds. A file that
is broken, can't be read or can't be written counts as missing: the worlds are made again.

The files are in the user's cache folder, or in the folder of ACSAR_GYM_CACHE; "off" keeps none.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import platform
import sys
from collections.abc import Iterator, Mapping
from contextvars import ContextVar
from dataclasses import astuple
from functools import cache, lru_cache
from importlib.metadata import version
from pathlib import Path
from typing import SupportsFloat

import numpy as np

from acsar_gym import reading
from acsar_gym.errors import AcsarError, ConfigError
from acsar_gym.worlds import generators, registry
from acsar_gym.worlds.world import Region, World

CACHE_VARIABLE = "ACSAR_GYM_CACHE"
WORLDS_PER_FILE = 100
MAX_CACHE_FILE = 32 * 2**20
"""A larger file is neither read nor written [bytes]."""
MAX_CACHE = 200 * 2**20
"""Limit of all files together; those used least recently are deleted first [bytes]."""

_new: ContextVar[dict[Path, dict[int, World]] | None] = ContextVar("new worlds", default=None)


def cache_folder() -> Path | None:
    """The folder of the files; None where no worlds are kept."""
    asked = os.environ.get(CACHE_VARIABLE)
    if asked is not None:
        return None if asked.lower() in ("", "0", "off") else Path(asked) / "worlds"
    base = os.environ.get("LOCALAPPDATA" if os.name == "nt" else "XDG_CACHE_HOME")
    try:
        return (Path(base) if base else Path.home() / ".cache") / "acsar_gym" / "worlds"
    except RuntimeError:  # a user without a home
        return None


def cached_world(kind: str, number: int, difficulty: generators.Level, radius: float) -> World:
    """Make a world as `generators.generate_world`, or read it from its file.

    Args:
        kind: of the world.
        number: of the world.
        difficulty: one, a range, or None.
        radius: of the disc around the footprint [m].

    Raises:
        WorldError: as `generators.generate_world`.
    """
    file = cache_file(kind, number, difficulty, radius)
    if file is not None and number in read_file_worlds(file):
        return read_file_worlds(file)[number]
    world = generators.generate_world(kind, number, difficulty, radius)
    new = _new.get()
    if file is not None and new is not None:
        new.setdefault(file, {})[number] = world
    return world


@contextlib.contextmanager
def keep_worlds() -> Iterator[None]:
    """Write the worlds that this thread generates inside the block to their files at its end."""
    new: dict[Path, dict[int, World]] = {}
    token = _new.set(new)
    try:
        yield
    finally:
        _new.reset(token)
        if new:
            read_file_worlds.cache_clear()  # other processes may have written more
            for file, worlds in new.items():
                _write_worlds(file, {**read_file_worlds(file), **worlds})
            read_file_worlds.cache_clear()
            _prune()


def cache_file(kind: str, number: int, difficulty: generators.Level, radius: float) -> Path | None:
    """The file of a world; None where it isn't kept."""
    folder, source = cache_folder(), hash_source(kind)
    sound = isinstance(number, int | np.integer) and isinstance(radius, SupportsFloat)
    if folder is None or not (source and sound):
        return None
    fixed, limits = isinstance(difficulty, SupportsFloat), generators.difficulty_limits(difficulty)
    key = f"{source} {kind} {fixed} {limits} {float(radius)!r}"
    name = hashlib.sha256(key.encode()).hexdigest()[:24]
    return folder / f"{kind}-{name}-{number // WORLDS_PER_FILE}.worlds"


def hash_source(kind: str) -> str:
    """Hash of everything that the worlds of a kind depend on; empty where that can't be known."""
    own = registry.find_own(kind)
    if own is None:
        return hash_generators()
    return f"{hash_generators()} {own.source}" if hash_generators() and own.source else ""


@cache
def hash_generators() -> str:
    """Hash of the generators' source, and of the versions and machine that worlds depend on.

    Empty where the source can't be read.
    """
    digest = hashlib.sha256()
    try:
        for source in sorted(Path(__file__).parent.glob("*.py")):
            digest.update(source.read_bytes())
        versions = (sys.version_info[:2], version("numpy"), version("scipy"))
    except (OSError, ModuleNotFoundError):  # PackageNotFoundError is one
        return ""
    digest.update(repr((versions, platform.machine(), platform.system())).encode())
    return digest.hexdigest()


@lru_cache(maxsize=16)
def read_file_worlds(file: Path) -> Mapping[int, World]:
    """The worlds of a file by their numbers; none where it is broken or missing."""
    kind, found = file.name.partition("-")[0], {}
    try:
        for number, parts in json.loads(reading.read_content(file, MAX_CACHE_FILE)).items():
            circles, segments, start, goal, path = parts
            ends = Region(*start), Region(*goal)
            found[int(number)] = World(circles, segments, *ends, path, f"{kind} {number}")
        os.utime(file)  # notes that it was used
    except (AcsarError, ValueError, TypeError, AttributeError, RecursionError):
        return {}
    except OSError:  # it can be read, but isn't ours
        pass
    return found


def _write_worlds(file: Path, worlds: Mapping[int, World]) -> None:
    """Replace a file; nothing where that can't be done."""

    def list_region(region: Region) -> list[float | None]:
        return [None if value is None else float(value) for value in astuple(region)]

    data = json.dumps(
        {
            int(number): [
                world.circles.tolist(),
                world.segments.tolist(),
                list_region(world.start),
                list_region(world.goal),
                None if world.path is None else world.path.tolist(),
            ]
            for number, world in worlds.items()
        }
    ).encode()
    if len(data) > MAX_CACHE_FILE:
        return
    with contextlib.suppress(OSError, ConfigError):
        file.parent.mkdir(parents=True, exist_ok=True)
        reading.write_atomically(file, data)


def _prune() -> None:
    """Delete the files used least recently, until the rest is within the limit."""
    folder, total = cache_folder(), 0
    with contextlib.suppress(OSError):
        files = [(file.stat(), file) for file in (folder.glob("*.worlds") if folder else ())]
        for status, file in sorted(files, key=lambda pair: -pair[0].st_mtime):
            total += status.st_size
            if total > MAX_CACHE:
                file.unlink(missing_ok=True)
