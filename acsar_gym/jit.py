"""Compilation by numba where it is installed; plain Python with the same results where it isn't.

Compiled code is cached on disk, beside its source where that can be written. numba notices when a
function's own file has changed, but not when a function that was compiled into it has, so all of
the cache that is older than any source file of the package is dropped here.

A batch's first reset in a new installation compiles for up to a minute. The logger
"acsar_gym.jit" says so before, as a warning: Python prints it to stderr unless told otherwise.
"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")
LOG = logging.getLogger(__name__)
BATCHES = "acsar_gym.vector.kernel."
"""Modules whose functions take long to compile."""
NEW: list[str] = []
"""Functions that this process has compiled so far, because the cache didn't have them."""


def _newest(package: Path) -> int:
    """When the newest source file of a package was written [ns]."""
    return max(source.stat().st_mtime_ns for source in package.rglob("*.py"))


FINGERPRINT = f"{_newest(Path(__file__).parent):x}"
"""Of this package's sources: part of the names under which other packages' caches are kept."""


def forget_stale(package: Path) -> list[Path]:
    """Delete the cache indices below `package` that are older than its newest source file."""
    newest = _newest(package)
    stale = []
    for index in package.rglob("*.nbi"):
        with contextlib.suppress(OSError):  # gone meanwhile, or not ours to delete
            if index.stat().st_mtime_ns < newest:
                index.unlink()
                stale.append(index)
    return stale


try:
    import numba
    import numba.extending
    from numba.core import errors, event
    from numba.np.unsafe.ndarray import to_fixed_tuple
except ImportError:
    COMPILED = False
    """Whether numba compiles."""

    def jit(function: Callable[P, R]) -> Callable[P, R]:
        """The function as it is: numba isn't installed."""
        return function

    loop = compilable = jit

    def overloads(function: Callable[..., Any]) -> Callable[[Callable[P, R]], Callable[P, R]]:
        """Changes nothing: numba isn't installed."""
        return lambda other: other

    NumbaError: type[Exception] = type("NumbaError", (Exception,), {})
    """Is never raised: numba isn't installed."""

    def leading(numbers: Any, count: int) -> tuple[Any, ...]:
        """The first numbers of an array as a tuple."""
        return tuple(numbers[:count])

else:
    COMPILED = True
    NumbaError = errors.NumbaError
    forget_stale(Path(__file__).parent)
    leading = to_fixed_tuple

    def jit(function: Callable[P, R]) -> Callable[P, R]:
        """A scalar function, compiled into whatever calls it, so that loops over it vectorise."""
        options = {"cache": True, "error_model": "numpy", "nogil": True}
        compiled: Callable[P, R] = numba.njit(forceinline=True, **options)(function)
        return compiled

    def loop(function: Callable[P, R]) -> Callable[P, R]:
        """A loop over scalar functions, compiled on its own; it runs without the GIL."""
        compiled: Callable[P, R] = numba.njit(cache=True, error_model="numpy", nogil=True)(function)
        return compiled

    def compilable(function: Callable[P, R]) -> Callable[P, R]:
        """A function that Python calls as it is, and that compiled functions may call, too."""
        same: Callable[P, R] = numba.extending.register_jitable(function)
        return same

    def overloads(function: Callable[..., Any]) -> Callable[[Callable[P, R]], Callable[P, R]]:
        """Decorates what says how compiled functions do what `function` does in Python."""
        decorator: Callable[[Callable[P, R]], Callable[P, R]]
        decorator = numba.extending.overload(function, jit_options={"error_model": "numpy"})
        return decorator

    class _Announcer(event.Listener):  # type: ignore[misc]
        """Says once that loops of batches are going to be compiled."""

        said = False

        def on_start(self, event: Any) -> None:
            """The cache doesn't have this function: it is compiled next."""
            function = event.data["dispatcher"].py_func
            NEW.append(f"{function.__module__}.{function.__qualname__}")
            if not self.said and (function.__module__ or "").startswith(BATCHES):
                self.said = True
                LOG.warning(
                    "acsar_gym: compiling the loops of batches, about a minute, once after each "
                    "installation; 'acsar-gym warm-up' does it ahead of time"
                )

        def on_end(self, event: Any) -> None:
            """Nothing is said then."""

    announcer = _Announcer()
    event.register("numba:compile", announcer)
