"""Generators of worlds by name, this package's and users', and the numbers of their splits."""

from __future__ import annotations

import importlib
import inspect
import re
from collections.abc import Callable
from typing import NamedTuple

from acsar_gym.errors import ConfigError, WorldError, format_error, show_value, suggest_name
from acsar_gym.reading import find_modules_here
from acsar_gym.worlds.world import Rng, World

BUILT_IN_KINDS = (
    *("open", "clutter", "rooms", "barn", "smooth_path", "waypoint_path"),
    *("crowd", "crowd_reacting", "dynabarn"),
)
"""Names of the generators of this package."""
MAX_GENERATOR_NAME = 40  # most characters of a name
TRAIN = "train"
VALIDATION = "validation"
TEST = "test"
BENCHMARK = "benchmark"
SPLITS = {
    TRAIN: range(1000, 1400),
    VALIDATION: range(900, 964),
    TEST: range(200),
    BENCHMARK: range(100_000, 101_000),
}
"""What may follow a generator's name, as in "clutter:test", and the numbers of these worlds.

Those of the benchmark are far from the numbers that people choose for a training."""
_BARN_TEST = range(300)  # as many as BARN has published
_NAME = re.compile(
    r"(?:(?P<module>[A-Za-z_]\w*(?:\.\w+)*):)??(?P<kind>[a-z][a-z0-9_]*)"
    rf"(?::(?P<numbers>{'|'.join(SPLITS)}|\d{{1,15}}(?:-\d{{1,15}})?))?",
    re.ASCII,
)

Maker = Callable[[Rng, float, float], World]
"""Takes (rng, difficulty, footprint radius [m]), and makes a world that may not be solvable."""


class GeneratorError(WorldError):
    """A generator can't make a world, also if it is called again."""


REGISTERED: dict[str, Maker] = {}
"""The generators of users, by name."""


def register(name: str, make: Maker) -> None:
    """Add a generator of worlds. Then `worlds="name:0-99"` works like "clutter:0-99".

    World `number` of a generator is always the same: its random numbers depend on the name and the
    number only. A world without a `path` gets the shortest path for the footprint. If there is
    none, or `make` raises WorldError, it is called again, up to 200 times and, if the difficulty
    is a range, each time with a lower one.

    In a process that hasn't imported the module that registers, name the module, as in
    `worlds="mine.module:corridors:0-99"`: on the command line, and in worker processes that are
    spawned and not forked, such as those of `gymnasium.vector.AsyncVectorEnv`.

    Args:
        name: Lower-case letters, digits and underscores, at most 40, beginning with a letter.
        make: Called as `make(rng, difficulty, footprint_radius)` with a numpy.random.Generator,
            its only source of random numbers, a difficulty from 0 to 1, and the radius of the disc
            around the robot's footprint [m]. Returns a `World`, in m and rad of its own frame.

    Raises:
        ConfigError: The name has another form or is taken, or `make` can't be called with three
            arguments. A module may register a name again.

    Example:
        >>> from acsar_gym.worlds import World, register
        >>> register("empty_floors", lambda rng, difficulty, footprint_radius: World())
    """
    # The name is part of names like "mine:0-99", so it can't have other characters.
    form = rf"[a-z][a-z0-9_]{{0,{MAX_GENERATOR_NAME - 1}}}"
    if not isinstance(name, str) or not re.fullmatch(form, name):
        raise ConfigError(
            f"register({show_value(name)}): a generator's name must be lower-case letters, digits "
            f"and underscores, at most {MAX_GENERATOR_NAME}, beginning with a letter"
        )
    try:
        inspect.signature(make).bind(None, 0.0, 0.0)
    except (TypeError, ValueError) as error:
        raise ConfigError(
            f"register({name!r}): make = {show_value(make)} must be callable as "
            "make(rng, difficulty, footprint_radius)"
        ) from error

    # A module may be imported again, as notebooks do, but not replace another's generator.
    owner = "acsar_gym" if name in BUILT_IN_KINDS else home_module(name)
    if owner not in ("", make.__module__):
        raise ConfigError(f"register({name!r}): {owner} has a generator of this name; use another")
    REGISTERED[name] = make


def list_kinds() -> tuple[str, ...]:
    """Names of all generators, those of this package first."""
    return (*BUILT_IN_KINDS, *REGISTERED)


def home_module(kind: str) -> str:
    """The module of a generator, which should register it, or "" for those of this package."""
    return str(REGISTERED[kind].__module__) if kind in REGISTERED else ""


def check_registered(kind: str) -> None:
    """Raise WorldError for a name that no generator has."""
    if kind not in list_kinds():
        raise WorldError(
            f"unknown kind of world {kind!r}{suggest_name(kind, list_kinds())}; that of another "
            "package is named with the module that registers it, as in "
            f"'mine.module:{kind[:MAX_GENERATOR_NAME]}'"
        )


def import_generator(module: str, kind: str) -> None:
    """Import the module that registers a generator, unless it is "" or the main program."""
    if module in ("", "__main__"):
        return

    title = f"worlds = '{module}:{kind}'"
    try:
        with find_modules_here():
            importlib.import_module(module)
    except ImportError as error:
        raise WorldError(
            f"{title}: can't import {module}: {format_error(error)}; install it, or name its "
            "folder in PYTHONPATH"
        ) from error
    except (Exception, SystemExit) as error:
        raise WorldError(f"{title}: importing {module} raised {format_error(error)}") from error
    if kind not in REGISTERED:
        raise WorldError(
            f"{title}: importing {module} registers no {kind!r}{suggest_name(kind, list_kinds())}"
        )


class WorldsName(NamedTuple):
    """The parts of a name of generated worlds, such as "mine.module:corridors:0-99"."""

    module: str
    """Module to import first, which registers the generator, or "" for none."""
    kind: str
    """The generator's name."""
    numbers: str
    """A split such as "train", "50" or "50-99", or "" if the name has none."""


def parse_name(text: str) -> WorldsName | None:
    """Split a name into its parts, without importing anything, or None for another form of text."""
    # "barn:tets" has the form of a module and a generator, but is a misspelt split of BARN.
    match = _NAME.fullmatch(text)
    if match is None or match["module"] in BUILT_IN_KINDS:
        return None
    return WorldsName(*match.groups(""))


def parse_known_name(text: str) -> WorldsName | None:
    """Split a name whose generator is known. Imports the module that it names.

    None if the text isn't such a name. Raises WorldError if the module registers no such generator.
    """
    name = parse_name(text)
    if name is None:
        return None
    import_generator(name.module, name.kind)
    return name if name.kind in list_kinds() else None


def split_numbers(kind: str, split: str) -> range:
    """World numbers of a split."""
    return _BARN_TEST if (kind, split) == ("barn", TEST) else SPLITS[split]


def find_split(kind: str, numbers: range) -> str:
    """The split that all of these numbers belong to, or empty if there is none."""
    for split in SPLITS:
        members = split_numbers(kind, split)
        if numbers[0] in members and numbers[-1] in members:
            return split
    return ""
