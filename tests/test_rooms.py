"""The shape of the code: which file imports which, and how long files and functions are."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

import acsar_gym
from acsar_gym.resources import AGENTS

PACKAGE = Path(acsar_gym.__file__).parent
MOST_MODULES = 16
"""Files directly in acsar_gym/."""
LONGEST_FUNCTION = 40
MOST_PARAMETERS = 8
"""Of a function, `self` not counted."""
LONGEST_FILE = 300
LONG_FUNCTIONS = {"dynamics/trigonometry.py sincos"}
"""One formula, in a form that a compiler vectorizes; there are no others."""

Function = ast.FunctionDef | ast.AsyncFunctionDef


def sources() -> dict[str, Path]:
    """The files of the package and its scripts, by a short name."""
    package = {str(path.relative_to(PACKAGE)): path for path in PACKAGE.rglob("*.py")}
    scripts = {f"agents/{path.relative_to(AGENTS)}": path for path in AGENTS.rglob("*.py")}
    return {n: path for n, path in package.items() if not n.startswith("agents/")} | scripts


def module_of(path: Path) -> str:
    parts = ("acsar_gym", *path.relative_to(PACKAGE).with_suffix("").parts)
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imported(node: ast.AST) -> Iterator[tuple[str, str]]:
    """Modules and names that code imports, also late; not what only type checkers import."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.If) and ast.unparse(child.test).endswith("TYPE_CHECKING"):
            yield from (
                pair for other in child.orelse for pair in imported(ast.Module([other], []))
            )
            continue
        if isinstance(child, ast.Import):
            yield from ((alias.name, "") for alias in child.names)
        elif isinstance(child, ast.ImportFrom) and child.module and not child.level:
            yield from ((child.module, alias.name) for alias in child.names)
        yield from imported(child)


def graph(files: dict[str, str]) -> dict[str, set[str]]:
    """Which modules import which, from the modules' sources. A package is its __init__.py."""
    arrows: dict[str, set[str]] = {}
    for module, source in files.items():
        pairs = imported(ast.parse(source))
        found = {
            f"{source}.{name}" if f"{source}.{name}" in files else source for source, name in pairs
        }
        arrows[module] = (found & set(files)) - {module}
    return arrows


def circle(arrows: dict[str, set[str]]) -> list[str]:
    """Modules that import each other in a circle; empty where there is none."""
    try:
        TopologicalSorter(arrows).prepare()
    except CycleError as error:
        return list(error.args[1])
    return []


@cache
def functions() -> list[tuple[str, Function]]:
    return [
        (f"{name} {node.name}", node)
        for name, path in sources().items()
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, Function)
    ]


def parameters(function: Function) -> int:
    given = function.args
    named = [*given.posonlyargs, *given.args, *given.kwonlyargs]
    stars = (given.vararg is not None) + (given.kwarg is not None)
    return sum(one.arg not in ("self", "cls") for one in named) + stars


def lines(function: Function) -> int:
    return (function.end_lineno or function.lineno) - function.lineno + 1


def test_no_file_imports_itself_by_way_of_others() -> None:
    files = {
        module_of(path): path.read_text(encoding="utf-8")
        for name, path in sources().items()
        if not name.startswith("agents/")
    }
    assert len(files) > 100
    assert circle(graph(files)) == []


@pytest.mark.parametrize(
    ("b", "found"),
    [
        ("import a", True),
        ("from a import x", True),
        ("def f():\n    from a import x", True),
        ("from c import a", False),
        ("if TYPE_CHECKING:\n    import a", False),
        ("if TYPE_CHECKING:\n    import a\nelse:\n    import a", True),
    ],
)
def test_circles_are_found(b: str, *, found: bool) -> None:
    arrows = graph({"a": "import b", "b": b, "c": "", "c.d": "from c import d"})
    assert bool(circle(arrows)) == found


def test_few_modules_lie_directly_in_the_package() -> None:
    assert len(list(PACKAGE.glob("*.py"))) <= MOST_MODULES


def test_files_are_short() -> None:
    sizes = {n: len(p.read_text(encoding="utf-8").splitlines()) for n, p in sources().items()}
    assert [name for name, size in sizes.items() if size > LONGEST_FILE] == []


def test_functions_are_short() -> None:
    assert {name for name, f in functions() if lines(f) > LONGEST_FUNCTION} == LONG_FUNCTIONS


def test_functions_have_few_parameters() -> None:
    assert [name for name, f in functions() if parameters(f) > MOST_PARAMETERS] == []
