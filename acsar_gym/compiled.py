"""Compilation by numba where it is installed; plain Python with the same results where it isn't.

Compiled code is cached on disk, beside its source where that can be written. numba notices when a
function's own file has changed, but not when a function that was compiled into it has, so all of
the cache that is older than any source file of the package is dropped here.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from pathlib import Path
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")


def forget_stale(package: Path) -> list[Path]:
    """Delete the cache indices below `package` that are older than its newest source file."""
    newest = max(source.stat().st_mtime for source in package.rglob("*.py"))
    stale = []
    for index in package.rglob("*.nbi"):
        with contextlib.suppress(OSError):  # gone meanwhile, or not ours to delete
            if index.stat().st_mtime < newest:
                index.unlink()
                stale.append(index)
    return stale


try:
    import numba
except ImportError:
    COMPILED = False
    """Whether numba compiles."""

    def jit(function: Callable[P, R]) -> Callable[P, R]:
        """The function as it is: numba isn't installed."""
        return function

    loop = jit
else:
    COMPILED = True
    forget_stale(Path(__file__).parent)

    def jit(function: Callable[P, R]) -> Callable[P, R]:
        """A scalar function, compiled into whatever calls it, so that loops over it vectorise."""
        options = {"cache": True, "error_model": "numpy", "nogil": True}
        compiled: Callable[P, R] = numba.njit(forceinline=True, **options)(function)
        return compiled

    def loop(function: Callable[P, R]) -> Callable[P, R]:
        """A loop over scalar functions, compiled on its own; it runs without the GIL."""
        compiled: Callable[P, R] = numba.njit(cache=True, error_model="numpy", nogil=True)(function)
        return compiled
