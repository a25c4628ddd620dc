"""Compilation by numba: functions that Python calls, and functions that only compiled code calls.

Compiled code of this package is kept in one folder, whose name contains the version and a hash of
the sources: numba itself notices a change of the file that contains a function, but not of the
files whose functions are compiled into it. Compiled code of users' modules is in the same folder.
"""

from __future__ import annotations

import contextlib
import logging
import os
import shutil
import threading
from collections import namedtuple
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, ParamSpec, Protocol, TypeVar, get_type_hints

import numba
import numba.extending
import numpy as np
from numba.core.caching import FunctionCache

from acsar_gym.resources import PACKAGE, cache_folder, hash_sources, package_version

P = ParamSpec("P")
R = TypeVar("R")
LOG = logging.getLogger(__name__)
TOOLS = PACKAGE / "tools"
FINGERPRINT = hash_sources(PACKAGE, TOOLS, PACKAGE / "agents")
"""Hash of the sources that environments use. An edit of tools/ compiles none of them again."""
KEPT_FOLDERS = 4
"""Folders of compiled code that are kept, so that changing between branches is fast."""
SLOW_MODULES = ("acsar_gym.vector.kernel.", "acsar_gym.sensors.map.")
"""Modules whose functions take long to compile."""
SLOW_TO_COMPILE = (
    "acsar_gym: compiling for a quarter of a minute, once for each kind of task. "
    "'acsar-gym train --warm-up' does it ahead of time"
)
CANNOT_CACHE = (
    "acsar_gym: compiled code can't be kept, so every process compiles again: "
    "set NUMBA_CACHE_DIR to a folder that can be written and has space"
)
WITHIN: dict[str, Any] = {
    "error_model": "numpy",
    "no_cpython_wrapper": True,
    "no_cfunc_wrapper": True,
}
"""Options of functions that only compiled code calls: code for calls from Python takes most of the
time that compiling a small function takes."""
_NAMING = threading.Lock()  # two threads may make the first batches of a class at once


class Decorator(Protocol):
    """A decorator that keeps the type of a function."""

    def __call__(self, function: Callable[P, R], /) -> Callable[P, R]:
        """Decorate a function."""


jit: Decorator = numba.extending.register_jitable(forceinline=True, **WITHIN)
"""Lets compiled functions call a function, inlined so that loops vectorize. In Python it stays as
it is."""
subroutine: Decorator = numba.extending.register_jitable(**WITHIN)
"""As `jit`, but not inlined: for a long function that is called in several places."""
compilable: Decorator = numba.extending.register_jitable
"""Leaves a function as it is for Python, but lets compiled functions call it as well."""


def overloads(function: Callable[..., Any]) -> Decorator:
    """Return the decorator of numba's replacement for `function` in compiled code."""
    decorator: Decorator
    decorator = numba.extending.overload(function, jit_options={"error_model": "numpy"})
    return decorator


def loop(function: Callable[P, R], *, keep: bool = True) -> Callable[P, R]:
    """Compile a function that Python calls, and all functions that it calls. It releases the GIL.

    Args:
        function: The loop.
        keep: Whether to cache the compiled code on disk.
    """
    compiled: Any = numba.njit(error_model="numpy", nogil=True, no_cfunc_wrapper=True)(function)
    # numba reads its setting as the cache is made, so it is changed for this call only.
    usual = numba.config.CACHE_DIR
    try:
        if keep:
            if function.__module__.startswith("acsar_gym."):
                numba.config.CACHE_DIR = find_folder(function.__module__, usual)
            compiled._cache = _Cache(function)  # noqa: SLF001 - as cache=True does
    except RuntimeError:
        _warn_once(CANNOT_CACHE)
    finally:
        numba.config.CACHE_DIR = usual
    typed: Callable[P, R] = compiled
    return typed


def find_folder(module: str, numba_folder: str) -> str:
    """Find or make the folder for the compiled code of a module.

    Args:
        module: Name of a module of this package.
        numba_folder: Folder that the user has given to numba. May be empty.

    Raises:
        RuntimeError: No folder can be written.
    """
    # Modules of tools/ use the compiled functions of both.
    sources = FINGERPRINT[:16]
    if module.startswith("acsar_gym.tools."):
        sources += hash_sources(TOOLS)[:16]
    for parent in (numba_folder, PACKAGE / "__pycache__", cache_folder("compiled")):
        folder = Path(parent or os.devnull, f"acsar_gym-{package_version()}-{sources}")
        if not folder.exists():
            with contextlib.suppress(OSError):
                folder.mkdir(parents=True, exist_ok=True)
                _delete_outdated(folder.parent)
        if os.access(folder, os.W_OK):
            return str(folder)
    raise RuntimeError("no folder for compiled code")


def _delete_outdated(parent: Path) -> None:
    """Delete all but the newest folders of compiled code."""
    folders = sorted(parent.glob("acsar_gym-*-*"), key=lambda folder: folder.stat().st_mtime)
    # Another process may use or delete them at the same time.
    for folder in folders[:-KEPT_FOLDERS]:
        shutil.rmtree(folder, ignore_errors=True)


class _Cache(FunctionCache):  # type: ignore[misc]
    """numba's cache on disk, which never stops a program."""

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Load compiled code. None if there is none, or a power failure has damaged it."""
        try:
            loaded = super().load_overload(sig, target_context)
        except Exception:  # noqa: BLE001 - unpickling a damaged file raises anything
            loaded = None
            with contextlib.suppress(OSError):
                self.flush()
        # Nothing was kept: what follows takes long, and users should know why.
        if loaded is None and self._py_func.__module__.startswith(SLOW_MODULES):
            _warn_once(SLOW_TO_COMPILE)
        return loaded

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep compiled code, unless the disk is full or write-protected."""
        try:
            super().save_overload(sig, data)
        except OSError:
            _warn_once(CANNOT_CACHE)


@cache
def _warn_once(message: str) -> None:
    LOG.warning(message)


def named_tuple(kind: Any, name: str, fields: tuple[str, ...]) -> Any:
    """Make a class of named tuples as an attribute of a class, so that numba's cache finds it."""
    with _NAMING:
        # A subclass may have other fields than its base class, so only the class's own attribute
        # counts.
        made: Any = vars(kind).get(name)
        if made is None or made._fields != fields:
            make: Any = namedtuple  # its fields are known only at run time
            made = make(name, fields)
            made.__module__ = kind.__module__
            made.__qualname__ = f"{kind.__qualname__}.{name}"
            setattr(kind, name, made)
        return made


def record_of(values: Any) -> Any:
    """Make a record, an array of one item, of a named tuple of numbers and of such tuples.

    Compiled functions read and write `record[0].name`. Passing a record to them takes a fifth of
    the time of a named tuple.
    """
    kind: Any = type(values)
    return np.array([values], _record_type(kind))


@cache
def _record_type(kind: Any) -> np.dtype[Any]:
    """Return the record type with the fields of a named tuple's class."""
    fields = [
        (name, hint if hint in (bool, int, float) else _record_type(hint))
        for name, hint in get_type_hints(kind).items()
    ]
    return np.dtype(fields, align=True)
