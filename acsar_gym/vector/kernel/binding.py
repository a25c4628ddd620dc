"""Compile methods of a user's class, a task's or a sensor's, into a loop that calls them.

numba caches the loop beside the class's own file, under the name of the class.
"""

from __future__ import annotations

import dis
import hashlib
import inspect
import re
import sys
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from types import FunctionType
from typing import Any

import numba
import numpy as np
from numba.core.errors import NumbaError

from acsar_gym.errors import ConfigError
from acsar_gym.jit import FINGERPRINT, WITHIN, named_tuple
from acsar_gym.jit import loop as compiled
from acsar_gym.resources import PACKAGE, hash_modules

OWN_FOLDERS = [PACKAGE, Path(numba.__file__).parent]  # of files that aren't a user's


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
    """
    check_calls(kind, methods.values())
    options = WITHIN | {"error_model": "python", "boundscheck": True, "forceinline": True}
    bound = {name: numba.njit(**options)(getattr(kind, method)) for name, method in methods.items()}
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
    modules = {base.__module__ for base in kind.__mro__}
    theirs = [name for name in modules if name.partition(".")[0] not in ("builtins", "acsar_gym")]
    sources = hash_modules(*sorted(theirs)) if theirs else "acsar_gym"
    if not sources or "<locals>" in kind.__qualname__:
        return ""
    said = hashlib.sha256(f"{FINGERPRINT} {sources}".encode())
    for name in methods:  # what numba compiles: code, and values of the names that it uses
        method = getattr(kind, name)
        code, names = method.__code__, method.__globals__
        values = [names.get(used) for used in code.co_names]
        used = [value for value in values if isinstance(value, bool | int | float | str | tuple)]
        said.update(f"{name} {code.co_code!r} {code.co_consts!r} {used!r}".encode())
    return f"{kind.__qualname__}.{said.hexdigest()[:16]}"


def check_calls(kind: type, methods: Collection[str]) -> None:
    """Check that compiled methods call no others of their object, which numba can't compile."""
    for method in methods:
        function = inspect.unwrap(getattr(kind, method))
        before: Any = None
        for instruction in dis.get_instructions(function):
            called = ""
            if instruction.opname in ("LOAD_GLOBAL", "LOAD_NAME") and instruction.argval == "super":
                called = "super()"
            elif instruction.opname in ("LOAD_ATTR", "LOAD_METHOD") and _loads_self(before):
                is_method = callable(getattr(kind, instruction.argval, None))
                called = f"self.{instruction.argval}()" if is_method else ""
            if called:
                line = instruction.positions.lineno if instruction.positions else None
                place = (
                    f"{function.__code__.co_filename}:{line or function.__code__.co_firstlineno}"
                )
                raise ConfigError(
                    f"{kind.__qualname__}: {method}() calls {called}, which numba can't compile: "
                    "make it a function of the module that acsar_gym.jit.compilable decorates, or "
                    f"set compiled = False ({place})"
                )
            before = instruction


def _loads_self(instruction: Any) -> bool:
    """Whether an instruction has put a method's `self` on the stack, last of all."""
    if instruction is None or not instruction.opname.startswith("LOAD_FAST"):
        return False
    loaded = instruction.argval
    return bool((loaded[-1] if isinstance(loaded, tuple) else loaded) == "self")


def is_compile_error(error: Exception) -> bool:
    """Whether numba raised an error because it can't compile something."""
    kinds = (NumbaError, NotImplementedError, TypeError)
    return isinstance(error, kinds) or type(error).__module__.startswith("numba.")


COLOURS = re.compile(r"\x1b\[[0-9;]*m")
PLACE = re.compile(
    r'(?:\bat|Raised from) (?P<at>/\S.*?) \((\d+)\)|File "(?P<file>.*?)", line (\d+):'
)
"""How numba's messages name a line of a file."""
GENERAL = ("Failed in ", "During: ", "File ", "Raised from ")
"""What lines of numba's messages begin with that don't say what is wrong."""


def explain_error(
    name: str, kind: type, methods: Collection[str], error: Exception, rules: str = ""
) -> ConfigError:
    """Make a ConfigError of one line from numba's error about a class that it can't compile."""
    text = COLOURS.sub("", str(error))
    lines = [" ".join(line.split()).partition(" Raised from ")[0] for line in text.splitlines()]
    reasons = [line for line in lines if line and not line.startswith(GENERAL)]
    reason = reasons[0][:200].rstrip(".:") if reasons else type(error).__name__
    place = _find_place(text, kind, methods)
    return ConfigError(
        f"{name}: numba can't compile it: {place}{reason} - {rules}mend it, or set compiled = False"
    )


def _find_place(text: str, kind: type, methods: Collection[str]) -> str:
    """The innermost line of a user's that numba's message names, as "method() (file:line): ".

    Lines of the loop itself look as if they were in the class's file.
    """
    defined = [name for name in methods if hasattr(kind, name)]
    codes = {name: inspect.unwrap(getattr(kind, name)).__code__ for name in defined}
    for match in PLACE.finditer(text):
        path = Path(match["at"] or match["file"])
        line = int(match[2] or match[4])
        for method, code in codes.items():
            last = max(number or 0 for *_, number in code.co_lines())
            if path.name == Path(code.co_filename).name and code.co_firstlineno <= line <= last:
                return f"{method}() ({code.co_filename}:{line}): "
        is_helper = path.is_absolute() and not any(map(path.is_relative_to, OWN_FOLDERS))
        if is_helper and path.name not in {Path(code.co_filename).name for code in codes.values()}:
            return f"({path}:{line}): "
    return ""
