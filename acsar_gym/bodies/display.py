"""Whether a window can open here."""

from __future__ import annotations

import os
import re
import sys
from pathlib import Path


def found() -> bool:
    """Whether there is an X server; PyBullet would end the whole process without one."""
    if not sys.platform.startswith("linux"):
        return True
    name = os.environ.get("DISPLAY", "")
    local = re.fullmatch(r"(?:unix)?:(\d+)(?:\.\d+)?", name)
    return Path(f"/tmp/.X11-unix/X{local[1]}").exists() if local else bool(name)  # noqa: S108
