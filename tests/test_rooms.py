"""The shape of the code: no files import each other in a circle."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import acsar_gym

PACKAGE = Path(acsar_gym.__file__).parent


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


def test_no_file_imports_itself_by_way_of_others() -> None:
    files = {module_of(path): path.read_text(encoding="utf-8") for path in PACKAGE.rglob("*.py")}
    assert len(files) > 100
    assert circle(graph(files)) == []
