"""Habits that reviews found hard to read are counted in the package, and may only become fewer.

They are several assignments in one statement, long functions without a blank line, calls with many
positional arguments, and local names that say nothing.
"""

from __future__ import annotations

import ast
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import pytest

import acsar_gym

LONG_FUNCTION = 15
"""Functions of so many lines and more need a blank line."""
MANY_ARGUMENTS = 6
"""Calls with so many positional arguments and more are counted."""
VAGUE_NAMES = (
    "found own one said told asked known each rest left given before after least most apart part "
    "seen begin here there what who whole other others both anew so far"
)
COUNTS = {"floods": 3, "vague": 17}
"""What there is today: lower a number that has fallen. Names of fields are counted as well."""


def find_habits(source: str) -> Iterator[tuple[str, int]]:
    """Find what is hard to read in the source of a file: the habits, and their lines."""
    lines = source.splitlines()
    vague_names = VAGUE_NAMES.split()

    for node in ast.walk(ast.parse(source)):
        match node:
            case ast.Assign(targets=targets, value=ast.Tuple()):
                if any(isinstance(target, ast.Tuple) for target in targets):
                    yield "packs", node.lineno
            case ast.Call(args=arguments):
                positional = [value for value in arguments if not isinstance(value, ast.Starred)]
                if len(positional) >= MANY_ARGUMENTS:
                    yield "floods", node.lineno
            case ast.Name(id=name, ctx=ast.Store()) if name in vague_names:
                yield "vague", node.lineno
            case ast.FunctionDef(body=body) | ast.AsyncFunctionDef(body=body):
                start = body[ast.get_docstring(node) is not None :]
                body_lines = lines[start[0].lineno - 1 : node.end_lineno] if start else []
                if len(body_lines) >= LONG_FUNCTION and all(map(str.strip, body_lines)):
                    yield "walls", node.lineno


@pytest.mark.parametrize(
    ("source", "habits"),
    [
        ("a, b = 1, 2", ["packs"]),
        ("a, b = pair", []),
        ("f(1, 2, 3, 4, 5, 6)", ["floods"]),
        ("f(1, 2, 3, 4, 5, x=6)", []),
        ("found = 1", ["vague"]),
        ("def f():\n" + "    x = 1\n" * 15, ["walls"]),
        ("def f():\n" + "    x = 1\n" * 14, []),
        ('def f():\n    """Do."""\n\n' + "    x = 1\n" * 15, ["walls"]),
        ("def f():\n    x = 1\n\n" + "    x = 1\n" * 14, []),
    ],
)
def test_habits_are_found(source: str, habits: list[str]) -> None:
    assert [habit for habit, _ in find_habits(source)] == habits


def test_package_has_no_more_habits() -> None:
    places = defaultdict(list)
    folder = Path(acsar_gym.__file__).parent
    for path in sorted(folder.rglob("*.py")):
        for habit, line in find_habits(path.read_text(encoding="utf-8")):
            places[habit].append(f"{path.relative_to(folder)}:{line}")
    assert {habit: len(lines) for habit, lines in places.items()} == COUNTS, dict(places)
