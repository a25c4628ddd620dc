"""Compile methods of a user's class, a task's or a sensor's, into a loop that calls them.

numba caches the loop beside the class's own file, under the name of the class.
"""

from __future__ import annotations

import hashlib
import re
import sys
from collections.abc import Callable, Collection, Mapping
from types import FunctionType
from typing import Any

import numba
import numpy as np
from numba.core.errors import NumbaError

from acsar_gym.errors import ConfigError
from acsar_gym.jit import FINGERPRINT, WITHIN, named_tuple
from acsar_gym.jit import loop as compile_loop
from acsar_gym.resources import hash_modules

NUMBER = (bool, int, float)
OPTIONS = WITHIN | {"error_model": "python", "boundscheck": True, "forceinline": True}


def numbers_of(instance: Any) -> Any:
    """Make the named tuple that compiled methods get as `self`: the instance's numbers by name.

    These are numbers, arrays, and tuples of numbers, named tuples included.
    """
    numbers: dict[str, Any] = {}
    for name in dir(instance):
        if name.startswith("_"):
            continue
        value = getattr(instance, name)
        items = value if isinstance(value, tuple) and value else (value,)
        is_array = isinstance(value, np.ndarray | np.generic)
        if is_array or all(isinstance(item, NUMBER) for item in items):
            numbers[name] = value
    return named_tuple(type(instance), "Numbers", tuple(numbers))(**numbers)


def bind_methods(kind: type, template: Any, methods: Mapping[str, str]) -> Callable[..., None]:
    """Make a copy of a loop that calls the methods of one class, compiled at the first call."""
    bound = {name: numba.njit(**OPTIONS)(getattr(kind, method)) for name, method in methods.items()}
    # numba keeps compiled code next to the file that a function's code names.
    file = getattr(sys.modules[kind.__module__], "__file__", None) or __file__
    code = template.__code__.replace(co_filename=file, co_firstlineno=1)
    copy = FunctionType(code, template.__globals__ | bound, template.__name__)
    name = _name_in_cache(kind, methods.values())
    copy.__module__ = kind.__module__
    copy.__qualname__ = name or kind.__qualname__
    return compile_loop(copy, keep=bool(name))


def _name_in_cache(kind: type, methods: Collection[str]) -> str:
    """Make the name under which numba keeps a compiled loop, with a hash of all its sources.

    numba itself notices only a change of the file that has the class. The name is empty if the loop
    can't be kept: for a class made in a function, or without a known source, as in a notebook.
    """
    modules = {base.__module__ for base in kind.__mro__}
    theirs = [name for name in modules if name.partition(".")[0] not in ("builtins", "acsar_gym")]
    sources = hash_modules(*sorted(theirs)) if theirs else "acsar_gym"
    if not sources or "<locals>" in kind.__qualname__:
        return ""

    # What numba compiles: code, and the values of the names that it uses.
    digest = hashlib.sha256(f"{FINGERPRINT} {sources}".encode())
    for name in methods:
        method = getattr(kind, name)
        code = method.__code__
        values = [method.__globals__.get(used) for used in code.co_names]
        constants = [value for value in values if isinstance(value, (*NUMBER, str, tuple))]
        digest.update(f"{name} {code.co_code!r} {code.co_consts!r} {constants!r}".encode())
    return f"{kind.__qualname__}.{digest.hexdigest()[:16]}"


def name_error(name: str, error: Exception) -> ConfigError:
    """Name the task or sensor whose compiled methods can't be compiled, or raise an error."""
    if not isinstance(error, NumbaError):
        return ConfigError(f"{name}: {type(error).__name__}: {error}, in a compiled method")
    # The innermost function that numba names is the user's.
    functions = re.findall(r"<function ([\w.<>]+) at ", str(error))
    function = f"{functions[-1]}()" if functions else "a method"
    return ConfigError(f"{name}: numba can't compile {function}\n{error}")
