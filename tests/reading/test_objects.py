"""Objects by name: whatever a user's module does, it's one clear error."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from acsar_gym.errors import ConfigError
from acsar_gym.reading import import_object

FILES = {"unreadable": "x = = 1\n", "raising": "1 / 0\n", "leaving": "raise SystemExit(3)\n"}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A folder with modules that can't be imported."""
    for name, text in FILES.items():
        (tmp_path / f"{name}.py").write_text(text)
    monkeypatch.syspath_prepend(str(tmp_path))
    importlib.invalidate_caches()
    yield
    for name in FILES:
        sys.modules.pop(name, None)


@pytest.mark.usefixtures("folder")
@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("unreadable:X", "module unreadable can't be imported: SyntaxError: "),
        ("raising:X", "module raising can't be imported: ZeroDivisionError: division by zero"),
        ("leaving:X", "module leaving can't be imported: SystemExit: 3"),
        ("nowhere:X", "No module named 'nowhere'; must be like 'module:Class'"),
        ("math:X", "has no attribute 'X'; must be like 'module:Class'"),
        *(
            (name, "must be like 'module:Class'")
            for name in (".math:X", ":X", "math:", "", "a..b:c")
        ),
    ],
)
def test_a_bad_name_is_one_clear_error(name: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        import_object("sensor", name)
    assert str(caught.value).startswith(f"sensor = {name!r}: ")
    assert "\n" not in str(caught.value)


def test_objects_of_objects_are_found() -> None:
    assert import_object("task", "pathlib:Path.cwd") == Path.cwd
