"""README.md and docs/: every block of code runs. `page_tools` tells how pages mark their blocks."""

from __future__ import annotations

import contextlib
import functools
import importlib
import re
import runpy
import shlex
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import Any

import gymnasium
import page_tools
import pytest
import tyro
from page_tools import PAGES, ROOT, Block

from acsar_gym.errors import LateTicksError
from acsar_gym.tools import cli
from acsar_gym.tools.cli.commands import COMMANDS
from acsar_gym.tools.training.plan import TrainingOptions
from acsar_gym.worlds import registry

LANGUAGES = {"bash", "c", "cpp", "dockerfile", "ini", "json", "python", "text", "xml", "yaml"}
DEVICE = re.compile(r"/dev/tty(?:ACM|USB)\d")
PATIENT = {"doctor", "drive", "evaluate", "run"}
"""Commands that get a robot file with long time-outs, for busy machines."""
LIMIT = 1800.0
"""After which a block counts as hanging [s]; far more than any takes."""
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


class Boards:
    """Emulated boards, by the names that a page has for them."""

    def __init__(self, request: pytest.FixtureRequest) -> None:
        self._request = request
        self._devices: dict[str, str] = {}

    def start(self, options: list[str]) -> None:
        """`acsar-gym emulate OPTIONS &`, with `--name` among them."""
        at = options.index("--name")
        emulator = self._request.getfixturevalue("start_emulator")
        self._devices[options[at + 1]] = emulator(*options[:at], *options[at + 2 :]).device

    def connected(self, words: list[str]) -> list[str]:
        """A command's words with the boards' devices, and a robot with patience."""
        found = [self._device(word) for word in words]
        if found == words or "--robot" in words or words[0] not in PATIENT:
            return found
        return [*found, "--robot", str(self._request.getfixturevalue("robot_file")())]

    def _device(self, word: str) -> str:
        if DEVICE.fullmatch(word):
            return str(self._request.getfixturevalue("shared_device"))
        return self._devices.get(word, word)


def smaller(words: list[str]) -> list[str]:
    """A command's arguments, as tests run it."""
    words = words.copy()
    for option, value in SMALLEST.get(words[0], {}).items():
        if option in words:
            words[words.index(option) + 1] = value
        elif option != "--workers":
            words += [option, value]
    return words


@contextlib.contextmanager
def limited(block: Block) -> Iterator[None]:
    """Fails a block that hangs."""

    def expire(number: int, frame: FrameType | None) -> None:
        pytest.fail(f"{block}: not within {LIMIT:g} s")

    before = signal.signal(signal.SIGALRM, expire)
    signal.setitimer(signal.ITIMER_REAL, LIMIT)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A page's folder, with what it names of the checkout; what it registers is forgotten."""
    modules, ids, own = set(sys.modules), dict(gymnasium.registry), dict(registry._OWN)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    for path in (ROOT / "agents", ROOT / "assets", *(ROOT / "docs").glob("*.json")):
        (tmp_path / path.name).symlink_to(path)
    yield tmp_path
    for name in set(sys.modules) - modules:
        if str(getattr(sys.modules[name], "__file__", None)).startswith(str(tmp_path)):
            del sys.modules[name]
    gymnasium.registry.clear()
    gymnasium.registry.update(ids)
    registry._OWN.clear()
    registry._OWN.update(own)


def source(block: Block) -> str:
    """A block's code with smaller numbers; errors tell its lines in the page."""
    code = block.code
    for old, new in SMALLER.get(str(block.page.relative_to(ROOT)), {}).items():
        code = code.replace(old, new)
    return "\n" * (block.line - 1) + code


def save(block: Block, folder: Path, name: str) -> None:
    """Write a file; a module of Python is imported, as a check."""
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(source(block).lstrip("\n"), encoding="utf-8")
    if path.suffix == ".py":
        for package in list(path.parents)[: len(Path(name).parents) - 1]:
            (package / "__init__.py").touch()
        importlib.invalidate_caches()
        importlib.import_module(".".join(Path(name).with_suffix("").parts))


def called(words: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Run a command of a bash block in this process."""
    monkeypatch.setattr(sys, "argv", words)
    with pytest.raises(SystemExit) as ended:
        if words[0] == "python":
            runpy.run_path(words[1], run_name="__main__")
            sys.exit(0)
        cli.main()
    assert ended.value.code in (None, 0, LateTicksError.exit_code), shlex.join(words)


def quiet(command: Callable[..., Any]) -> Callable[..., int]:
    """The command's options, and nothing else of it."""

    @functools.wraps(command)
    def nothing(*_: Any, **__: Any) -> int:
        return 0

    return nothing


def parsed(words: list[str]) -> None:
    """Check a command's name and options; it isn't run."""
    with pytest.MonkeyPatch.context() as patch:
        train = lambda: bool(tyro.cli(TrainingOptions, args=words[2:])) - 1  # noqa: E731
        for name, command in COMMANDS.items():
            function = train if name == "train" else quiet(command.function)
            patch.setitem(COMMANDS, name, command._replace(function=function))
        called(words, patch)


def is_ours(words: list[str]) -> bool:
    return words[0] == "acsar-gym"


def is_script(words: list[str]) -> bool:
    return words[0] == "python" and words[1:2] != ["-m"]


def check(block: Block) -> None:
    """The syntax of a block that isn't run."""
    if block.language == "python":
        compile(source(block), str(block), "exec")
    for words in block.commands if block.language == "bash" else ():
        if is_ours(words):
            parsed([word for word in words if word != "&"])


def execute(block: Block, folder: Path, names: dict[str, Any], boards: Boards) -> None:
    """Run a block."""
    if block.saved is not None:
        save(block, folder, block.saved)
    elif block.language == "python":
        exec(compile(source(block), str(block.page), "exec"), names)  # noqa: S102 - our own
    for words in block.commands if block.language == "bash" else ():
        with pytest.MonkeyPatch.context() as patch:
            if is_ours(words) and words[-1] == "&":
                assert words[1] == "emulate"
                boards.start(words[2:-1])
            elif is_ours(words):
                called(["acsar-gym", *boards.connected(smaller(words[1:]))], patch)
            elif is_script(words):
                called(words, patch)


def runs(page: Path) -> list[Block]:
    """Blocks of a page that do something."""
    return [
        block
        for block in page_tools.blocks(page)
        if block.saved or block.language in ("python", "bash")
    ]


@pytest.mark.parametrize(
    "page",
    [pytest.param(page, id=str(page.relative_to(ROOT))) for page in PAGES if runs(page)],
)
@pytest.mark.filterwarnings("default::acsar_gym.errors.PolicyWarning")  # pages drive other robots
def test_the_code_of_a_page_runs(page: Path, folder: Path, request: pytest.FixtureRequest) -> None:
    names: dict[str, Any] = {"__name__": "page"}
    boards = Boards(request)
    for block in runs(page):
        with limited(block):
            if block.reason is None:
                execute(block, folder, names, boards)
            else:
                check(block)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_blocks_are_fenced_and_name_their_language(page: Path) -> None:
    assert page_tools.indented(page) == []
    assert [str(b) for b in page_tools.blocks(page) if b.language not in LANGUAGES] == []


def test_every_number_that_is_made_smaller_is_there() -> None:
    for name, numbers in SMALLER.items():
        code = "".join(block.code for block in runs(ROOT / name))
        assert [old for old in numbers if old not in code] == []


@pytest.mark.parametrize(
    "line", ["evaluate --episods 3", "worlds chek barn", "train --envv barn", "fly"]
)
def test_wrong_commands_are_found(line: str) -> None:
    with pytest.raises(AssertionError):
        parsed(["acsar-gym", *line.split()])
