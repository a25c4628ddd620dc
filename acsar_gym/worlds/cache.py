"""Generated worlds kept on disk: a batch needs hundreds of them, which take seconds to make.

A file has up to 100 consecutive worlds of one kind, difficulty and footprint. Its name has a hash
of these and of the generator's source, so a changed generator never finds old worlds. A file that
is broken, can't be read or can't be written counts as missing: the worlds are made again.

The files are in the user's cache folder, or in the folder of ACSAR_GYM_CACHE; "off" keeps none.
"""

from __future__ import annotations

import contextlib
import hashlib
import math
import os
import platform
import sys
import tempfile
from collections.abc import Iterator, Mapping
from contextvars import ContextVar
from functools import cache, lru_cache
from importlib.metadata import version
from pathlib import Path
from typing import SupportsFloat

import numpy as np

from acsar_gym import reading
from acsar_gym.errors import ConfigError
from acsar_gym.worlds import generators, registry
from acsar_gym.worlds.world import Floats, Region, World

CACHE_VARIABLE = "ACSAR_GYM_CACHE"
WORLDS_PER_FILE = 100
"""Worlds of a file, at most."""
MAX_CACHE_FILE = 32 * 2**20
"""A larger file is neither read nor written [bytes]."""
MAX_CACHE = 200 * 2**20
"""Limit of all files together; those used least recently are deleted first [bytes]."""
ROW_HEAD = 12
"""Numbers of a world before its obstacles and path: see `_row`."""
_CHECK = hashlib.sha256().digest_size

Worlds = Mapping[int, World]
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
    """Make a world as `generators.generate`, or read it from its file.

    Args:
        kind: of the world.
        number: of the world.
        difficulty: one, a range, or None.
        radius: of the disc around the footprint [m].

    Raises:
        WorldError: as `generators.generate`.
    """
    file = _file(kind, number, difficulty, radius)
    kept = None if file is None else _known(file, kind).get(number)
    if kept is not None:
        return kept
    made = generators.generate_world(kind, number, difficulty, radius)
    new = _new.get()
    if file is not None and new is not None:
        new.setdefault(file, {})[number] = made
    return made


@contextlib.contextmanager
def keep_worlds() -> Iterator[None]:
    """Write the worlds that this thread generates inside the block to their files at its end."""
    new: dict[Path, dict[int, World]] = {}
    token = _new.set(new)
    try:
        yield
    finally:
        _new.reset(token)
        for file, worlds in new.items():
            kind = file.name.partition("-")[0]
            _write(file, {**_read(file, kind), **worlds})
        if new:
            _known.cache_clear()
            _prune()


def _file(kind: str, number: int, difficulty: generators.Level, radius: float) -> Path | None:
    """The file of a world; None where it isn't kept."""
    place, source = cache_folder(), hash_source(kind)
    sound = isinstance(number, int | np.integer) and isinstance(radius, SupportsFloat)
    if place is None or not (source and sound):
        return None
    fixed = isinstance(difficulty, SupportsFloat)
    key = f"{source} {kind} {fixed} {generators.difficulty_limits(difficulty)} {float(radius)!r}"
    name = hashlib.sha256(key.encode()).hexdigest()[:24]
    return place / f"{kind}-{name}-{number // WORLDS_PER_FILE}.worlds"


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
    said = hashlib.sha256()
    try:
        for source in sorted(Path(__file__).parent.glob("*.py")):
            said.update(source.read_bytes())
        versions = (sys.version_info[:2], version("numpy"), version("scipy"))
    except (OSError, ModuleNotFoundError):  # PackageNotFoundError is one
        return ""
    said.update(repr((versions, platform.machine(), platform.system())).encode())
    return said.hexdigest()


def _read(file: Path, kind: str) -> Worlds:
    """The worlds of a file; none where it is broken or missing."""
    try:
        data = reading.read_content(file, MAX_CACHE_FILE)
        if hashlib.sha256(data[_CHECK:]).digest() != data[:_CHECK]:
            return {}
        found = _decoded(np.frombuffer(data[_CHECK:], "<f8"), kind)
    except (ConfigError, ValueError, IndexError, OverflowError):
        return {}
    with contextlib.suppress(OSError):
        os.utime(file)  # notes that it was used
    return found


_known = lru_cache(maxsize=16)(_read)
"""`_read`, kept in memory."""


def _write(file: Path, worlds: Worlds) -> None:
    """Replace the file in one operation, so that nobody reads half of it."""
    body = _encoded(worlds).tobytes()
    if len(body) + _CHECK > MAX_CACHE_FILE:
        return
    with contextlib.suppress(OSError):
        file.parent.mkdir(parents=True, exist_ok=True)
        number, name = tempfile.mkstemp(".part", dir=file.parent)
        try:
            with os.fdopen(number, "wb") as part:
                part.write(hashlib.sha256(body).digest() + body)
            Path(name).replace(file)
        except BaseException:
            Path(name).unlink(missing_ok=True)
            raise


def _prune() -> None:
    """Delete the files used least recently, until the rest is within the limit."""
    place = cache_folder()
    with contextlib.suppress(OSError):
        files = [*place.glob("*.worlds"), *place.glob("*.part")] if place else []
        aged = sorted(((each.stat(), each) for each in files), key=lambda pair: -pair[0].st_mtime)
        total = 0
        for status, each in aged:
            total += status.st_size
            if total > MAX_CACHE:
                each.unlink(missing_ok=True)


def _encoded(worlds: Worlds) -> Floats:
    """Encode worlds: how many, a row for each, then each one's circles, segments and path."""
    rows = [_row(number, world) for number, world in worlds.items()]
    parts = [
        part.ravel()
        for world in worlds.values()
        for part in (world.circles, world.segments, world.path)
        if part is not None
    ]
    return np.concatenate([[len(rows)], np.array(rows).ravel(), *parts]).astype("<f8")


def _row(number: int, world: World) -> list[float]:
    """Numbers of a world: number, three lengths, start and goal."""
    start, goal = world.start, world.goal
    theta = math.nan if start.theta is None else start.theta
    points = -1 if world.path is None else len(world.path)
    return [
        *(number, len(world.circles), len(world.segments), points),
        *(start.x, start.y, start.radius, theta),
        *(goal.x, goal.y, goal.radius, 0.0),
    ]


def _decoded(numbers: Floats, kind: str) -> Worlds:
    """Decode what `_encoded` made.

    Raises ValueError, IndexError, OverflowError or WorldError for anything else.
    """
    count = int(numbers[0])
    rows, at, found = (
        numbers[1 : 1 + ROW_HEAD * count].reshape(count, ROW_HEAD),
        1 + ROW_HEAD * count,
        {},
    )
    for row in rows.tolist():
        parts: list[Floats | None] = []
        for length, width in zip(row[1:4], (3, 4, 2), strict=True):
            end = at + max(int(length), 0) * width
            parts.append(None if length < 0 else numbers[at:end].reshape(int(length), width))
            at = end
        circles, segments, path = parts
        x, y, radius, theta = row[4:8]
        start = Region(x, y, radius, None if math.isnan(theta) else theta)
        found[int(row[0])] = World(
            np.zeros((0, 3)) if circles is None else circles,
            np.zeros((0, 4)) if segments is None else segments,
            start,
            Region(*row[8:11]),
            path,
            f"{kind} {int(row[0])}",
        )
    return found
