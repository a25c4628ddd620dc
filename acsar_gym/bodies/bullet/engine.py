"""Import PyBullet; no other file imports it."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator

from acsar_gym.bodies import display
from acsar_gym.errors import MissingExtraError, RenderError


@contextlib.contextmanager
def _quiet_stderr() -> Iterator[None]:
    """Hide the banner that PyBullet's C code prints when it is imported."""
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
    """Connect to a new PyBullet simulation.

    Args:
        window: whether it has a window.

    Returns:
        PyBullet's number of the connection.

    Raises:
        RenderError: a window is asked for, and there is no display.
    """
    if not window:
        return int(pybullet.connect(pybullet.DIRECT))
    if not display.found():
        raise RenderError("PyBullet's window needs a display; drive without a window here")
    client = int(pybullet.connect(pybullet.GUI))
    pybullet.configureDebugVisualizer(pybullet.COV_ENABLE_GUI, 0, physicsClientId=client)
    return client
