"""LiDARs on serial ports: one file a maker, found by the names of its models."""

from __future__ import annotations

import functools
import importlib
import pkgutil
from collections.abc import Callable

from acsar_gym.lidar.serial import Driver


@functools.cache
def find_drivers() -> dict[str, Callable[[], Driver]]:
    """Return what makes the drivers of this folder, by the model's name in a URL."""
    makers: dict[str, Callable[[], Driver]] = {}
    for file in pkgutil.iter_modules(__path__):
        module = importlib.import_module(f"{__name__}.{file.name}")
        for kind in vars(module).values():
            if isinstance(kind, type) and issubclass(kind, Driver):
                makers |= {model: functools.partial(kind, model) for model in kind.models}
    return dict(sorted(makers.items()))
