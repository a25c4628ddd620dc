"""Names of generated worlds, such as "clutter:test" and "mine.module:corridors:0-99"."""

from __future__ import annotations

import re
from dataclasses import dataclass

from acsar_gym.worlds import registry

_NUMBERS = r"(?::(train|validation|test|benchmark|\d{1,15}(?:-\d{1,15})?))?"
_KIND = re.compile(rf"([a-z_][a-z0-9_]*){_NUMBERS}")
_FOREIGN = re.compile(rf"((?:[A-Za-z_]\w*)(?:\.\w+)*):([a-z][a-z0-9_]*){_NUMBERS}", re.ASCII)


@dataclass(frozen=True, slots=True)
class Name:
    """The parts of a name of generated worlds."""

    module: str
    """Module to import first, which registers the generator; "" for none."""
    kind: str
    """The generator's name."""
    numbers: str
    """A split such as "train", "50" or "50-99"; "" where the name has none."""

    @property
    def generator(self) -> str:
        """The name without the numbers."""
        return f"{self.module}:{self.kind}" if self.module else self.kind


def parsed(text: str) -> Name | None:
    """Split a name into its parts; None for a text of another form. Imports nothing."""
    match = _KIND.fullmatch(text)
    if match:
        return Name("", match[1], match[2] or "")
    match = _FOREIGN.fullmatch(text)
    if match is None or match[1] in registry.BUILT_IN:
        return None
    return Name(match[1], match[2], match[3] or "")


def generated(text: str) -> Name | None:
    """Split a name of worlds whose generator is known; imports its module, if it names one.

    Args:
        text: a name, or anything else, such as a path.

    Returns:
        The parts; None where the text isn't such a name.

    Raises:
        WorldError: the module can't be imported, or registers no such generator.
    """
    name = parsed(text)
    if name is None:
        return None
    registry.imported(name.module, name.kind)
    return name if name.kind in registry.kinds() else None
