"""Under which source worlds of one's own generators are kept."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from acsar_gym.worlds.registry import hash_function

FILES = {
    "makers/__init__.py": "",
    "makers/mine.py": "import numpy\nfrom makers import shapes\nfrom .sizes import WIDTH\n"
    "def make(rng, difficulty, radius):\n    import late_helper\n    return None\n",
    "makers/shapes.py": "import math\n",
    "makers/sizes.py": "WIDTH = 1.0\n",
    "late_helper.py": "",
    "unused.py": "",
}


@pytest.fixture
def printed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[], str]]:
    """The fingerprint of the package's generator, imported anew."""
    for name, text in FILES.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    monkeypatch.syspath_prepend(str(tmp_path))

    def forget() -> None:
        for name in [*sys.modules]:
            if name.partition(".")[0] in ("makers", "late_helper", "unused"):
                del sys.modules[name]
        importlib.invalidate_caches()

    def found() -> str:
        forget()
        return hash_function(importlib.import_module("makers.mine").make)

    yield found
    forget()


@pytest.mark.parametrize("name", FILES)
def test_every_file_that_is_imported_counts(
    name: str, printed: Callable[[], str], tmp_path: Path
) -> None:
    before = printed()
    assert len(before) == 64
    assert printed() == before
    (tmp_path / name).write_text(FILES[name] + "# changed\n")
    assert (printed() == before) == (name == "unused.py")


def test_what_is_not_a_plain_function_of_a_file_has_none() -> None:
    def outer(number: int) -> Callable[[], int]:
        return lambda: number

    typed: dict[str, Any] = {"__name__": "typed_in"}
    exec("def make(rng, difficulty, radius): pass", typed)  # noqa: S102 - as a notebook does it
    for made in (outer(1), print, Path, typed["make"]):
        assert hash_function(made) == ""
    assert hash_function(test_every_file_that_is_imported_counts) != ""


def test_default_arguments_count() -> None:
    def factory(length: Any, width: Any = 1.0) -> Any:
        def make(
            rng: Any, difficulty: Any, radius: Any, size: Any = length, *, w: Any = width
        ) -> None:
            pass

        return make

    prints = [hash_function(factory(*sizes)) for sizes in [(1,), (1.5,), ("a",), (None,), (1, 2)]]
    assert len({*prints, ""}) == 6
    assert hash_function(factory((1, 2.0))) == hash_function(factory((1, 2.0)))
    for size in ([1], Path(), (Path(),), np.zeros(2)):
        assert hash_function(factory(size)) == hash_function(factory(1, size)) == ""
