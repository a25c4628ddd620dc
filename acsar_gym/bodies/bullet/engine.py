"""PyBullet itself: the only file that imports it."""

from __future__ import annotations

import contextlib
import os
import re
import sys
from collections.abc import Iterator
from pathlib import Path

from acsar_gym.errors import MissingExtraError, RenderError


@contextlib.contextmanager
def _quiet_stderr() -> Iterator[None]:
    """Swallow the banner that PyBullet's C code prints when it is imported."""
    saved = os.dup(2)
    try:
        with open(os.devnull, "w") as sink:
            os.dup2(sink.fileno(), 2)
        yield
    finally:
        os.dup2(saved, 2)
        os.close(saved)


try:
    with _quiet_stderr():
        import pybullet
except ImportError:
    raise MissingExtraError("the PyBullet robot", "bullet") from None

__all__ = ["connected", "pybullet"]


def connected(window: bool) -> int:
    """A new client; RenderError where a window has no display."""
    if not window:
        return int(pybullet.connect(pybullet.DIRECT))
    if sys.platform.startswith("linux") and not _has_display(os.environ.get("DISPLAY", "")):
        raise RenderError("render_mode='human' needs a display; use render_mode='rgb_array'")
    client = int(pybullet.connect(pybullet.GUI))
    pybullet.configureDebugVisualizer(pybullet.COV_ENABLE_GUI, 0, physicsClientId=client)
    return client


def _has_display(name: str) -> bool:
    """Whether there is an X server; PyBullet would end the whole process without one."""
    local = re.fullmatch(r"(?:unix)?:(\d+)(?:\.\d+)?", name)
    return Path(f"/tmp/.X11-unix/X{local[1]}").exists() if local else bool(name)  # noqa: S108
