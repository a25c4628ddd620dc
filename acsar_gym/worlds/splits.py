"""Which numbers of generated worlds are for training, validation, testing, and the benchmark."""

from __future__ import annotations

from typing import Any

from acsar_gym.worlds import names

TRAIN, VALIDATION, TEST, BENCHMARK = "train", "validation", "test", "benchmark"
NAMES = (TRAIN, VALIDATION, TEST, BENCHMARK)
"""What may follow the name of a kind, as in "clutter:test"."""
_NUMBERS = {
    TRAIN: range(1000, 1400),
    VALIDATION: range(900, 964),
    TEST: range(200),
    BENCHMARK: range(100_000, 101_000),
}
"""Those of the benchmark are far from numbers that anybody would train in by hand."""
_BARN_TEST = range(300)
"""As many as BARN has published."""


def numbers(kind: str, split: str) -> range:
    """World numbers of a split.

    1000 to 1399 for training, 900 to 963 for validation during training, 0 to 199 for testing (0 to
    299 of BARN), and 100000 to 100999 for the benchmark, whose worlds nobody has looked at while
    methods were chosen.
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
