"""Generators of worlds by name: those of this package, and those that users register."""

from __future__ import annotations

import importlib
import inspect
import re
import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from acsar_gym.errors import ConfigError, WorldError, shortened, shown, suggestion
from acsar_gym.worlds import sources
from acsar_gym.worlds.world import World

if TYPE_CHECKING:
    import numpy as np

BUILT_IN = ("open", "clutter", "rooms", "barn", "smooth_path", "waypoint_path")
"""Names of the generators of this package."""
LONGEST = 40
"""Most characters of a name."""
_NAME = re.compile(r"[a-z][a-z0-9_]*")

Maker = Callable[["np.random.Generator", float, float], World]
"""Takes (rng, difficulty, footprint radius [m]), and makes a world that may not be solvable."""


class GeneratorError(WorldError):
    """A generator can't make a world, also if it is called again."""


@dataclass(frozen=True)
class Own:
    """A generator that a user or another package has registered."""

    name: str
    make: Maker
    home: str
    """The module of `make`, which should be the one that registers it."""
    source: str
    """Hash of the source that its worlds depend on; empty where it can't be known."""

    def __str__(self) -> str:
        return f"generator {self.name!r} of {self.home}"

    def world(self, rng: np.random.Generator, difficulty: float, radius: float) -> World:
        """Call the generator once.

        Raises:
            GeneratorError: it raised an error, or returned something else than a World.
            WorldError: this attempt failed; the next one may succeed.
        """
        try:
            made = self.make(rng, difficulty, radius)
        except WorldError:
            raise
        except Exception as error:
            raise GeneratorError(f"{self}: raised {one_line(error)}") from error
        if not isinstance(made, World):
            raise GeneratorError(f"{self}: returned {shown(made)}, must return a World")
        return made


_OWN: dict[str, Own] = {}


def register(name: str, make: Maker) -> None:
    """Add a generator of worlds; then `worlds="name:0-99"` works like "clutter:0-99".

    World `number` of a generator is always the same: its random numbers depend on the name and the
    number only. A world without a `path` gets the shortest one for the footprint. Where there is
    none, or `make` raises WorldError, it is called again, up to 200 times and, where the difficulty
    is a range, each time with a lower one.

    In a process that hasn't imported the module that registers, name the module, as in
    `worlds="mine.module:corridors:0-99"`: on the command line, and in worker processes that are
    spawned and not forked, such as those of `gymnasium.vector.AsyncVectorEnv`.

    Worlds of a batch are kept on disk, with a hash of the source of the module of `make`, of the
    modules that it imports, and of the numbers and strings that are default arguments of `make`. A
    closure or callable object, and a function with other default arguments or whose source can't be
    read, is called anew every time. Where worlds depend on something else, such as a file that is
    read, set ACSAR_GYM_CACHE=off.

    Args:
        name: lower-case letters, digits and underscores, at most 40, beginning with a letter.
        make: called as `make(rng, difficulty, footprint_radius)` with a numpy.random.Generator,
            its only source of random numbers, a difficulty from 0 to 1, and the radius of the disc
            around the robot's footprint [m]; returns a `World`, in m and rad of its own frame.

    Raises:
        ConfigError: for another form of name, one that is taken, or a `make` that can't be called
            with three arguments. The same function of the same module may be registered again.
    """
    if not isinstance(name, str) or not _NAME.fullmatch(name) or len(name) > LONGEST:
        raise ConfigError(
            f"register({shown(name)}): a generator's name must be lower-case letters, digits and "
            f"underscores, at most {LONGEST}, beginning with a letter"
        )
    _check_callable(name, make)
    home, other = _home(make), _OWN.get(name)
    taken = other is not None and (_home(other.make), _called(other.make)) != (home, _called(make))
    if name in BUILT_IN or taken:
        owner = "acsar_gym" if other is None else other.home
        raise ConfigError(f"register({name!r}): {owner} has a generator of this name; use another")
    _OWN[name] = Own(name, make, home, sources.fingerprint(make))


def _check_callable(name: str, make: Any) -> None:
    """ConfigError for something that can't be called with three arguments."""
    try:
        inspect.signature(make).bind(None, 0.0, 0.0)
    except (TypeError, ValueError):
        raise ConfigError(
            f"register({name!r}): make = {shown(make)} must be callable as "
            "make(rng, difficulty, footprint_radius)"
        ) from None


def _home(make: Maker) -> str:
    """Name of the module of a generator."""
    return str(getattr(make, "__module__", None) or type(make).__module__)


def _called(make: Maker) -> str:
    """Name of a generator within its module."""
    return str(getattr(make, "__qualname__", type(make).__qualname__))


def one_line(error: BaseException) -> str:
    """The error of a user's code, on one line."""
    return shortened(" ".join(f"{type(error).__name__}: {error}".split()), 300)


def kinds() -> tuple[str, ...]:
    """Names of all generators, those of this package first."""
    return (*BUILT_IN, *_OWN)


def own(kind: str) -> Own | None:
    """The registered generator of this name, if any."""
    return _OWN.get(kind)


def home(kind: str) -> str:
    """The module that registers a generator; "" for those of this package."""
    return _OWN[kind].home if kind in _OWN else ""


def check(kind: str) -> None:
    """Raise WorldError for a name that no generator has."""
    if kind not in kinds():
        raise WorldError(
            f"unknown kind of world {kind!r}{suggestion(kind, kinds())}; that of another package "
            f"is named with the module that registers it, as in 'mine.module:{kind[:LONGEST]}'"
        )


def imported(module: str, kind: str) -> None:
    """Import the module that registers a generator; nothing for "" and the main program.

    Raises:
        WorldError: the module can't be imported, or registers no such generator.
    """
    if module in ("", "__main__"):
        return
    if "" not in sys.path:
        sys.path.append("")  # modules in the current folder
    try:
        importlib.import_module(module)
    except ImportError as error:
        raise WorldError(
            f"worlds = '{module}:{kind}': can't import {module}: {one_line(error)}; install it, or "
            "name its folder in PYTHONPATH"
        ) from None
    except (Exception, SystemExit) as error:
        raise WorldError(
            f"worlds = '{module}:{kind}': importing {module} raised {one_line(error)}"
        ) from error
    if kind not in _OWN:
        raise WorldError(
            f"worlds = '{module}:{kind}': importing {module} registers no {kind!r}"
            f"{suggestion(kind, kinds())}"
        )
