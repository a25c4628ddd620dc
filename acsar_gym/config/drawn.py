"""Robots drawn at random, numbered: "drawn:17" is the same robot on every machine."""

from __future__ import annotations

import re

from acsar_gym.errors import ConfigError, show_value

PREFIX = "drawn:"
SPLITS = {"train": range(512), "validation": range(1000, 1032), "test": range(2000, 2100)}
"""Numbers of the robots that policies learn with, are chosen by, and are measured with."""
_NAME = re.compile(rf"{PREFIX}(?:(\d{{1,9}})(?:-(\d{{1,9}}))?|({'|'.join(SPLITS)}))")


def is_drawn(text: str) -> bool:
    """Whether a robot's name is meant to be that of drawn ones."""
    return text.startswith(PREFIX)


def parse_numbers(text: str) -> range | None:
    """Return the numbers of a fleet's name, such as "drawn:train" or "drawn:0-63".

    Args:
        text: a name; others than of fleets, such as "drawn:17", give None.

    Raises:
        ConfigError: the name of drawn robots is malformed, or holds none.
    """
    if not is_drawn(text):
        return None
    found = _NAME.fullmatch(text)
    if found is None:
        raise ConfigError(
            f"robot = {show_value(text)}: must be like 'drawn:17', 'drawn:0-63' or "
            f"{', '.join(repr(PREFIX + name) for name in SPLITS)}"
        )
    first, last, split = found.groups()
    if split:
        return SPLITS[split]
    if not last:
        return None
    numbers = range(int(first), int(last) + 1)
    if not numbers:
        raise ConfigError(f"robot = {show_value(text)}: holds no robot")
    return numbers
