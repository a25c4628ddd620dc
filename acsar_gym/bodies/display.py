"""Find out whether a window can be opened."""

from __future__ import annotations

import os
import re
import sys
from pathlib import Path


def found() -> bool:
    """Whether there is an X server; without one PyBullet's window would end the whole process."""
    if not sys.platform.startswith("linux"):
        return True
    name = os.environ.get("DISPLAY", "")
    local = re.fullmatch(r"(?:unix)?:(\d+)(?:\.\d+)?", name)
    return Path(f"/tmp/.X11-unix/X{local[1]}").exists() if local else bool(name)  # noqa: S108
