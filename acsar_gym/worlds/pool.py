"""The worlds of an environment: numbered, and made or read when they are needed.

A generated world has its generator's number everywhere: in info, options, errors and tables. Worlds
of files and lists are numbered from 0.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property, lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acsar_gym.errors import ConfigError, WorldError, explain_error, show_value
from acsar_gym.worlds import cache, files, generators, registry
from acsar_gym.worlds.generators import Level
from acsar_gym.worlds.sdf import LIDAR_HEIGHT
from acsar_gym.worlds.search import check_region, shortest_path
from acsar_gym.worlds.world import World

MAX_NUMBERS = 10**9  # most numbers of a pool
KEPT_WORLDS = 512  # generated worlds that a pool keeps in memory
MAX_RANKED = 100_000  # largest pool that can be sorted by difficulty

Source = str | Path | World | Sequence[World] | Mapping[str, Any]
"""What users may pass as `worlds=`; the fields of a mapping are those of `files.FileSource`."""


class Pool:
    """Worlds by their numbers.

    Attributes: `kind`, the generator's name or where the worlds come from; `numbers`, a range;
    `split`, such as "test" where all of them belong to it, otherwise empty; `difficulty`;
    `radius`, of the footprint that they were made or checked for [m]; `generated`, whether a
    generator makes them; `parts`, the pools that are joined in this one, if any.
    """

    def __init__(
        self,
        kind: str,
        numbers: range,
        make: Callable[[int], World],
        radius: float = 0.25,
        difficulty: Level = None,
        *,
        generated: bool = False,
        parts: tuple[Pool, ...] = (),
    ) -> None:
        self.kind = kind
        self.numbers = numbers
        self.radius = radius
        self.difficulty = difficulty
        self.generated = generated
        self.parts = parts
        splits = {part.split for part in parts}
        if generated and not parts:
            splits = {registry.find_split(kind, numbers)}
        self.split: str = splits.pop() if len(splits) == 1 else ""
        self._made_by = make
        self._make = lru_cache(KEPT_WORLDS)(make)

    @classmethod
    def of(
        cls,
        source: Source,
        difficulty: Level = None,
        radius: float = 0.25,
        count: int | None = None,
        height: float = LIDAR_HEIGHT,
    ) -> Pool:
        """Make a pool from a generator's name, a file, a folder, a World, or a list of World.

        "clutter:train" and "clutter:test" are the worlds of these splits, "clutter:50" the first 50
        and "clutter:100-149" those with these numbers. "clutter" alone is the training split.
        "mine.module:corridors:50" imports the module first, which registers the generator. In
        "clutter+6:test" six people walk in the worlds of "clutter:test".
        "clutter:train,barn:train" are the worlds of both, numbered from 0.
        {"path": "hall.world", "start": (0, 0, 1.57), "goal": (3, 1)} is a file with what it doesn't
        say.

        Args:
            source: of the worlds, as above.
            difficulty: of generated worlds.
            radius: of the disc around the footprint [m].
            count: a generator's name alone is then its first `count` worlds.
            height: of the LiDAR above the floor [m].

        Raises:
            WorldError: for anything else.
        """
        names = source.split(",") if isinstance(source, str) else []
        if len(names) > 1 and all(map(registry.parse_known_name, names)):
            return cls.join([cls.of(name, difficulty, radius, count, height) for name in names])
        kind, worlds = "given", None
        if isinstance(source, str | Path | Mapping):
            kind = str(source.get("path") if isinstance(source, Mapping) else source)
            worlds = read_worlds(source, height)
        else:
            given = [source] if isinstance(source, World) else source
            worlds = list(given) if isinstance(given, Sequence) else []
            if not worlds or not all(isinstance(world, World) for world in worlds):
                raise WorldError(
                    f"worlds = {show_value(source)}: must be a file, a folder, a list of World, or "
                    f"a kind of world ({', '.join(registry.list_kinds())})"
                )
        if worlds is not None:
            ready = [check_world(world, radius) for world in worlds]
            return cls(kind, range(len(ready)), ready.__getitem__, radius)
        name, numbers = _parse_source(str(source), count)
        generators.check_kind(name.kind, difficulty)
        module = name.module or registry.home_module(name.kind)
        make = partial(_make_world, module, name.kind, difficulty, radius)
        return cls(name.kind, numbers, make, radius, difficulty, generated=True)

    @classmethod
    def join(cls, parts: Sequence[Pool]) -> Pool:
        """Make a pool of all worlds of generators' pools, numbered from 0."""
        places = [(part, number) for part in parts for number in part.numbers]
        kind = ",".join(part.kind for part in parts)
        first, numbers = parts[0], range(len(places))
        make = partial(_find_world, places)
        return cls(
            kind, numbers, make, first.radius, first.difficulty, generated=True, parts=(*parts,)
        )

    def __reduce__(self) -> tuple[Any, ...]:
        """Copies and pickles make their worlds again."""
        arguments = (self.kind, self.numbers, self._made_by, self.radius, self.difficulty)
        return partial(Pool, generated=self.generated, parts=self.parts), arguments

    def __str__(self) -> str:
        """Title of a table, such as "clutter 0 to 199 (test split)"."""
        if self.parts:
            return " and ".join(map(str, self.parts))
        split = f" ({self.split} split)" if self.split else ""
        return f"{self.kind} {self.numbers[0]} to {self.numbers[-1]}{split}"

    def __len__(self) -> int:
        return len(self.numbers)

    def __iter__(self) -> Iterator[World]:
        return (self[number] for number in self.numbers)

    def __getitem__(self, number: int) -> World:
        if number not in self.numbers:
            raise WorldError(
                f"world {show_value(number)}: must be {self.numbers[0]} to {self.numbers[-1]} "
                f"({self.kind})"
            )
        return self._make(number)

    def name_split(self, split: str) -> str:
        """Name the worlds of the same generators in another split."""
        return ",".join(f"{part.kind}:{split}" for part in self.parts or (self,))

    @cached_property
    def moves(self) -> bool:
        """Whether something moves in these worlds; generated ones are like their first one."""
        if self.parts:
            return any(part.moves for part in self.parts)
        numbers = self.numbers[:1] if self.generated else self.numbers
        return any(self[number].movers for number in numbers)

    @cached_property
    def by_difficulty(self) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Indices into `numbers` from the easiest to the hardest world, and their difficulties."""
        if not self.generated:
            raise WorldError(f"difficulty: only generated worlds have one, {self.kind!r} hasn't")
        if len(self) > MAX_RANKED:
            raise WorldError(
                f"difficulty: {len(self):,} worlds, at most {MAX_RANKED:,} can be ordered"
            )
        levels = np.array(
            [
                generators.draw_difficulty(pool.kind, number, pool.difficulty)
                for pool in self.parts or (self,)
                for number in pool.numbers
            ]
        )
        order = np.argsort(levels, kind="stable").astype(np.int64)
        return order, levels[order]

    def ranks(self, difficulty: Level) -> range:
        """Range of ranks (see `by_difficulty`) whose difficulty is in a range (low, high)."""
        low, high = generators.difficulty_limits(difficulty)
        _, levels = self.by_difficulty
        first, last = np.searchsorted(levels, low), np.searchsorted(levels, high, "right")
        if first == last:
            raise WorldError(
                f"difficulty = {show_value(difficulty)}: none of the env's worlds; theirs are "
                f"{levels[0]:.3g} to {levels[-1]:.3g}"
            )
        return range(int(first), int(last))


def _find_world(places: Sequence[tuple[Pool, int]], number: int) -> World:
    """The world of a joined pool, from its part."""
    part, own_number = places[number]
    return part[own_number]


def _make_world(module: str, kind: str, difficulty: Level, radius: float, number: int) -> World:
    """Make a world, also in a process that hasn't imported the generator's module yet."""
    registry.import_generator(module, kind)
    return cache.cached_world(kind, number, difficulty, radius)


@lru_cache(maxsize=16)
def check_world(world: World, radius: float) -> World:
    """Return a world with a path, the same object for the same world.

    WorldError where start or goal aren't free for the footprint, or there is no path between them.
    """
    if world.path is None:
        return replace(world, path=shortest_path(world, radius))
    for name, region in (("start", world.start), ("goal", world.goal)):
        check_region(world, name, region, radius)
    return world


def read_worlds(
    source: str | Path | Mapping[str, Any], height: float = LIDAR_HEIGHT
) -> list[World] | None:
    """Read worlds of a file or folder; None for the name of a generator."""
    placement = files.Placement(height=height)
    if isinstance(source, Mapping):
        placement = files.FileSource(**{"height": height, **source})
        source = placement.path
        if registry.parse_known_name(str(source)):
            raise WorldError(
                f"worlds = {show_value(str(source))}: generated worlds have a start and a goal of "
                "their own: leave out --start and --goal"
            )
    if isinstance(source, str) and (not source or registry.parse_known_name(source)):
        return None
    path = Path(source)
    named = isinstance(source, Path) or path.suffix != "" or "/" in source
    try:
        if path.is_dir():
            return files.load_folder(path, placement)
        return [files.load_world(path, placement)] if named or path.exists() else None
    except (OSError, ValueError) as error:
        reason = explain_error(error)
        raise WorldError(f"worlds = {show_value(str(source))}: can't be read: {reason}") from error


def place_worlds(
    worlds: str | None, start: str | None, goal: str | None
) -> str | dict[str, str] | None:
    """Join the name of worlds with what their file doesn't say, for `Pool.of`.

    Places are texts like "X,Y,THETA" [m, rad]. ConfigError where something is given, but no name.
    """
    options = {"start": start, "goal": goal}
    given = {name: value for name, value in options.items() if value is not None}
    if given and worlds is None:
        raise ConfigError(f"--{next(iter(given))} is for a world of a file: name the file, too")
    return {"path": str(worlds), **given} if given else worlds


def _parse_source(text: str, count: int | None) -> tuple[registry.WorldsName, range]:
    """The parts of a generator's name, and the numbers of its worlds."""
    name = registry.parse_name(text)
    if name is None:
        raise WorldError(
            f"worlds = {show_value(text)}: must be like 'clutter:test', 'clutter:50', "
            "'clutter:50-99', 'clutter+6:test' (1 to 99 walkers), several of these with commas "
            "between them, or a path"
        )
    first, _, last = name.numbers.partition("-")
    if last:
        numbers = range(int(first), int(last) + 1)
    elif first.isdigit():
        numbers = range(int(first))
    elif not first and count is not None:
        numbers = range(count)
    else:
        numbers = registry.split_numbers(name.kind, first or registry.TRAIN)
    if not numbers:
        raise WorldError(f"worlds = {text!r}: holds no world")
    if numbers[-1] - numbers[0] >= MAX_NUMBERS:
        raise WorldError(f"worlds = {text[:60]!r}: must hold at most {MAX_NUMBERS:,} worlds")
    return name, numbers
