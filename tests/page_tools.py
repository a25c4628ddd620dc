"""README.md and docs/: their blocks of code, links and anchors.

How pages write code, so that `tests/docs/test_code.py` can run it:

- ```python blocks share one namespace per page and run in an empty folder. A block whose first line
  is a comment with a path, `# mine/clearance.py`, is saved there and imported; blocks in other
  languages with such a first line (`# robot.yaml`) are saved.
- ```bash blocks: lines that start with `acsar-gym` run in this process, `python FILE` too; with
  smaller numbers (see SMALLER and SMALLEST in the test). /dev/ttyUSB0 and /dev/ttyACM0 are an
  emulated board, and `acsar-gym emulate --name /tmp/robot &` starts another. Other lines are read.
- What a command prints is a ```text block right after it.
- `<!-- not run: REASON -->` in the line before a block: Python is only compiled, and commands are
  only parsed (command, options and their values must be right).
"""

from __future__ import annotations

import itertools
import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from markdown_it import MarkdownIt
from markdown_it.token import Token

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
OTHERS = ("CONTRIBUTING.md", "CHANGELOG.md", "SECURITY.md")
PAGES += [page for name in OTHERS if (page := ROOT / name).exists()]
NOT_RUN = re.compile(r"<!-- not run: (.+?) -->\s*$")
SAVED = re.compile(r"(?:#|<!--)\s*([\w./-]+\.(?:py|ya?ml|json|xml|urdf|world|sdf))(?:\s*-->)?\n")
PARSER = MarkdownIt("commonmark").enable("table")


@dataclass(frozen=True)
class Block:
    """A fenced block of code."""

    page: Path
    line: int
    """Of its first line of code in the page, from 1 on."""
    language: str
    code: str
    reason: str | None
    """Why it isn't run; None where it is."""

    @property
    def saved(self) -> str | None:
        """The file that it is, as its first line says."""
        found = SAVED.match(self.code)
        return found[1] if found else None

    @property
    def commands(self) -> list[list[str]]:
        """The lines of a bash block as words; comments and backslashes are resolved."""
        lines = self.code.replace("\\\n", " ").splitlines()
        return [words for line in lines if (words := shlex.split(line, comments=True))]

    def __str__(self) -> str:
        return f"{self.page.relative_to(ROOT)}:{self.line}"


def tokens(page: Path) -> list[Token]:
    """A page in pieces."""
    return PARSER.parse(page.read_text(encoding="utf-8"))


def blocks(page: Path) -> list[Block]:
    """All fenced blocks of a page."""
    found = []
    reason: str | None = None
    for token in tokens(page):
        if token.type == "fence":
            assert token.map is not None
            language = token.info.split(" ")[0]
            found.append(Block(page, token.map[0] + 2, language, token.content, reason))
        comment = NOT_RUN.search(token.content) if token.type == "html_block" else None
        reason = comment[1] if comment else None
    return found


def indented(page: Path) -> list[int]:
    """Lines at which blocks of code begin that aren't fenced."""
    return [token.map[0] + 1 for token in tokens(page) if token.type == "code_block" and token.map]


def _inline(found: list[Token]) -> Iterator[Token]:
    for token in found:
        yield token
        yield from _inline(token.children or [])


def links(page: Path) -> list[str]:
    """Targets of links and pictures."""
    told: list[str] = []
    for token in _inline(tokens(page)):
        if token.type == "link_open":
            told.append(str(token.attrs["href"]))
        elif token.type == "image":
            told.append(str(token.attrs["src"]))
        elif token.type in ("html_block", "html_inline"):
            told += re.findall(r'(?:src|href)="([^"]+)"', token.content)
    return told


def anchors(page: Path) -> set[str]:
    """The anchors of a page's headings, as code forges and the site name them."""
    found = tokens(page)
    titles = [
        "".join(child.content for child in following.children or [])
        for token, following in itertools.pairwise(found)
        if token.type == "heading_open"
    ]
    slugs = [re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles]
    named = re.findall(r'\bid="([\w-]+)"', page.read_text(encoding="utf-8"))
    return {*slugs, *named}
