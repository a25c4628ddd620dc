"""Python objects by name: tasks, sensors and the like of other packages."""

from __future__ import annotations

import importlib
import sys
from typing import Any

from acsar_gym.errors import ConfigError, shown


def imported(what: str, name: str) -> Any:
    """The object of a module that is named "module:Class".

    Args:
        what: it is for, in the error's words, such as "task".
        name: of the module, which is imported, and of the object in it.

    Raises:
        ConfigError: there is none of that name.
    """
    module, _, attribute = name.partition(":")
    try:
        found: Any = importlib.import_module(module)
        for part in attribute.split("."):
            found = getattr(found, part)
    except (ImportError, AttributeError, ValueError) as error:
        raise ConfigError(f"{what} = {shown(name)}: {error}; must be like 'module:Class'") from None
    return found


def name_of(kind: type) -> str | None:
    """The "module:Class" that imports a class; None where none does, as for a local class."""
    found: Any = sys.modules.get(kind.__module__)
    for part in kind.__qualname__.split("."):
        found = getattr(found, part, None)
    importable = found is kind and kind.__module__ != "__main__"
    return f"{kind.__module__}:{kind.__qualname__}" if importable else None
