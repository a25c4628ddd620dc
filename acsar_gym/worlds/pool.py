"""The worlds of an environment: those of one or several sets, made when they are needed.

In a single set a world is its number: that of its generator, or its place in a file, folder or
list, from 0. Among several sets a world is its name, such as "clutter 17". So a number always means
the same world.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cached_property, lru_cache, partial
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acsar_gym.errors import WorldError, show_value
from acsar_gym.worlds import cache, generators, registry
from acsar_gym.worlds.generators import Level
from acsar_gym.worlds.registry import TRAIN
from acsar_gym.worlds.sdf import LIDAR_HEIGHT
from acsar_gym.worlds.search import check_region, shortest_path
from acsar_gym.worlds.sets import Source, WorldSet, parse_sets
from acsar_gym.worlds.world import World

KEPT_WORLDS = 512  # generated worlds that a pool keeps in memory
MAX_RANKED = 100_000  # largest pool that can be sorted by difficulty

Key = int | str
"""What identifies a world of a pool: its number in a single set, its name among several sets."""


class Pool:
    """Worlds of one or several sets, made or checked for a footprint.

    Attributes:
        sets: The sets.
        radius: Radius of the disc around the footprint [m].
    """

    def __init__(self, sets: Sequence[WorldSet], radius: float = generators.DEFAULT_RADIUS) -> None:
        """Check given worlds. Raises WorldError if a footprint can't cross one.

        Also if worlds of two sets have the same name: only the first would be found by it.
        """
        for first, second in combinations(sets, 2):
            _check_names(first, second)
        self.radius = radius
        self.sets = tuple(
            replace(group, worlds=tuple(check_world(world, radius) for world in group.worlds))
            for group in sets
        )
        # A cache of each pool's own, so that a pool that goes frees its worlds.
        self._make = lru_cache(KEPT_WORLDS)(partial(_make_world, radius))

    @classmethod
    def of(
        cls,
        source: Source,
        difficulty: Level = None,
        radius: float = generators.DEFAULT_RADIUS,
        alone: str = TRAIN,
        height: float = LIDAR_HEIGHT,
    ) -> Pool:
        """Make a pool of all that an env takes as `worlds=`, see `sets.parse_sets`."""
        return cls(parse_sets(source, difficulty, alone, height), radius)

    def __reduce__(self) -> tuple[Any, ...]:
        """Copies and pickles make their worlds again."""
        return Pool, (self.sets, self.radius)

    def __str__(self) -> str:
        """Title of a table, such as "clutter 0 to 199 (test split)"."""
        return " and ".join(map(str, self.sets))

    def __len__(self) -> int:
        return sum(len(group.numbers) for group in self.sets)

    def __iter__(self) -> Iterator[World]:
        return (self._make(group, number) for group in self.sets for number in group.numbers)

    def __getitem__(self, key: Key) -> World:
        # A number means a world of a single set, a name one of several sets.
        title = f"{self.sets[0].kind} {key}" if len(self.sets) == 1 else str(key)
        kind, _, digits = title.rpartition(" ")
        for group in self.sets:
            if group.kind == kind and digits.isdecimal() and int(digits) in group.numbers:
                return self._make(group, int(digits))
        form = "must be of" if len(self.sets) == 1 else "must be a name like 'clutter 17', of"
        raise WorldError(f"world {show_value(key)}: {form} {self}")

    def key(self, place: int) -> Key:
        """Return the number, or among several sets the name, of the world at a place, from 0."""
        if len(self.sets) == 1:
            return self.sets[0].numbers[place]
        for group in self.sets:
            if place < len(group.numbers):
                return f"{group.kind} {group.numbers[place]}"
            place -= len(group.numbers)
        raise IndexError(place)

    @property
    def numbers(self) -> range | None:
        """Numbers of the worlds, or None for several sets, whose worlds have names."""
        return self.sets[0].numbers if len(self.sets) == 1 else None

    @property
    def split(self) -> str:
        """The split that all worlds belong to, such as "test", or empty if there is none."""
        # Worlds of several splits, or of none, belong to no split.
        splits = {group.split for group in self.sets}
        return splits.pop() if len(splits) == 1 else ""

    @property
    def generated(self) -> bool:
        """Whether generators make all of these worlds."""
        return not any(group.worlds for group in self.sets)

    @cached_property
    def moves(self) -> bool:
        """Whether something moves in these worlds. Those of a generator are like its first one."""
        return any(
            self._make(group, number).movers
            for group in self.sets
            for number in (group.numbers if group.worlds else group.numbers[:1])
        )

    @cached_property
    def by_difficulty(self) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Places of the worlds from the easiest to the hardest, and their difficulties."""
        if not self.generated:
            raise WorldError(f"difficulty: only generated worlds have one, not all of {self}")
        # Every number's difficulty has to be drawn.
        if len(self) > MAX_RANKED:
            raise WorldError(
                f"difficulty: {len(self):,} worlds, at most {MAX_RANKED:,} can be ordered"
            )

        # Difficulties are drawn first in each world, so no world has to be made.
        levels = np.array(
            [
                generators.draw_difficulty(group.kind, number, group.difficulty)
                for group in self.sets
                for number in group.numbers
            ]
        )
        order = np.argsort(levels, kind="stable").astype(np.int64)
        return order, levels[order]

    def ranks(self, difficulty: Level) -> range:
        """Range of ranks (see `by_difficulty`) whose difficulty is in a range (low, high)."""
        low, high = generators.difficulty_limits(difficulty)
        _, levels = self.by_difficulty
        first = int(np.searchsorted(levels, low))
        last = int(np.searchsorted(levels, high, "right"))
        if first == last:
            raise WorldError(
                f"difficulty = {show_value(difficulty)}: none of the env's worlds; theirs are "
                f"{levels[0]:.3g} to {levels[-1]:.3g}"
            )
        return range(first, last)


def _check_names(first: WorldSet, second: WorldSet) -> None:
    """Raise WorldError if two sets have different worlds of the same name."""
    number = max(first.numbers[0], second.numbers[0])
    is_shared = number in first.numbers and number in second.numbers
    is_same = first.difficulty == second.difficulty and not (first.worlds or second.worlds)
    if first.kind == second.kind and is_shared and not is_same:
        raise WorldError(
            f"two sets have a world '{first.kind} {number}': must have names or numbers of their "
            "own; a list of nothing but World is one set"
        )


def _make_world(radius: float, group: WorldSet, number: int) -> World:
    """Make a world, also in a process that hasn't imported the generator's module yet."""
    if group.worlds:
        return group.worlds[number]
    registry.import_generator(group.module, group.kind)
    return cache.cached_world(group.kind, number, group.difficulty, radius)


@lru_cache(maxsize=16)
def check_world(world: World, radius: float) -> World:
    """Return a world with a path, the same object for the same world.

    WorldError if start or goal aren't free for the footprint, or there is no path between them.
    """
    if world.path is None:
        return replace(world, path=shortest_path(world, radius))
    check_region(world, "start", world.start, radius)
    check_region(world, "goal", world.goal, radius)
    return world
