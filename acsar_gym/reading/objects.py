"""Python objects by name: tasks, sensors and the like of other packages."""

from __future__ import annotations

import importlib
import sys
from types import FunctionType
from typing import Any

from acsar_gym.errors import AcsarError, ConfigError, shortened, shown


def imported(what: str, name: str) -> Any:
    """The object of a module that is named "module:Class".

    Args:
        what: it is for, in the error's words, such as "task".
        name: of the module, which is imported, and of the object in it.

    Raises:
        ConfigError: there is none of that name, or its module can't be imported.
    """
    module, _, attribute = name.partition(":")
    if not all(part.isidentifier() for part in (*module.split("."), *attribute.split("."))):
        raise ConfigError(f"{what} = {shown(name)}: must be like 'module:Class'")
    try:
        found: Any = importlib.import_module(module)
        for part in attribute.split("."):
            found = getattr(found, part)
    except AcsarError:
        raise
    except (ImportError, AttributeError) as error:
        raise ConfigError(
            f"{what} = {shown(name)}: {_one_line(error)}; must be like 'module:Class'"
        ) from None
    except (Exception, SystemExit) as error:
        said = f"{type(error).__name__}: {_one_line(error)}"
        raise ConfigError(
            f"{what} = {shown(name)}: the module {module} can't be imported: {said}"
        ) from error
    return found


def _one_line(error: BaseException) -> str:
    """The message of an error, shortened and without line breaks."""
    return shortened(" ".join(str(error).split()), 300)


def name_of(kind: type | FunctionType) -> str | None:
    """The "module:name" that imports a class or function; None where none does: a local one."""
    found: Any = sys.modules.get(kind.__module__)
    for part in kind.__qualname__.split("."):
        found = getattr(found, part, None)
    importable = found is kind and kind.__module__ != "__main__"
    return f"{kind.__module__}:{kind.__qualname__}" if importable else None
