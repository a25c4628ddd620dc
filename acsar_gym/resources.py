"""Paths of assets/ and agents/: beside the package in a checkout, inside it in a wheel."""

from __future__ import annotations

from pathlib import Path

_PACKAGE = Path(__file__).resolve().parent
_ROOT = _PACKAGE if (_PACKAGE / "assets").is_dir() else _PACKAGE.parent

ASSETS = _ROOT / "assets"
"""Robot presets and URDF."""
AGENTS = _ROOT / "agents"
"""Training recipes and trained policies."""
