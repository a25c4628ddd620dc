"""Folders of the package and of the user, and hashes of sources."""

from __future__ import annotations

import ast
import contextlib
import hashlib
import importlib.util
import os
import sys
from functools import cache
from pathlib import Path

PACKAGE = Path(__file__).resolve().parent
_ROOT = PACKAGE if (PACKAGE / "assets").is_dir() else PACKAGE.parent  # a wheel, or a checkout

ASSETS = _ROOT / "assets"
"""Robot presets and URDF."""
AGENTS = _ROOT / "agents"
"""Training recipes and trained policies."""
CACHE_VARIABLE = "ACSAR_GYM_CACHE"
"""Environment variable that names another cache folder. "off" keeps nothing."""


def package_version() -> str:
    """Return the version of this package, also if it is used from its folder, not installed."""
    version: str = sys.modules["acsar_gym"].__version__
    return version


def cache_folder(name: str) -> Path | None:
    """Return a folder in the user's cache. None if nothing is to be kept."""
    folder = os.environ.get(CACHE_VARIABLE)
    if folder is not None:
        return None if folder.lower() in ("", "0", "off") else Path(folder) / name
    # The places that Windows and the XDG specification have for caches.
    base = os.environ.get("LOCALAPPDATA" if os.name == "nt" else "XDG_CACHE_HOME")
    try:
        return (Path(base) if base else Path.home() / ".cache") / "acsar_gym" / name
    except RuntimeError:  # a user without a home
        return None


@cache
def hash_sources(folder: Path, *excluded: Path) -> str:
    """Hash names and contents of all source files in a folder, except some folders in it."""
    digest = hashlib.sha256()
    for source in sorted(folder.rglob("*.py")):
        if not any(map(source.is_relative_to, excluded)):
            content = source.read_bytes()
            digest.update(f"{source.relative_to(folder)} {len(content)}\n".encode() + content)
    return digest.hexdigest()


def hash_modules(*modules: str) -> str:
    """Hash the sources of modules, and of the user's own modules that they import.

    Args:
        *modules: Names of modules.

    Returns:
        The hash. Empty if a module has no source file.
    """
    digest = hashlib.sha256()
    try:
        for module in modules:
            for name, content in sorted(_read_sources(module).items()):
                digest.update(f"{name} {len(content)} ".encode() + content)
    except (OSError, SyntaxError, ValueError):
        return ""
    return digest.hexdigest()


def _read_sources(first: str) -> dict[str, bytes]:
    """Return the contents of a module and of all that it imports, by their names.

    Python's own modules and this package's don't count. Installed modules count by their version.
    """
    contents: dict[str, bytes] = {}
    waiting = [first]
    while waiting:
        name = waiting.pop()
        file = _source_file(name)
        if file is None and name == first:
            raise OSError(name)
        if file is None or name in contents:
            continue
        # Libraries change with their versions, and following their imports would take seconds.
        installed = {"site-packages", "dist-packages"} & {*file.parts}
        if installed and name.partition(".")[0] != first.partition(".")[0]:
            contents[name] = str(getattr(sys.modules.get(name), "__version__", "")).encode()
            continue

        contents[name] = file.read_bytes()
        package = name if file.name == "__init__.py" else name.rpartition(".")[0]
        imported: list[str] = []
        for node in ast.walk(ast.parse(contents[name])):
            if isinstance(node, ast.Import):
                imported += [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                # A file outside a package may try a relative import, which fails, before another.
                with contextlib.suppress(ImportError):
                    relative = "." * node.level + (node.module or "")
                    base = importlib.util.resolve_name(relative, package)
                    imported += [base, *(f"{base}.{alias.name}" for alias in node.names)]

        # This package's sources have a hash of their own.
        ours = {*sys.stdlib_module_names, "acsar_gym"}
        waiting += [module for module in imported if module.partition(".")[0] not in ours]
    return contents


def _source_file(name: str) -> Path | None:
    """Return the source file of a module. None if it has none."""
    module = sys.modules.get(name)
    try:
        file = module.__file__ if module else getattr(importlib.util.find_spec(name), "origin", "")
    except Exception:  # noqa: BLE001 - imports the package of the module, which raises anything
        return None
    return Path(file) if file and file.endswith(".py") else None
