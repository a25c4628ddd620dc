"""docs/training.md: its blocks of code, run as they stand but for their size."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def snippets() -> dict[str, tuple[str, str]]:
    """Language and code of each block, by the first word of its first line."""
    text = (ROOT / "docs" / "training.md").read_text(encoding="utf-8")
    blocks = re.findall(
        r"^```(\w+)\n# ([\w. -]+?)(?=[:\n])(.*?)^```", text, re.MULTILINE | re.DOTALL
    )
    return {name: (language, f"#{code}") for language, name, code in blocks}


def shrunk(name: str, smaller: Mapping[str, str]) -> str:
    """A block's code, with other numbers."""
    _, code = snippets()[name]
    for old, new in smaller.items():
        assert old in code, old
        code = code.replace(old, new)
    return code
