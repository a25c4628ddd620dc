"""Values of recipes that RL Zoo evaluates as Python, read without running any code."""

from __future__ import annotations

import ast
import importlib
from types import TracebackType
from typing import Any

from acsar_gym.errors import ConfigError, shown

NETWORKS = "torch.nn"
"""Module of the names that begin with "nn."."""


class Named:
    """A context that puts a name in front of every ConfigError.

    Args:
        name: such as "ppo.yml: acsar_gym/Barn-v1: policy_kwargs".
    """

    def __init__(self, name: str) -> None:
        self._name = name

    def __enter__(self) -> None:
        return None

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if isinstance(error, ConfigError):
            raise ConfigError(f"{self._name}: {error}") from None


def arguments(given: Any) -> dict[str, Any]:
    """Read arguments: a mapping, or a string such as "dict(net_arch=[64], activation_fn=nn.ELU)".

    Values are literals, names of torch.nn ("nn.ELU"), and get_class_by_name("module.Class").

    Args:
        given: the value in the YAML file.

    Raises:
        ConfigError: it is anything else.
    """
    if isinstance(given, str):
        try:
            given = _value(ast.parse(given.strip(), mode="eval").body)
        except (SyntaxError, TypeError, ValueError, RecursionError, MemoryError):
            raise ConfigError(f"{shown(given)}: must be like dict(net_arch=[64, 64])") from None
    if not isinstance(given, dict) or not all(isinstance(name, str) for name in given):
        raise ConfigError(f"{shown(given)}: must be arguments by name")
    return dict(given)


def schedule(text: str) -> Any:
    """Read "lin_VALUE", a number that falls linearly to zero over the training.

    Raises:
        ConfigError: it is anything else.
    """
    from stable_baselines3.common.utils import LinearSchedule  # noqa: PLC0415 - imports torch

    kind, _, value = text.partition("_")
    try:
        if kind == "lin":
            return LinearSchedule(float(value), 0.0, 1.0)
    except ValueError:
        pass
    raise ConfigError(f"{shown(text)}: must be a number, or like lin_0.001")


def imported(name: str) -> Any:
    """Import "package.module.Class"; a name without dots is returned as it is.

    Raises:
        ConfigError: there is no such module or class.
    """
    module, _, kind = name.rpartition(".")
    if not module:
        return name
    try:
        return getattr(importlib.import_module(module), kind)
    except (ImportError, AttributeError) as error:
        raise ConfigError(f"{name}: {' '.join(str(error).split())}") from None


def _value(node: ast.expr) -> Any:
    """Compute the value of a parsed expression; ValueError for what isn't allowed."""
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
        return _call(node, node.func.id)
    if isinstance(node, ast.Attribute) and ast.unparse(node.value) in ("nn", "th.nn", "torch.nn"):
        return imported(f"{NETWORKS}.{node.attr}")
    if isinstance(node, ast.List | ast.Tuple):
        values = [_value(each) for each in node.elts]
        return values if isinstance(node, ast.List) else tuple(values)
    if isinstance(node, ast.Dict):
        keys = [ast.literal_eval(key) if key else None for key in node.keys]
        return dict(zip(keys, map(_value, node.values), strict=True))
    return ast.literal_eval(node)


def _call(node: ast.Call, name: str) -> Any:
    """Compute dict(...) or get_class_by_name("...")."""
    if name == "dict" and len(node.args) < 2 and all(word.arg for word in node.keywords):
        first = _value(node.args[0]) if node.args else {}
        return dict(first) | {str(word.arg): _value(word.value) for word in node.keywords}
    if name == "get_class_by_name" and len(node.args) == 1 and not node.keywords:
        return imported(str(ast.literal_eval(node.args[0])))
    raise ValueError(name)
