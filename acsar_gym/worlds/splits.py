"""Which numbers of generated worlds are for training, and which for testing."""

from __future__ import annotations

from typing import Any

from acsar_gym.worlds import names

TRAIN, TEST = "train", "test"
NAMES = (TRAIN, TEST)
"""What may follow the name of a kind, as in "clutter:test"."""
_NUMBERS = {TRAIN: range(1000, 1400), TEST: range(200)}
_BARN_TEST = range(300)
"""As many as BARN has published."""


def numbers(kind: str, split: str) -> range:
    """World numbers of a split: 1000 to 1399 for training.

    0 to 199 for testing, 0 to 299 of BARN.
    """
    return _BARN_TEST if (kind, split) == ("barn", TEST) else _NUMBERS[split]


def holding(kind: str, some: range) -> str:
    """The split that all of these numbers belong to; empty where there is none."""
    for name in NAMES:
        every = numbers(kind, name)
        if some[0] in every and some[-1] in every:
            return name
    return ""


def tested(source: Any) -> Any:
    """Replace a generator's name without numbers by its test split.

    Return anything else unchanged.
    """
    name = names.generated(source) if isinstance(source, str) else None
    return source if name is None or name.numbers else f"{name.generator}:{TEST}"
