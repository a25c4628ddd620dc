"""Compilation by numba: functions that Python calls, and those that only compiled code calls.

Compiled code is cached on disk: beside its source, or where numba keeps it otherwise. numba
recompiles when a function's own file has changed, but not when another file has changed whose
functions were compiled into it. So this module stamps cached code with a fingerprint of all source
files of the package; code with another stamp is compiled anew. tools/ doesn't count, as nothing
outside of it imports it; nor does agents/, which a wheel has inside of the package. Functions of
tools/, and of another package, such as a user's task, are stamped with its sources, too.

What takes long is said before by the logger "acsar_gym.jit", as a warning: Python prints it to
stderr by default.
"""

from __future__ import annotations

import hashlib
import inspect
import logging
import pickle
import threading
from collections import namedtuple
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, ParamSpec, TypeVar, get_type_hints

import numba
import numba.extending
import numpy as np
from numba.core import errors, event
from numba.core.caching import IndexDataCacheFile
from numba.np.unsafe.ndarray import to_fixed_tuple

P = ParamSpec("P")
R = TypeVar("R")
LOG = logging.getLogger(__name__)
PACKAGE = Path(__file__).parent
TOOLS = PACKAGE / "tools"  # sources that have a stamp of their own
SLOW_MODULES = {
    "acsar_gym.vector.kernel.": "the loops of batches",
    "acsar_gym.sensors.map.sensor": "the map",
}
"""Modules whose functions take long to compile, and what they are to a user."""
TASK_MODULE = "acsar_gym.vector.kernel.task"
"""One of them that is compiled anew, and soon, for every task."""
NEWLY_COMPILED: list[str] = []
"""Names of functions that this process has compiled because the cache didn't have them."""
GIVEN_WARNINGS: set[str] = set()  # warnings that this process has given: each once
CANNOT_CACHE = (
    "acsar_gym: numba can't keep compiled code, so every process compiles anew: "
    "set NUMBA_CACHE_DIR to a folder that can be written (%s)"
)
SLOW_TO_COMPILE = (
    "acsar_gym: compiling {}, a quarter of a minute, once after each installation; "
    "'acsar-gym warm-up' does it ahead of time"
)
DAMAGED = "acsar_gym: compiled code on disk is damaged, so it is compiled anew (%s)"
WITHIN: dict[str, Any] = {
    "error_model": "numpy",
    "no_cpython_wrapper": True,
    "no_cfunc_wrapper": True,
}
"""Options of what only compiled code calls: code for calls from Python takes most of the time that
compiling a small function takes."""
DIGEST_SIZE = hashlib.sha256().digest_size
NumbaError = errors.NumbaError
leading_numbers = to_fixed_tuple
"""`leading_numbers(array, count)`: its first numbers as a tuple, in compiled code."""
_NAMING = threading.Lock()  # two threads may make the first batches of a class at once


def hash_sources(folder: Path, *without: Path) -> str:
    """Hash of the contents of all source files in a package's folder, but for some folders."""
    digest = hashlib.sha256()
    for source in sorted(folder.rglob("*.py")):
        if not any(source.is_relative_to(other) for other in without):
            content = source.read_bytes()
            digest.update(f"{source.relative_to(folder)} {len(content)}\n".encode() + content)
    return digest.hexdigest()


FINGERPRINT = hash_sources(PACKAGE, TOOLS, PACKAGE / "agents")


@cache
def hash_sources_beside(folder: Path) -> str:
    """Hash of the sources that `FINGERPRINT` leaves out; empty for scripts, and where none are."""
    if folder.is_relative_to(TOOLS):
        return hash_sources(TOOLS)
    is_package = (folder / "__init__.py").is_file() and not folder.is_relative_to(PACKAGE)
    return hash_sources(folder) if is_package else ""


def jit(function: Callable[P, R]) -> Callable[P, R]:
    """Let compiled functions call a function, inlined so that loops vectorize.

    In Python it stays as it is.
    """
    decorator = numba.extending.register_jitable(forceinline=True, **WITHIN)
    same: Callable[P, R] = decorator(function)
    return same


def subroutine(function: Callable[P, R]) -> Callable[P, R]:
    """As `jit`, but not inlined: for what is long, and called in several places."""
    same: Callable[P, R] = numba.extending.register_jitable(**WITHIN)(function)
    return same


def compilable(function: Callable[P, R]) -> Callable[P, R]:
    """Leave a function as it is for Python, but let compiled functions call it, too."""
    same: Callable[P, R] = numba.extending.register_jitable(function)
    return same


def overloads(function: Callable[..., Any]) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Decorator of numba's replacement for `function` in compiled code."""
    decorator: Callable[[Callable[P, R]], Callable[P, R]]
    decorator = numba.extending.overload(function, jit_options={"error_model": "numpy"})
    return decorator


def loop(function: Callable[P, R], *, keep: bool = True) -> Callable[P, R]:
    """Compile a function that Python calls, and all that it calls. It releases the GIL.

    Args:
        function: the loop.
        keep: whether to cache the compiled code on disk.
    """
    options = {"error_model": "numpy", "nogil": True, "no_cfunc_wrapper": True}
    compiled: Any = None
    if keep and not numba.config.DISABLE_JIT:
        try:
            compiled = numba.njit(cache=True, **options)(function)
            cache = compiled._cache  # noqa: SLF001 - numba has no other way
            beside = hash_sources_beside(Path(inspect.getfile(function)).parent)
            cache._cache_file = _CacheFile(cache, FINGERPRINT + beside)  # noqa: SLF001
        except (RuntimeError, AttributeError) as error:
            _warn_once(CANNOT_CACHE, error)
            compiled = None
    plain: Callable[P, R] = compiled or numba.njit(**options)(function)
    return plain


def _warn_once(message: str, *why: object) -> None:
    """Warn, once in this process."""
    if message not in GIVEN_WARNINGS:
        GIVEN_WARNINGS.add(message)
        LOG.warning(message, *why)


class _CacheFile(IndexDataCacheFile):  # type: ignore[misc]
    """Compiled code on disk, stamped, and with a checksum.

    What a power failure has damaged is compiled anew: numba would raise whatever pickle raises, or
    run damaged code. A full disk keeps nothing, and stops nobody.
    """

    def __init__(self, cache: Any, stamp: str) -> None:
        stamps = (cache._cache_file._source_stamp, stamp)  # noqa: SLF001
        super().__init__(cache.cache_path, cache._impl.filename_base, stamps)  # noqa: SLF001

    def load(self, key: Any) -> Any:
        kept = super().load(key)
        return kept[1] if kept and kept[0] == self._source_stamp else None

    def save(self, key: Any, data: Any) -> None:
        try:
            super().save(key, (self._source_stamp, data))
        except OSError as error:
            _warn_once(CANNOT_CACHE, error)

    def _load_index(self) -> Any:
        try:
            return super()._load_index()
        except Exception as error:  # noqa: BLE001 - garbage makes pickle raise anything
            _warn_once(DAMAGED, f"{self._index_path}: {error!r}")
            return {}

    def _load_data(self, name: str) -> Any:
        path = Path(self._data_path(name))
        data = path.read_bytes()
        if hashlib.sha256(data[:-DIGEST_SIZE]).digest() != data[-DIGEST_SIZE:]:
            _warn_once(DAMAGED, path)
            raise FileNotFoundError(path)  # which numba takes for code that isn't there
        return pickle.loads(data)  # noqa: S301 - as numba does; what follows is ignored

    def _dump(self, obj: Any) -> bytes:
        data: bytes = super()._dump(obj)
        return data + hashlib.sha256(data).digest()


class _Announcer(event.Listener):  # type: ignore[misc]
    """Notes what is compiled because the cache doesn't have it; warns of what takes long."""

    depth = 0
    """How many functions are being compiled, each for the one before."""

    def on_start(self, event: Any) -> None:
        function = event.data["dispatcher"].py_func
        module = function.__module__ or ""
        NEWLY_COMPILED.append(f"{module}.{function.__qualname__}")
        slow = [what for begin, what in SLOW_MODULES.items() if module.startswith(begin)]
        if self.depth == 0 and slow and module != TASK_MODULE:
            _warn_once(SLOW_TO_COMPILE.format(slow[0]))
        self.depth += 1

    def on_end(self, event: Any) -> None:
        self.depth -= 1


announcer = _Announcer()
event.register("numba:compile", announcer)


def named_tuple(kind: Any, name: str, fields: tuple[str, ...]) -> Any:
    """Make a class of named tuples as an attribute of another, where numba's cache finds it."""
    with _NAMING:
        made: Any = vars(kind).get(name)
        if made is None or made._fields != fields:
            make: Any = namedtuple  # its fields are known at run time alone
            made = make(name, fields)
            made.__module__, made.__qualname__ = kind.__module__, f"{kind.__qualname__}.{name}"
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
    """Record type with the fields of a named tuple's class."""
    hints: dict[str, Any] = get_type_hints(kind)
    numbers = (bool, int, float)
    fields = [
        (name, hints[name] if hints[name] in numbers else _record_type(hints[name]))
        for name in hints
    ]
    return np.dtype(fields, align=True)
