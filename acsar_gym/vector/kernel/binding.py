"""Compile methods of a user's class, a task's or a sensor's, into a loop that calls them.

numba caches the loop beside the class's own file, under the name of the class.
"""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Callable, Collection, Mapping
from types import FunctionType
from typing import Any

import numpy as np

from acsar_gym.errors import ConfigError
from acsar_gym.jit import COMPILED, WITHIN, named_tuple
from acsar_gym.jit import loop as compiled
from acsar_gym.worlds.registry import hash_modules

if COMPILED:
    import numba


def numbers_of(instance: Any) -> Any:
    """Make the named tuple that compiled methods get as `self`: the instance's numbers by name."""
    single = (bool, int, float)
    found: dict[str, Any] = {}
    for name in dir(instance):
        value = None if name.startswith("_") else getattr(instance, name)
        several = isinstance(value, tuple) and value and all(isinstance(n, single) for n in value)
        if several or isinstance(value, (*single, np.ndarray, np.generic)):
            found[name] = value
    return named_tuple(type(instance), "Numbers", tuple(found))(**found)


def bind_methods(kind: type, template: Any, methods: Mapping[str, str]) -> Callable[..., None]:
    """Make a copy of a loop that calls the methods of one class, compiled.

    Compilation happens at the first call; `explain_error` makes a message of numba's errors.

    Args:
        kind: the class.
        template: the loop, in whose globals there are placeholders for the methods.
        methods: names of the methods by placeholder.
    """
    options = WITHIN | {"error_model": "python", "boundscheck": True, "forceinline": True}
    bound = {name: numba.njit(**options)(getattr(kind, one)) for name, one in methods.items()}
    file = getattr(sys.modules[kind.__module__], "__file__", None) or __file__
    code = template.__code__.replace(co_filename=file, co_firstlineno=1)
    copy = FunctionType(code, template.__globals__ | bound, template.__name__)
    name = _cached_as(kind, methods.values())
    copy.__module__, copy.__qualname__ = kind.__module__, name or kind.__qualname__
    return compiled(copy, keep=bool(name))


def _cached_as(kind: type, methods: Collection[str]) -> str:
    """Make the name under which numba keeps a compiled loop: it holds a hash of all its sources.

    numba itself would only notice a change of the file that has the class. Empty, for not to be
    kept, where a source isn't known, as in a notebook, and for classes made in functions.
    """
    modules = {one.__module__ for one in kind.__mro__}
    own = [name for name in modules if name.partition(".")[0] not in ("builtins", "acsar_gym")]
    sources = hash_modules(*sorted(own)) if own else "acsar_gym"  # whose sources `jit` minds
    if not sources or "<locals>" in kind.__qualname__:
        return ""
    said = hashlib.sha256(sources.encode())
    for name in methods:  # what numba compiles: code, and values of the names that it uses
        method = getattr(kind, name)
        code, known = method.__code__, method.__globals__
        values = [known.get(one) for one in code.co_names]
        used = [value for value in values if isinstance(value, bool | int | float | str | tuple)]
        said.update(f"{name} {code.co_code!r} {code.co_consts!r} {used!r}".encode())
    return f"{kind.__qualname__}.{said.hexdigest()[:16]}"


def explain_error(name: str, error: Exception, rules: str = "") -> ConfigError:
    """Make a ConfigError of one line from numba's error about a class that it can't compile.

    Args:
        name: of the task or sensor.
        error: of numba.
        rules: what compiled methods must keep to.
    """
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    said = "; ".join(lines[:3])[:300]
    return ConfigError(
        f"{name}: numba can't compile it: {said} - {rules}mend it, or set compiled = False"
    )
