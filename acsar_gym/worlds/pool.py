"""The worlds of an environment: numbered, and made or read when they are needed."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

from acsar_gym.errors import WorldError
from acsar_gym.worlds import files, generators
from acsar_gym.worlds.search import check_region, shortest_path
from acsar_gym.worlds.world import World

MOST = 10**9
KEPT = 512
"""Generated worlds that a pool remembers."""
_KINDS = re.compile(r"([a-z_]+)(?::(\d+)(?:-(\d+))?)?")

Source = str | Path | World | Sequence[World]
"""What users may pass as `worlds=`."""


class Pool:
    """Worlds by index, 0 to len - 1. `kind` is the generator's name, or where they come from."""

    def __init__(
        self, kind: str, count: int, make: Callable[[int], World], radius: float = 0.25
    ) -> None:
        self.kind = kind
        self.radius = radius
        self._count = count
        self._made_by = make
        self._make = lru_cache(KEPT)(make)

    @classmethod
    def of(
        cls, source: Source, difficulty: float | None = None, radius: float = 0.25, count: int = 200
    ) -> Pool:
        """From a generator's name, a file, a folder, a World, or several.

        "clutter" means the first `count` worlds of that kind, "clutter:50" the first 50 and
        "clutter:100-149" those with these numbers. Raises WorldError for anything else.
        """
        worlds = _given(source)
        if worlds is not None:
            name = str(source) if isinstance(source, str | Path) else "given"
            ready = [checked(world, radius) for world in worlds]
            return cls(name, len(ready), ready.__getitem__, radius)
        kind, first, number = _numbers(str(source), count)
        generators.check(kind, difficulty)
        make = partial(_generated, kind, first, difficulty, radius)
        return cls(kind, number, make, radius)

    def __reduce__(self) -> tuple[Any, ...]:
        """Copies make their worlds anew."""
        return Pool, (self.kind, self._count, self._made_by, self.radius)

    def __len__(self) -> int:
        return self._count

    def __iter__(self) -> Iterator[World]:
        return (self[index] for index in range(self._count))

    def __getitem__(self, index: int) -> World:
        if not 0 <= index < self._count:
            raise WorldError(f"world {index}: there are only {self._count} ({self.kind}), from 0")
        return self._make(index)


def _generated(kind: str, first: int, difficulty: float | None, radius: float, index: int) -> World:
    return generators.generate(kind, first + index, difficulty, radius)


def checked(world: World, radius: float) -> World:
    """The world with a path, where it had none.

    Raises WorldError where start or goal aren't free for a footprint of this radius [m], or there
    is no way between them.
    """
    if world.path is None:
        return replace(world, path=shortest_path(world, radius))
    for name, region in (("start", world.start), ("goal", world.goal)):
        check_region(world, name, region, radius)
    return world


def _given(source: Any) -> list[World] | None:
    """Worlds that exist already; None for the name of a generator."""
    if isinstance(source, World):
        return [source]
    if isinstance(source, str | Path):
        return _read(source)
    worlds = list(source) if isinstance(source, Sequence) else []
    if not worlds or not all(isinstance(world, World) for world in worlds):
        raise WorldError(
            f"worlds = {source!r}: must be a file, a folder, a list of World, or a kind of world "
            f"({', '.join(generators.kinds())})"
        )
    return worlds


def _read(source: str | Path) -> list[World] | None:
    """Worlds of a file or a folder; None for the name of a generator."""
    if isinstance(source, str):
        kind = _KINDS.fullmatch(source)
        if not source or (kind and kind[1] in generators.kinds()):
            return None
    path = Path(source)
    named = isinstance(source, Path) or path.suffix != "" or "/" in source
    try:
        if path.is_dir():
            return files.load_folder(path)
        return [files.load(path)] if named or path.exists() else None
    except (OSError, ValueError) as error:
        raise WorldError(f"worlds = {str(source)[:60]!r}: can't be read: {error}") from None


def _numbers(text: str, count: int) -> tuple[str, int, int]:
    """Kind, first number, and how many."""
    match = _KINDS.fullmatch(text)
    if match is None:
        raise WorldError(f"worlds = {text!r}: must be like 'clutter', 'clutter:50' or a path")
    kind, one, other = match.groups()
    if other is not None:
        first, number = int(one), int(other) - int(one) + 1
    else:
        first, number = 0, count if one is None else int(one)
    if number < 1:
        raise WorldError(f"worlds = {text!r}: holds no world")
    if number > MOST:
        raise WorldError(f"worlds = {text[:60]!r}: must hold at most {MOST:,} worlds")
    return kind, first, number
