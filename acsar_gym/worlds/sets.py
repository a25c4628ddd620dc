"""Sets of worlds as values: those of a generator with some numbers, or given worlds.

    WorldSet.parse("clutter:test")          # the 200 worlds of this split
    WorldSet.parse("clutter:50")            # the first 50
    WorldSet.parse("barn:100-149")          # those with these numbers
    WorldSet.parse("mine.module:corridors:50")    # imports the module first, which registers it
    WorldSet.parse("hall.world")            # a file, or a folder

A generator's name alone stands for its training split, also if there is a folder of this name.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, SupportsFloat, Union

from acsar_gym.errors import WorldError, explain_error, show_value
from acsar_gym.worlds import files, generators, registry
from acsar_gym.worlds.generators import Level
from acsar_gym.worlds.registry import TRAIN
from acsar_gym.worlds.sdf import LIDAR_HEIGHT
from acsar_gym.worlds.world import World

MAX_NUMBERS = 10**9  # most worlds of a set

SetSource = Union[str, Path, World, Mapping[str, Any], "WorldSet"]
Source = SetSource | Sequence[SetSource]
"""What users may pass as `worlds=`. The fields of a mapping are those of `files.FileSource`."""


@dataclass(frozen=True)
class WorldSet:
    """Worlds of a generator, or given worlds, which are numbered from 0."""

    generator: str
    """Name of the generator, behind the module that registers it, as in "mine.module:corridors".
    For given worlds their file or folder, or "given"."""
    numbers: range
    """Numbers of the worlds."""
    difficulty: Level = None
    """Difficulty of generated worlds."""
    worlds: tuple[World, ...] = field(default=(), repr=False)
    """Given worlds, or none for those of a generator."""

    @classmethod
    def parse(
        cls,
        source: SetSource,
        difficulty: Level = None,
        alone: str = TRAIN,
        height: float = LIDAR_HEIGHT,
    ) -> WorldSet:
        """Make a set from a generator's name, a file, a folder or a World.

        Args:
            source: Name, path or world. A mapping has a `path`, and what its file doesn't say:
                {"path": "hall.world", "start": (0, 0, 1.57), "goal": (3, 1)}.
            difficulty: Difficulty of generated worlds, 0 to 1. None or a range (low, high) varies
                it.
            alone: Numbers that a generator's name alone stands for, such as "test" or "12".
            height: Height of the LiDAR above the floor [m].

        Raises:
            WorldError: There are no such worlds, or they can't be read.
        """
        if isinstance(source, WorldSet):
            return source
        if isinstance(source, World):
            return cls("given", range(1), worlds=(source,))
        if not isinstance(source, str | Path | Mapping):
            raise WorldError(
                f"worlds = {show_value(source)}: must be a file, a folder, a list of World, or a "
                f"kind of world ({', '.join(registry.list_kinds())})"
            )
        path = str(source.get("path", "") if isinstance(source, Mapping) else source)

        # A generator's name wins over a file or folder of the same name.
        name = None if isinstance(source, Path) else registry.parse_known_name(path)
        if name is None:
            worlds = _read_files(source, height)
            return cls(path, range(len(worlds)), worlds=worlds)
        if isinstance(source, Mapping):
            raise WorldError(
                f"worlds = {show_value(path)}: generated worlds have a start and a goal of their "
                "own: leave out --start and --goal"
            )
        module = name.module or registry.home_module(name.kind)
        generator = f"{module}:{name.kind}" if module else name.kind
        numbers = _parse_numbers(path, name.kind, name.numbers or alone)
        return cls(generator, numbers, _check_difficulty(difficulty))

    def __str__(self) -> str:
        """Title of a table, such as "clutter 0 to 199 (test split)"."""
        split = f" ({self.split} split)" if self.split else ""
        return f"{self.kind} {self.numbers[0]} to {self.numbers[-1]}{split}"

    @property
    def kind(self) -> str:
        """Name of the generator without its module. For given worlds as `generator`."""
        return self.generator if self.worlds else self.generator.rpartition(":")[2]

    @property
    def module(self) -> str:
        """Module that registers the generator, or "" for those of this package."""
        return "" if self.worlds else self.generator.rpartition(":")[0]

    @property
    def split(self) -> str:
        """The split that all worlds belong to, or empty if there is none."""
        return "" if self.worlds else registry.find_split(self.kind, self.numbers)


def parse_sets(
    source: Source, difficulty: Level = None, alone: str = TRAIN, height: float = LIDAR_HEIGHT
) -> list[WorldSet]:
    """Make the sets of a source or of a list of sources, see `WorldSet.parse`.

    A list of World is one set.
    """
    # A list of World is numbered through, other lists are sets next to each other.
    items: list[Any] = list(source) if isinstance(source, list | tuple) else [source]
    if items and all(isinstance(world, World) for world in items):
        return [WorldSet("given", range(len(items)), worlds=tuple(items))]
    return [WorldSet.parse(item, difficulty, alone, height) for item in items or [source]]


def name_alone(source: Any, split: str) -> Any:
    """Add a split to generators' names without numbers, in lists as well. Anything else stays."""
    if isinstance(source, list | tuple):
        return [name_alone(item, split) for item in source]
    name = registry.parse_known_name(source) if isinstance(source, str) else None
    return source if name is None or name.numbers else f"{source}:{split}"


def name_sources(worlds: Sequence[str]) -> str | list[str] | None:
    """Make what an env takes as `worlds=` from an option that may be repeated."""
    return list(worlds) if len(worlds) > 1 else next(iter(worlds), None)


def _parse_numbers(text: str, kind: str, numbers: str) -> range:
    """World numbers of a split, "50" or "50-99". `text` is the whole name."""
    if numbers in registry.SPLITS:
        return registry.split_numbers(kind, numbers)

    # "50" are the first 50, "50-99" those with these numbers.
    first, _, last = numbers.partition("-")
    parsed = range(int(first), int(last) + 1) if last else range(int(first))
    if not 1 <= len(parsed) <= MAX_NUMBERS:
        raise WorldError(f"worlds = {text!r}: must hold 1 to {MAX_NUMBERS:,} worlds")
    return parsed


def _check_difficulty(difficulty: Level) -> Level:
    """A difficulty as plain numbers. Raises WorldError if it isn't from 0 to 1."""
    # Plain floats, so that equal sets are equal, and JSON takes them.
    low, high = generators.difficulty_limits(difficulty)
    if difficulty is None:
        return None
    return low if isinstance(difficulty, SupportsFloat) else (low, high)


def _read_files(source: str | Path | Mapping[str, Any], height: float) -> tuple[World, ...]:
    """Read the worlds of a file or folder."""
    placement = files.Placement(height=height)
    if isinstance(source, Mapping):
        placement = files.FileSource(**{"height": height, **source})
        source = placement.path
    path = Path(source)

    try:
        if isinstance(source, str) and not (source and path.exists()):
            _refuse_name(source)
        is_folder = path.is_dir()
        return tuple(
            files.load_folder(path, placement) if is_folder else [files.load_world(path, placement)]
        )
    except (OSError, ValueError) as error:
        reason = explain_error(error)
        raise WorldError(f"worlds = {show_value(str(source))}: can't be read: {reason}") from error


def _refuse_name(text: str) -> None:
    """Raise WorldError for a text that is neither a name of worlds nor looks like a path."""
    if "," in text:
        raise WorldError(
            f"worlds = {show_value(text)}: names several sets: give a list, or repeat --worlds"
        )
    if Path(text).suffix or "/" in text:
        return
    if name := registry.parse_name(text):
        registry.check_registered(name.kind)
    raise WorldError(
        f"worlds = {show_value(text)}: must be like 'clutter:test', 'clutter:50', "
        "'clutter:50-99', or a path"
    )
