"""Files of the repository that pages link to, as a part of the site.

Pages link to files as they lie in the checkout, such as `../agents/recipes`, so that links work
there and on the site. Here a Markdown file becomes a page, source code a page that shows it, a
folder a page that lists it, and a picture is copied.
"""

from __future__ import annotations

import os
import re
from pathlib import Path, PurePosixPath
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files, InclusionLevel
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
LINK = re.compile(r"""(?P<before>\]\(|(?:src|href)=")(?P<path>[\w.-]*/?[\w./-]+)(?=[)#"])""")
NAMES = re.compile(r"<!-- names\n(?P<lines>.*?)-->\n.*?<!-- end of names -->", re.S)
"""Names in docs/reference: mkdocstrings' lines, and the table that stands there without it."""
PICTURES = {".png", ".gif", ".svg", ".jpg"}
TOP = ("CHANGELOG.md", "CONTRIBUTING.md")
"""Pages of the site that lie in the repository's root."""
HOME = {ROOT / "README.md": "index.md"}
"""The site's counterpart of a file that has no page of its own."""


def address(path: Path) -> str:
    """Where a file or folder of the repository lies among the site's sources."""
    if path in HOME:
        return HOME[path]
    if path.is_relative_to(DOCS):
        return path.relative_to(DOCS).as_posix()
    place = path.relative_to(ROOT).as_posix()
    if path.is_dir():
        return f"{place}/README.md"
    return place if path.suffix in {".md", *PICTURES} else f"{place}.md"


def targets(text: str, folder: Path) -> list[Path]:
    """Files and folders of the repository, outside docs/, that a text links to."""
    found = (Path(os.path.normpath(folder / match["path"])) for match in LINK.finditer(text))
    return [
        path
        for path in found
        if path.exists() and path.is_relative_to(ROOT) and not path.is_relative_to(DOCS)
    ]


def shown(path: Path) -> str:
    """A page that shows a source file, or lists a folder."""
    head = f"---\nsearch:\n  exclude: true\n---\n# {path.relative_to(ROOT)}\n\n"
    if path.is_dir():
        names = sorted(one.name for one in path.iterdir() if one.name[0] not in "._")
        return head + "".join(f"- [{name}]({name})\n" for name in names)
    language = {".py": "python", ".yml": "yaml"}.get(path.suffix, path.suffix.lstrip(".") or "text")
    return f"{head}````{language}\n{path.read_text(encoding='utf-8')}````\n"


def on_files(files: Files, config: MkDocsConfig) -> None:
    """Add what pages link to, and what that links to."""
    pages = [Path(file.abs_src_path) for file in files.documentation_pages() if file.abs_src_path]
    waiting = [ROOT / name for name in TOP]
    for page in pages:
        waiting += targets(page.read_text(encoding="utf-8"), page.parent)
    while waiting:
        path = waiting.pop()
        uri = address(path)
        if uri in files.src_uris:
            continue
        file, text = _file(path, uri, config)
        files.append(file)
        if path.suffix == ".md" or path.is_dir():
            waiting += targets(text, path if path.is_dir() else path.parent)


def _file(path: Path, uri: str, config: MkDocsConfig) -> tuple[File, str]:
    if path.is_dir() and (path / "README.md").exists():
        path = path / "README.md"
    if path.suffix in PICTURES:
        return File.generated(config, uri, abs_src_path=str(path)), ""
    text = path.read_text(encoding="utf-8") if path.suffix == ".md" else shown(path)
    level = InclusionLevel.INCLUDED if uri in TOP else InclusionLevel.NOT_IN_NAV
    return File.generated(config, uri, content=text, inclusion=level), text


def on_page_markdown(markdown: str, page: Page, **_: Any) -> str:
    """Point links at files outside docs/ to their places, and show docstrings for their names."""
    markdown = NAMES.sub(lambda match: match["lines"], markdown)
    here = PurePosixPath(page.file.src_uri).parent
    source = DOCS / here
    if page.file.generated_by is not None:
        source = ROOT / here

    def moved(match: re.Match[str]) -> str:
        path = Path(os.path.normpath(source / match["path"]))
        if not path.exists() or not path.is_relative_to(ROOT):
            return match[0]
        return match["before"] + os.path.relpath(address(path), here)

    return LINK.sub(moved, markdown)
