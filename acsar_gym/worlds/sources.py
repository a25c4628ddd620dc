"""Compute a hash of the source code that a function depends on, as far as that can be known."""

from __future__ import annotations

import ast
import hashlib
import importlib.util
import sys
from collections.abc import Iterator
from pathlib import Path
from types import FunctionType
from typing import Any


def fingerprint(function: Any) -> str:
    """Hash the source of a function's module, and of the user's own modules that it imports.

    Only the versions of other installed packages count; this package has a hash of its own.

    Args:
        function: a generator of worlds.

    Returns:
        The hash; empty for anything but a plain function of a module, such as a closure or a
        function with default arguments that aren't numbers or strings, and where there is no
        source file, as in a notebook.
    """
    if not isinstance(function, FunctionType) or function.__closure__:
        return ""
    defaults = [*(function.__defaults__ or ()), *sorted((function.__kwdefaults__ or {}).items())]
    said = of_modules(function.__module__) if all(map(_exact, defaults)) else ""
    about = f"{function.__qualname__} {defaults} {said}".encode()
    return hashlib.sha256(about).hexdigest() if said else ""


def of_modules(*modules: str) -> str:
    """A hash of the sources of modules, and of the user's own modules that they import.

    Args:
        *modules: their names.

    Returns:
        A hexadecimal number; empty where a module has no source file.
    """
    said = hashlib.sha256()
    try:
        for module in modules:
            for name, content in sorted(_sources(module).items()):
                said.update(f"{name} {len(content)} ".encode() + content)
    except (OSError, SyntaxError, ValueError):
        return ""
    return said.hexdigest()


def _exact(value: Any) -> bool:
    """Whether the value's repr() is all of it."""
    if isinstance(value, tuple):
        return all(map(_exact, value))
    return value is None or type(value) in (bool, int, float, str)


def _sources(first: str) -> dict[str, bytes]:
    """Contents of a module and of all that it imports, directly or indirectly, by their names."""
    found: dict[str, bytes] = {}
    waiting = [first]
    while waiting:
        name = waiting.pop()
        file = _file(name)
        if name in found or (file is None and name != first):
            continue
        if file is None:
            raise OSError(name)
        if _installed(file) and name.partition(".")[0] != first.partition(".")[0]:
            found[name] = str(getattr(sys.modules.get(name), "__version__", "")).encode()
            continue
        found[name] = file.read_bytes()
        package = name if file.name == "__init__.py" else name.rpartition(".")[0]
        waiting += _imported(found[name], package)
    return found


def _imported(source: bytes, package: str) -> Iterator[str]:
    """Names of modules that source code may import, except Python's own and this package's."""
    for node in ast.walk(ast.parse(source)):
        names: list[str] = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = importlib.util.resolve_name("." * node.level + (node.module or ""), package)
            names = [base, *(f"{base}.{alias.name}" for alias in node.names)]
        for name in names:
            if name.partition(".")[0] not in {*sys.stdlib_module_names, "acsar_gym"}:
                yield name


def _file(name: str) -> Path | None:
    """The source file of a module; None where there is none."""
    module = sys.modules.get(name)
    try:
        file = module.__file__ if module else getattr(importlib.util.find_spec(name), "origin", "")
    except (ImportError, AttributeError, ValueError):
        return None
    return Path(file) if file and file.endswith(".py") else None


def _installed(file: Path) -> bool:
    """Whether a file belongs to an installed package."""
    return bool({"site-packages", "dist-packages"} & {*file.parts})
