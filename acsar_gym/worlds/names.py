"""Names of generated worlds, such as "clutter:test" and "mine.module:corridors:0-99"."""

from __future__ import annotations

import re
from dataclasses import dataclass

from acsar_gym.worlds import registry

_NUMBERS = r"(?::(train|test|\d{1,15}(?:-\d{1,15})?))?"
_KIND = re.compile(rf"([a-z_][a-z0-9_]*){_NUMBERS}")
_FOREIGN = re.compile(rf"((?:[A-Za-z_]\w*)(?:\.\w+)*):([a-z][a-z0-9_]*){_NUMBERS}", re.ASCII)


@dataclass(frozen=True, slots=True)
class Name:
    """What the name of some generated worlds says."""

    module: str
    """What to import first, which registers the generator; "" for what is known already."""
    kind: str
    """The generator's name."""
    numbers: str
    """"train", "test", "50" or "50-99"; "" where nothing is said."""

    @property
    def generator(self) -> str:
        """The name without the numbers."""
        return f"{self.module}:{self.kind}" if self.module else self.kind


def parsed(text: str) -> Name | None:
    """The parts of a name; None for what has another form. It imports nothing."""
    match = _KIND.fullmatch(text)
    if match:
        return Name("", match[1], match[2] or "")
    match = _FOREIGN.fullmatch(text)
    if match is None or match[1] in registry.BUILT_IN:
        return None
    return Name(match[1], match[2], match[3] or "")


def generated(text: str) -> Name | None:
    """The name of worlds whose generator is known, or registered by the module that it names.

    None for anything else, such as a path. Raises WorldError where that module can't be imported,
    or registers no such generator.
    """
    name = parsed(text)
    if name is None:
        return None
    registry.imported(name.module, name.kind)
    return name if name.kind in registry.kinds() else None
