"""docs/troubleshooting.md: its messages are those of the code."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs/troubleshooting.md"
MARK = re.compile(r"`([^`]+)`")
WORDS = 2
"""Fewest words of a piece that is looked up; shorter ones are in any file."""
SPAN = "\0"
COMPOSED = {"ended by the geofence": "ended by \0 after"}
"""Messages whose names are words of the code."""


def texts() -> str:
    """All texts of the package; what f-strings fill in is SPAN."""
    found = []
    for path in sorted((ROOT / "acsar_gym").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                found.append(node.value)
            elif isinstance(node, ast.JoinedStr):
                parts = [v.value if isinstance(v, ast.Constant) else SPAN for v in node.values]
                found.append("".join(map(str, parts)))
    return "\n".join(found)


def messages() -> list[str]:
    """The messages of the first column."""
    rows = [
        line for line in PAGE.read_text(encoding="utf-8").splitlines() if line.startswith("| `")
    ]
    cells = [row.split(" | ")[0].split(" in `")[0] for row in rows]  # the rest is a command
    return [message for cell in cells for message in MARK.findall(cell)]


def pieces(message: str) -> list[str]:
    """What a message says between the names and numbers."""
    found = [piece.strip(" :,()'") for piece in re.split(r"\.\.\.", message)]
    return [piece for piece in found if len(piece.split()) >= WORDS]


@pytest.fixture(scope="module")
def known() -> str:
    return texts()


@pytest.mark.parametrize("message", messages())
def test_the_code_says_so(message: str, known: str) -> None:
    said = [COMPOSED.get(piece, piece) for piece in pieces(message)]
    assert [piece for piece in said if piece not in known] == []


def test_most_messages_have_something_to_look_up() -> None:
    found = messages()
    assert len(found) > 40
    assert sum(bool(pieces(message)) for message in found) > 0.9 * len(found)
