"""Docstrings: their examples run, and every public name and every task has one."""

from __future__ import annotations

import doctest
import importlib
import inspect
from pathlib import Path
from types import ModuleType
from typing import Any

import gymnasium
import pytest

import acsar_gym
from acsar_gym import tasks
from acsar_gym.worlds import registry

PACKAGE = Path(acsar_gym.__file__).parent
MODULES = [
    ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts).removesuffix(".__init__")
    for path in sorted(PACKAGE.rglob("*.py"))
    if ">>> " in path.read_text(encoding="utf-8")
]
PUBLIC = {
    **{name: getattr(acsar_gym, name) for name in acsar_gym.__all__},
    **{name: kind for name, kind in vars(tasks).items() if inspect.isclass(kind)},
}


@pytest.fixture(autouse=True)
def _restored_registries(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Examples run in an empty folder, and what they register is forgotten."""
    monkeypatch.setattr(gymnasium.envs.registration, "registry", dict(gymnasium.registry))
    monkeypatch.setattr(registry, "REGISTERED", dict(registry.REGISTERED))
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize("name", MODULES)
def test_docstring_examples(name: str) -> None:
    module = importlib.import_module(name)
    result = doctest.testmod(module, optionflags=doctest.ELLIPSIS)
    assert result.attempted > 0
    assert result.failed == 0


def _has_example(value: Any) -> bool:
    return ">>> " in (value.__doc__ or "")


def test_docstring_examples_exist() -> None:
    """A package whose functions have examples needs none of its own."""
    public = {name for name, value in PUBLIC.items() if not isinstance(value, ModuleType)}
    missing = {name for name in public if not _has_example(PUBLIC[name])}
    assert missing == set()
