"""Compilation by numba where it is installed; plain Python with the same results where it isn't.

Compiled code is cached on disk, beside its source where that can be written. numba recompiles when
a function's own file has changed, but not when another file has changed whose functions were
compiled into it. So this module deletes cached code that is older than any source file of the
package.

A batch's first reset in a new installation compiles for up to a minute. The logger
"acsar_gym.jit" says so before, as a warning: Python prints it to stderr by default.
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
TASKS = "acsar_gym.vector.kernel.task"
"""One of them that is compiled anew, and soon, for every task."""
NEW: list[str] = []
"""Names of functions that this process has compiled because the cache didn't have them."""


def _newest(package: Path) -> int:
    """Time of the last change of any source file of a package [ns]."""
    return max(source.stat().st_mtime_ns for source in package.rglob("*.py"))


FINGERPRINT = f"{_newest(Path(__file__).parent):x}"
"""Time stamp of this package's sources, part of the names of compiled functions that numba
caches beside other packages' files."""


def forget_stale(package: Path) -> list[Path]:
    """Delete the cache indices below `package` that are older than its newest source file.

    Args:
        package: folder of the package.

    Returns:
        The deleted files.
    """
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
    """Whether numba is installed."""

    def jit(function: Callable[P, R]) -> Callable[P, R]:
        """Return the function unchanged: numba isn't installed."""
        return function

    loop = compilable = jit

    def overloads(function: Callable[..., Any]) -> Callable[[Callable[P, R]], Callable[P, R]]:
        """Decorator that changes nothing: numba isn't installed."""
        return lambda other: other

    NumbaError: type[Exception] = type("NumbaError", (Exception,), {})
    """Never raised: numba isn't installed."""

    def leading(numbers: Any, count: int) -> tuple[Any, ...]:
        """The first `count` numbers of an array as a tuple."""
        return tuple(numbers[:count])

else:
    COMPILED = True
    NumbaError = errors.NumbaError
    forget_stale(Path(__file__).parent)
    leading = to_fixed_tuple

    def jit(function: Callable[P, R]) -> Callable[P, R]:
        """Compile a scalar function and inline it into callers, so that loops vectorize."""
        options = {"cache": True, "error_model": "numpy", "nogil": True}
        compiled: Callable[P, R] = numba.njit(forceinline=True, **options)(function)
        return compiled

    def loop(function: Callable[P, R]) -> Callable[P, R]:
        """Compile a function that loops over scalar functions. It releases the GIL."""
        compiled: Callable[P, R] = numba.njit(cache=True, error_model="numpy", nogil=True)(function)
        return compiled

    def compilable(function: Callable[P, R]) -> Callable[P, R]:
        """Leave a function as it is for Python, but let compiled functions call it, too."""
        same: Callable[P, R] = numba.extending.register_jitable(function)
        return same

    def overloads(function: Callable[..., Any]) -> Callable[[Callable[P, R]], Callable[P, R]]:
        """Decorator of numba's replacement for `function` in compiled code."""
        decorator: Callable[[Callable[P, R]], Callable[P, R]]
        decorator = numba.extending.overload(function, jit_options={"error_model": "numpy"})
        return decorator

    class _Announcer(event.Listener):  # type: ignore[misc]
        """Warns once, before loops of batches are compiled."""

        said = False

        def on_start(self, event: Any) -> None:
            """Note a function that is compiled next, because the cache doesn't have it."""
            function = event.data["dispatcher"].py_func
            NEW.append(f"{function.__module__}.{function.__qualname__}")
            if not self.said and (function.__module__ or "").startswith(BATCHES):
                self.said = True
                LOG.warning(
                    "acsar_gym: compiling the loops of batches, about a minute, once after each "
                    "installation; 'acsar-gym warm-up' does it ahead of time"
                )

        def on_end(self, event: Any) -> None:
            """Do nothing; numba calls it after a compilation."""

    announcer = _Announcer()
    event.register("numba:compile", announcer)
