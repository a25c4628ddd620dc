"""Folders of the package and of the user, and the hash of sources."""

from __future__ import annotations

import hashlib
import os
from functools import cache
from pathlib import Path

PACKAGE = Path(__file__).resolve().parent
_ROOT = PACKAGE if (PACKAGE / "assets").is_dir() else PACKAGE.parent  # a wheel, or a checkout

ASSETS = _ROOT / "assets"
"""Robot presets and URDF."""
AGENTS = _ROOT / "agents"
"""Training recipes and trained policies."""
CACHE_VARIABLE = "ACSAR_GYM_CACHE"
"""Environment variable that names another cache folder; "off" keeps nothing."""


def cache_folder(name: str) -> Path | None:
    """Return a folder in the user's cache; None if nothing is to be kept."""
    folder = os.environ.get(CACHE_VARIABLE)
    if folder is not None:
        return None if folder.lower() in ("", "0", "off") else Path(folder) / name
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
