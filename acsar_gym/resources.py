"""Paths of assets/ and agents/: beside the package in a checkout, inside it in a wheel."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

_PACKAGE = Path(__file__).resolve().parent


def _folder(name: str) -> Path:
    """Return the path of a data folder."""
    inside = _PACKAGE / name
    return inside if inside.is_dir() else _PACKAGE.parent / name


ASSETS = _folder("assets")
"""Robot presets and URDF."""
AGENTS = _folder("agents")
"""Training recipes and trained policies."""


def agent(name: str) -> ModuleType:
    """Import the script `agents/NAME.py`, or the package `agents/NAME/`, once.

    Args:
        name: name of the script, without ".py", or of the package.
    """
    known = f"acsar_gym_agents_{name}"
    if known not in sys.modules:
        package = AGENTS / name / "__init__.py"
        file = package if package.is_file() else AGENTS / f"{name}.py"
        inside = [str(package.parent)] if file is package else None
        spec = importlib.util.spec_from_file_location(
            known, file, submodule_search_locations=inside
        )
        if spec is None or spec.loader is None:
            raise ImportError(f"{file}: not a Python script")
        sys.modules[known] = module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
    return sys.modules[known]
