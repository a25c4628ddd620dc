"""README.md and docs/: every block of code runs.

How pages write code:

- ```python blocks share one namespace per page and run in an empty folder. A block whose first line
  is a comment with a path, `# mine/clearance.py`, is saved there and imported. Blocks in other
  languages with such a first line (`# robot.yaml`) are saved.
- ```bash blocks: lines that start with `acsar-gym` run in this process, `python FILE` too, with the
  smaller numbers of SMALLER and SMALLEST. /dev/ttyUSB0 and /dev/ttyACM0 are an emulated board, and
  `acsar-gym emulate --name /tmp/robot &` starts another. Other lines are read.
- `<!-- not run: REASON -->` in the line before a block: Python is only compiled, and commands are
  only parsed (command, options and their values must be right).
"""

from __future__ import annotations

import functools
import importlib
import logging
import re
import runpy
import shlex
import signal
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
import pytest
from markdown_it import MarkdownIt

from acsar_gym.errors import LateTicksError
from acsar_gym.tools import cli
from acsar_gym.tools.cli.commands import COMMANDS
from acsar_gym.worlds import registry

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
NOT_RUN = re.compile(r"<!-- not run: .+? -->\s*$")
SAVED = re.compile(r"(?:#|<!--)\s*([\w./-]+\.(?:py|ya?ml|json|xml|urdf|world|sdf))(?:\s*-->)?\n")
DEVICE = re.compile(r"/dev/tty(?:ACM|USB)\d")
PATIENT = {"doctor", "drive", "evaluate", "run"}
"""Commands that get a robot file with long time-outs, for busy machines."""
LIMIT = 1800.0
"""After which a page counts as hanging [s]. Far more than any takes."""
SMALLER: dict[str, dict[str, str]] = {
    "docs/training.md": {
        "256": "4",
        "ObstacleGoal-v1": "PointGoal-v0",  # whose worlds take minutes to make
        "n_steps=64": "n_steps=8",
        "batch_size=4096": "batch_size=32",
        "300_000": "32",
    },
    "docs/scaling.md": {"workers=8": "workers=1"},
}
"""Numbers of a page's blocks of Python that tests make smaller."""
SMALLEST = {
    "evaluate": {"--episodes": "1", "--workers": "1"},
    "train": {"--steps": "64", "--robots": "8", "--workers": "1"},
}
"""Options that commands get, or have, with other values."""


@dataclass(frozen=True)
class Block:
    """A fenced block of code. `line` is the first line of its code in the page, from 1 on."""

    page: Path
    line: int
    language: str
    code: str
    is_run: bool

    @property
    def source(self) -> str:
        """Its code with smaller numbers. Errors tell its lines in the page."""
        code = self.code
        for old, new in SMALLER.get(str(self.page.relative_to(ROOT)), {}).items():
            code = code.replace(old, new)
        return "\n" * (self.line - 1) + code

    @property
    def commands(self) -> list[list[str]]:
        """The lines of a bash block as words. Comments and backslashes are resolved."""
        if self.language != "bash":
            return []
        lines = self.code.replace("\\\n", " ").splitlines()
        return [words for line in lines if (words := shlex.split(line, comments=True))]


def list_blocks(page: Path) -> list[Block]:
    """All fenced blocks of a page."""
    blocks = []
    is_run = True
    for token in MarkdownIt("commonmark").parse(page.read_text(encoding="utf-8")):
        if token.type == "fence" and token.map is not None:
            language = token.info.split(" ")[0]
            blocks.append(Block(page, token.map[0] + 2, language, token.content, is_run))
        is_run = not (token.type == "html_block" and NOT_RUN.search(token.content))
    return blocks


def connect(words: list[str], devices: dict[str, str], request: pytest.FixtureRequest) -> list[str]:
    """A command's words with the boards' devices, and a robot with patience."""
    connected = [
        str(request.getfixturevalue("shared_device"))
        if DEVICE.fullmatch(word)
        else devices.get(word, word)
        for word in words
    ]
    if connected == words or "--robot" in words or words[0] not in PATIENT:
        return connected
    return [*connected, "--robot", str(request.getfixturevalue("robot_file")())]


def shrink(words: list[str]) -> list[str]:
    """A command's arguments, as tests run it."""
    words = words.copy()
    for option, value in SMALLEST.get(words[0], {}).items():
        if option in words:
            words[words.index(option) + 1] = value
        elif option != "--workers":
            words += [option, value]
    return words


WIRE_LOG = logging.getLogger("acsar_gym.wire")
"""A page sets its level."""


@pytest.fixture(autouse=True)
def _folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A page's folder, with what it names of the checkout. What it registers is forgotten."""
    modules = set(sys.modules)
    ids = dict(gymnasium.registry)
    registered = dict(registry.REGISTERED)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    for path in (ROOT / "agents", ROOT / "assets", *(ROOT / "docs").glob("*.json")):
        (tmp_path / path.name).symlink_to(path)
    log_level = WIRE_LOG.level

    yield

    WIRE_LOG.setLevel(log_level)
    for name in set(sys.modules) - modules:
        if str(getattr(sys.modules[name], "__file__", None)).startswith(str(tmp_path)):
            del sys.modules[name]
    gymnasium.registry.clear()
    gymnasium.registry.update(ids)
    registry.REGISTERED.clear()
    registry.REGISTERED.update(registered)


def save(block: Block, path: Path) -> None:
    """Write a file. A module of Python is imported, as a check."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(block.source.lstrip("\n"), encoding="utf-8")
    if path.suffix == ".py":
        name = path.relative_to(Path.cwd())
        for package in list(name.parents)[:-1]:
            (package / "__init__.py").touch()
        importlib.invalidate_caches()
        importlib.import_module(".".join(name.with_suffix("").parts))


def call(words: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Run a command of a bash block in this process."""
    monkeypatch.setattr(sys, "argv", words)
    with pytest.raises(SystemExit) as ended:
        if words[0] == "python":
            runpy.run_path(words[1], run_name="__main__")
            sys.exit(0)
        cli.main()
    assert ended.value.code in (None, 0, LateTicksError.exit_code), shlex.join(words)


def parse(words: list[str]) -> None:
    """Check a command's name and options. It isn't run."""

    def quiet(command: Callable[..., Any]) -> Callable[..., int]:
        return functools.wraps(command)(lambda *_, **__: 0)

    with pytest.MonkeyPatch.context() as patch:
        for name, command in COMMANDS.items():
            patch.setitem(COMMANDS, name, command._replace(function=quiet(command.function)))
        call(words, patch)


def run(
    block: Block, names: dict[str, Any], devices: dict[str, str], request: pytest.FixtureRequest
) -> None:
    """Run a block. `devices` are emulated boards by the names that a page has for them."""
    if saved := SAVED.match(block.code):
        save(block, Path.cwd() / saved[1])
    elif block.language == "python":
        exec(compile(block.source, str(block.page), "exec"), names)  # noqa: S102 - our own

    for words in block.commands:
        with pytest.MonkeyPatch.context() as patch:
            if words[0] == "acsar-gym" and words[-1] == "&":
                assert words[1] == "emulate"
                name = words.index("--name") + 1
                start = request.getfixturevalue("start_emulator")
                devices[words[name]] = start(*words[2 : name - 1], *words[name + 1 : -1]).device
            elif words[0] == "acsar-gym":
                call(["acsar-gym", *connect(shrink(words[1:]), devices, request)], patch)
            elif words[0] == "python" and words[1:2] != ["-m"]:
                call(words, patch)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
@pytest.mark.filterwarnings(
    "default:.*polic:acsar_gym.errors.AcsarWarning"
)  # pages drive other robots
def test_code_of_a_page_runs(page: Path, request: pytest.FixtureRequest) -> None:
    names: dict[str, Any] = {"__name__": "page"}
    devices: dict[str, str] = {}
    signal.signal(signal.SIGALRM, lambda *_: pytest.fail(f"{page}: not within {LIMIT:g} s"))
    signal.setitimer(signal.ITIMER_REAL, LIMIT)

    try:
        for block in list_blocks(page):
            if block.is_run:
                run(block, names, devices, request)
                continue
            if block.language == "python":
                compile(block.source, str(block.page), "exec")
            for words in block.commands:
                if words[0] == "acsar-gym":
                    parse([word for word in words if word != "&"])
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
