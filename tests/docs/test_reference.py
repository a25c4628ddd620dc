"""docs/reference: what it shows of docstrings. `make reference` writes it by this file.

Hosting sites show a page as it lies in the repository, where mkdocstrings' lines (`::: name`) are
nothing. So such lines stand in a comment, before a table of the names with the first line of each
docstring, which this script writes. `docs/theme/repository.py` puts the lines in the place of the
table where the site is built. `ids.md` is made of the manuals of the ids' classes.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from acsar_gym import RobotEnv, envs
from acsar_gym.registration import IDS

griffe = pytest.importorskip("griffe")  # of the extra "docs"
REFERENCE = Path(__file__).resolve().parents[2] / "docs" / "reference"
TABLE = re.compile(
    r"(?P<names><!-- names\n(?P<lines>.*?)-->\n).*?(?P<end><!-- end of names -->)", re.S
)
NAME = re.compile(r"^::: (acsar_gym\S*)$", re.M)
IDS_HEAD = """# The ids

The manuals of the registered environments. `help(NAME)` in Python prints them
(`acsar_gym.RobotEnv` for what all ids share, `acsar_gym.envs.PointGoalEnv` and so on for each id).
Every id has [a batch](environments.md#many-robots) with the same spaces, reward and ends.

<!-- written by make reference from the classes in acsar_gym/envs -->

## All ids
"""
NO_MANUAL = re.compile(r"\n(Attributes|Example):\n.*", re.S)
"""The end of a docstring that belongs to the class, and not to the manual."""


def fill(page: str, package: Any) -> str:
    """A page with the tables of its names written anew."""

    def with_table(match: re.Match[str]) -> str:
        rows = [row for name in NAME.findall(match["lines"]) for row in rows_of(name, package)]
        return "".join([match["names"], "\n| name | |\n|---|---|\n", *rows, "\n", match["end"]])

    return TABLE.sub(with_table, page)


def rows_of(name: str, package: Any) -> Iterator[str]:
    """The row of a name, or those of a module's classes."""
    shown = package[name.partition(".")[2]]
    if shown.is_module:
        for kind in shown.classes.values():
            if not kind.name.startswith("_"):
                yield f"| `{kind.name}` | {first_line(kind)} |\n"
        return
    yield f"| `{name}` | {first_line(shown)} |\n"


def first_line(shown: Any) -> str:
    """The first paragraph of a docstring, on one line."""
    text = shown.docstring.value if shown.docstring else ""
    return " ".join(text.strip().split("\n\n")[0].split()).replace("|", "\\|")


def manual_of(kind: type) -> str:
    """The manual in a class's docstring, with headings one level lower."""
    manual = NO_MANUAL.sub("", inspect.getdoc(kind) or "").rstrip()
    return re.sub(r"^## ", "### ", manual, flags=re.M)


def manuals() -> str:
    """The page of the ids."""
    parts = [IDS_HEAD, f"\n{manual_of(RobotEnv)}\n"]
    for name, options in IDS.items():
        kind = getattr(envs, f"{name.partition('-')[0]}Env")
        about = ", ".join(f"`{option}` {number:g}" for option, number in options.items())
        parts.append(f"\n## acsar_gym/{name}\n\n{about}\n\n{manual_of(kind)}\n")
    return "".join(parts)


def pages() -> dict[Path, str]:
    """All pages that are written here, with their text."""
    package = griffe.load("acsar_gym", resolve_aliases=True)  # without importing it
    written = {
        page: fill(text, package)
        for page in sorted(REFERENCE.glob("*.md"))
        if TABLE.search(text := page.read_text(encoding="utf-8"))
    }
    return written | {REFERENCE / "ids.md": manuals()}


def test_reference_pages_are_as_the_script_writes_them() -> None:
    old = [page.name for page, text in pages().items() if page.read_text(encoding="utf-8") != text]
    assert old == [], "run make reference"


if __name__ == "__main__":
    for page, text in pages().items():
        page.write_text(text, encoding="utf-8")
        print(page.relative_to(REFERENCE.parents[1]))
