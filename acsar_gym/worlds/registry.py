"""Generators of worlds by name, and the splits of their worlds.

A name of worlds is like "clutter:test", "clutter:50" or "mine.module:corridors:0-99"; in
"clutter+6:test" six people walk, and all else is as in "clutter:test".
"""

from __future__ import annotations

import ast
import hashlib
import importlib
import importlib.util
import inspect
import re
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from acsar_gym.errors import ConfigError, WorldError, format_error, show_value, suggest_name
from acsar_gym.reading import find_modules_here
from acsar_gym.worlds.world import World

if TYPE_CHECKING:
    import numpy as np

BUILT_IN_KINDS = (
    *("open", "clutter", "rooms", "barn", "smooth_path", "waypoint_path"),
    *("crowd", "crowd_reacting", "dynabarn"),
)
"""Names of the generators of this package."""
MAX_GENERATOR_NAME = 40  # most characters of a name
TRAIN, VALIDATION, TEST, BENCHMARK = "train", "validation", "test", "benchmark"
SPLITS = (TRAIN, VALIDATION, TEST, BENCHMARK)
"""What may follow the name of a kind, as in "clutter:test"."""
_SPLIT_NUMBERS = {
    TRAIN: range(1000, 1400),
    VALIDATION: range(900, 964),
    TEST: range(200),
    BENCHMARK: range(100_000, 101_000),
}
"""Those of the benchmark are far from numbers that anybody would train in by hand."""
_BARN_TEST = range(300)  # as many as BARN has published
_NUMBERS = rf"(?::({'|'.join(SPLITS)}|\d{{1,15}}(?:-\d{{1,15}})?))?"
_WALKERS = r"(?:\+[1-9]\d?)?"
_KIND = re.compile(rf"([a-z_][a-z0-9_]*{_WALKERS}){_NUMBERS}")
_FOREIGN = re.compile(
    rf"((?:[A-Za-z_]\w*)(?:\.\w+)*):([a-z][a-z0-9_]*{_WALKERS}){_NUMBERS}", re.ASCII
)

Maker = Callable[["np.random.Generator", float, float], World]
"""Takes (rng, difficulty, footprint radius [m]), and makes a world that may not be solvable."""


class GeneratorError(WorldError):
    """A generator can't make a world, also if it is called again."""


@dataclass(frozen=True)
class OwnGenerator:
    """A generator that a user or another package has registered."""

    name: str
    make: Maker

    @property
    def home(self) -> str:
        """The module of `make`, which should be the one that registers it."""
        return str(getattr(self.make, "__module__", None) or type(self.make).__module__)

    @property
    def place(self) -> tuple[str, str]:
        """Module and name of `make`."""
        return self.home, str(getattr(self.make, "__qualname__", type(self.make).__qualname__))

    def world(self, rng: np.random.Generator, difficulty: float, radius: float) -> World:
        """Call the generator once; GeneratorError where calling it again is of no use."""
        this = f"generator {self.name!r} of {self.home}"
        try:
            world = self.make(rng, difficulty, radius)
        except WorldError:
            raise
        except Exception as error:
            raise GeneratorError(f"{this}: raised {format_error(error)}") from error
        if not isinstance(world, World):
            raise GeneratorError(f"{this}: returned {show_value(world)}, must return a World")
        return world


_OWN: dict[str, OwnGenerator] = {}


def register(name: str, make: Maker) -> None:
    """Add a generator of worlds; then `worlds="name:0-99"` works like "clutter:0-99".

    World `number` of a generator is always the same: its random numbers depend on the name and the
    number only. A world without a `path` gets the shortest one for the footprint. Where there is
    none, or `make` raises WorldError, it is called again, up to 200 times and, where the difficulty
    is a range, each time with a lower one.

    In a process that hasn't imported the module that registers, name the module, as in
    `worlds="mine.module:corridors:0-99"`: on the command line, and in worker processes that are
    spawned and not forked, such as those of `gymnasium.vector.AsyncVectorEnv`.

    Args:
        name: lower-case letters, digits and underscores, at most 40, beginning with a letter.
        make: called as `make(rng, difficulty, footprint_radius)` with a numpy.random.Generator,
            its only source of random numbers, a difficulty from 0 to 1, and the radius of the disc
            around the robot's footprint [m]; returns a `World`, in m and rad of its own frame.

    Raises:
        ConfigError: for another form of name, one that is taken, or a `make` that can't be called
            with three arguments. The same function of the same module may be registered again.
    """
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
    new, other = OwnGenerator(name, make), _OWN.get(name)
    if name in BUILT_IN_KINDS or (other is not None and other.place != new.place):
        owner = "acsar_gym" if other is None else other.home
        raise ConfigError(f"register({name!r}): {owner} has a generator of this name; use another")
    _OWN[name] = new


def list_kinds() -> tuple[str, ...]:
    """Names of all generators, those of this package first."""
    return (*BUILT_IN_KINDS, *_OWN)


def split_walkers(kind: str) -> tuple[str, int]:
    """Split the name of a kind, like "clutter+6", into the generator's and how many walk there."""
    name, _, count = kind.partition("+")
    return name, int(count or 0)


def find_own(kind: str) -> OwnGenerator | None:
    """The registered generator of this kind, if any."""
    return _OWN.get(split_walkers(kind)[0])


def home_module(kind: str) -> str:
    """The module that registers a generator; "" for those of this package."""
    own_generator = find_own(kind)
    return "" if own_generator is None else own_generator.home


def check_registered(kind: str) -> None:
    """Raise WorldError for a name that no generator has."""
    if split_walkers(kind)[0] not in list_kinds():
        raise WorldError(
            f"unknown kind of world {kind!r}{suggest_name(kind, list_kinds())}; that of another "
            "package is named with the module that registers it, as in "
            f"'mine.module:{kind[:MAX_GENERATOR_NAME]}'"
        )


def import_generator(module: str, kind: str) -> None:
    """Import the module that registers a generator; nothing for "" and the main program."""
    if module in ("", "__main__"):
        return
    where = f"worlds = '{module}:{kind}'"
    try:
        with find_modules_here():
            importlib.import_module(module)
    except ImportError as error:
        raise WorldError(
            f"{where}: can't import {module}: {format_error(error)}; install it, or name its "
            "folder in PYTHONPATH"
        ) from error
    except (Exception, SystemExit) as error:
        raise WorldError(f"{where}: importing {module} raised {format_error(error)}") from error
    if find_own(kind) is None:
        raise WorldError(
            f"{where}: importing {module} registers no {kind!r}{suggest_name(kind, list_kinds())}"
        )


@dataclass(frozen=True, slots=True)
class WorldsName:
    """The parts of a name of generated worlds."""

    module: str
    """Module to import first, which registers the generator; "" for none."""
    kind: str
    """The generator's name, and how many walk there, as in "clutter+6"."""
    numbers: str
    """A split such as "train", "50" or "50-99"; "" where the name has none."""

    @property
    def generator(self) -> str:
        """The name without the numbers."""
        return f"{self.module}:{self.kind}" if self.module else self.kind


def parse_name(text: str) -> WorldsName | None:
    """Split a name into its parts; None for a text of another form. Imports nothing."""
    if match := _KIND.fullmatch(text):
        return WorldsName("", match[1], match[2] or "")
    match = _FOREIGN.fullmatch(text)
    if match is None or match[1] in BUILT_IN_KINDS:
        return None
    return WorldsName(match[1], match[2], match[3] or "")


def parse_known_name(text: str) -> WorldsName | None:
    """Split a name of worlds whose generator is known; imports the module that it names.

    None where the text isn't such a name; WorldError where the module registers no such generator.
    """
    name = parse_name(text)
    if name is None:
        return None
    import_generator(name.module, name.kind)
    return name if split_walkers(name.kind)[0] in list_kinds() else None


def split_numbers(kind: str, split: str) -> range:
    """World numbers of a split."""
    is_barn_test = (split_walkers(kind)[0], split) == ("barn", TEST)
    return _BARN_TEST if is_barn_test else _SPLIT_NUMBERS[split]


def find_split(kind: str, some: range) -> str:
    """The split that all of these numbers belong to; empty where there is none."""
    for name in SPLITS:
        every = split_numbers(kind, name)
        if some[0] in every and some[-1] in every:
            return name
    return ""


def add_test_split(source: Any) -> Any:
    """Replace generators' names without numbers by their test split; anything else stays."""
    if isinstance(source, str) and "," in source:
        return ",".join(map(add_test_split, source.split(",")))
    name = parse_known_name(source) if isinstance(source, str) else None
    return source if name is None or name.numbers else f"{name.generator}:{TEST}"


def hash_modules(*modules: str) -> str:
    """Hash the sources of modules, and of the user's own modules that they import.

    Args:
        *modules: their names.

    Returns:
        The hash; empty where a module has no source file.
    """
    digest = hashlib.sha256()
    try:
        for module in modules:
            for name, content in sorted(_read_sources(module).items()):
                digest.update(f"{name} {len(content)} ".encode() + content)
    except (OSError, SyntaxError, ValueError):
        return ""
    return digest.hexdigest()


def _read_sources(first: str) -> dict[str, bytes]:
    """Contents of a module and of all that it imports, directly or indirectly, by their names.

    Python's own modules and this package's don't count; of installed ones only their version.
    """
    contents: dict[str, bytes] = {}
    waiting = [first]
    while waiting:
        name = waiting.pop()
        file = _source_file(name)
        if file is None and name == first:
            raise OSError(name)
        if file is None or name in contents:
            continue
        installed = {"site-packages", "dist-packages"} & {*file.parts}
        if installed and name.partition(".")[0] != first.partition(".")[0]:
            contents[name] = str(getattr(sys.modules.get(name), "__version__", "")).encode()
            continue
        contents[name] = file.read_bytes()
        package = name if file.name == "__init__.py" else name.rpartition(".")[0]
        imported: list[str] = []
        for node in ast.walk(ast.parse(contents[name])):
            if isinstance(node, ast.Import):
                imported += [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                base = importlib.util.resolve_name("." * node.level + (node.module or ""), package)
                imported += [base, *(f"{base}.{alias.name}" for alias in node.names)]
        ours = {*sys.stdlib_module_names, "acsar_gym"}
        waiting += [module for module in imported if module.partition(".")[0] not in ours]
    return contents


def _source_file(name: str) -> Path | None:
    """The source file of a module; None where there is none."""
    module = sys.modules.get(name)
    try:
        file = module.__file__ if module else getattr(importlib.util.find_spec(name), "origin", "")
    except (ImportError, AttributeError, ValueError):
        return None
    return Path(file) if file and file.endswith(".py") else None
