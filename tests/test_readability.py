"""Readability counts of each package, which may only fall: the table holds today's numbers.

Four habits that reviews found hard to read are counted: several assignments in one statement, long
functions without a blank line, calls with many positional arguments, and local names that say
nothing. If a count falls, lower its number in the table: a test fails if the table is too high.
"""

from __future__ import annotations

import ast
from pathlib import Path
from typing import NamedTuple

import pytest

import acsar_gym

PACKAGE = Path(acsar_gym.__file__).parent
NESTED = ("tools", "sensors", "vector")
"""Folders whose own folders are counted one by one."""
LONG_FUNCTION = 15
"""Functions of so many lines and more need a blank line."""
MANY_ARGUMENTS = 6
"""Calls with so many positional arguments and more are counted."""
VAGUE_NAMES = frozenset(
    [
        "found",
        "own",
        "one",
        "said",
        "told",
        "asked",
        "known",
        "each",
        "rest",
        "left",
        "given",
        "before",
        "after",
        "least",
        "most",
        "apart",
        "part",
        "seen",
        "begin",
        "here",
        "there",
        "what",
        "who",
        "whole",
        "other",
        "others",
        "both",
        "anew",
        "so",
        "far",
    ]
)


class Counts(NamedTuple):
    """What is hard to read in a file or a package."""

    packs: int = 0
    """Assignments of a tuple to a tuple."""
    walls: int = 0
    """Long functions without a blank line."""
    floods: int = 0
    """Calls with many positional arguments."""
    vague: int = 0
    """Local names that say nothing."""


MOST = {
    "physics": Counts(0, 0, 3, 0),
    "recording": Counts(0, 0, 0, 1),
    "safety": Counts(0, 0, 0, 1),
    "tasks": Counts(0, 0, 0, 4),
    "tools/commission": Counts(0, 0, 0, 2),
    "tools/evaluation": Counts(0, 0, 0, 2),
    "tools/sysid": Counts(0, 0, 0, 4),
    "vector/kernel": Counts(0, 0, 0, 3),
}


def count(source: str) -> Counts:
    """Count what is hard to read in the source of a file."""
    lines = source.splitlines()
    packs = walls = floods = vague = 0
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Assign) and isinstance(node.value, ast.Tuple):
            packs += any(isinstance(target, ast.Tuple) for target in node.targets)
        if isinstance(node, ast.Call):
            positional = [value for value in node.args if not isinstance(value, ast.Starred)]
            floods += len(positional) >= MANY_ARGUMENTS
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            vague += node.id in VAGUE_NAMES
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            walls += is_wall(node, lines)
    return Counts(packs, walls, floods, vague)


def is_wall(function: ast.FunctionDef | ast.AsyncFunctionDef, lines: list[str]) -> bool:
    """Whether a function is long, and has no blank line below its docstring."""
    body = [
        statement
        for statement in function.body
        if not (isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant))
    ]
    if not body or function.end_lineno is None:
        return False
    body_lines = lines[body[0].lineno - 1 : function.end_lineno]
    return len(body_lines) >= LONG_FUNCTION and all(line.strip() for line in body_lines)


def package_counts() -> dict[str, Counts]:
    """Counts of each package, by its path below `acsar_gym`."""
    totals: dict[str, Counts] = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        folders = path.relative_to(PACKAGE).parts[:-1]
        name = "/".join(folders[: 2 if folders[:1] and folders[0] in NESTED else 1]) or "."
        counts = count(path.read_text(encoding="utf-8"))
        totals[name] = Counts(*map(sum, zip(totals.get(name, Counts()), counts, strict=True)))
    return totals


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        ("a, b = 1, 2", Counts(packs=1)),
        ("a, b = pair", Counts()),
        ("f(1, 2, 3, 4, 5, 6)", Counts(floods=1)),
        ("f(1, 2, 3, 4, 5, x=6)", Counts()),
        ("found = 1", Counts(vague=1)),
        ("def f():\n" + "    x = 1\n" * 15, Counts(walls=1)),
        ("def f():\n" + "    x = 1\n" * 14, Counts()),
        ("def f():\n    x = 1\n\n" + "    x = 1\n" * 14, Counts()),
    ],
)
def test_counter_counts_what_is_hard_to_read(source: str, expected: Counts) -> None:
    assert count(source) == expected


def test_counts_only_fall() -> None:
    counted = package_counts()
    assert len(counted) > 10
    rose = {
        name: (counts, MOST.get(name, Counts()))
        for name, counts in counted.items()
        if any(now > most for now, most in zip(counts, MOST.get(name, Counts()), strict=True))
    }
    assert not rose, "write these packages so that they are easier to read"


def test_table_is_as_low_as_the_counts() -> None:
    counted = package_counts()
    stale = {name: counted.get(name, Counts()) for name in MOST if MOST[name] != counted.get(name)}
    assert not stale, "lower these rows of MOST to what is counted now"
