"""The folders in which robots listen for an emergency stop; only their owner can use them."""

from __future__ import annotations

import os
import socket
import stat
from pathlib import Path

from acsar_gym.errors import LinkError

SESSIONS = Path("/run/user")
"""Has a folder for each user who is logged in, in which nobody else can create files."""
SHARED = Path("/tmp")  # noqa: S108 - what is found there is checked
"""A folder in which everybody can create files; it exists on every system."""
ELSEWHERE = "ACSAR_GYM_RUNTIME_DIR"
"""Environment variable that names a folder to use instead of these two."""
LONGEST = 80
"""Most bytes of a folder's path, because the address of a socket has at most 103 on every
system."""


def candidates() -> list[Path]:
    """List the folders for sockets. Drivers listen in all of them, and a stop asks in all of them.

    A process that was started before its user logged in knows only the shared folder. Where
    another user has made a folder of that name there, only the session's folder works. Both paths
    are the same in every environment of a user, unlike XDG_RUNTIME_DIR and TMPDIR.
    """
    name = f"acsar_gym-{os.getuid()}"
    if os.environ.get(ELSEWHERE):
        return [Path(os.environ[ELSEWHERE]) / name]
    session = SESSIONS / str(os.getuid())
    return [*([session / name] if _is_ours(session) else []), SHARED / name]


def _is_ours(path: Path) -> bool:
    """Whether this is a folder in which nobody else can create files."""
    try:
        found = path.lstat()
    except OSError:
        return False
    return stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & 0o22


def made(path: Path) -> Path:
    """Make a folder that only its owner can use, if it doesn't exist, and return its path.

    Raises:
        LinkError: it can't be made, its path is too long, or others can use it.
    """
    if len(os.fsencode(path)) > LONGEST:
        raise LinkError(
            f"{path}: too long for the address of a socket",
            f"set {ELSEWHERE} to a folder of a shorter path",
        )
    try:
        path.mkdir(mode=0o700, exist_ok=True)
        found = path.lstat()
    except OSError as error:
        raise LinkError(f"{path}: can't be made a folder: {error.strerror}", "make room") from None
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid() or found.st_mode & 0o077:
        raise LinkError(
            f"{path}: isn't a folder of yours alone",
            f"remove it, or set {ELSEWHERE} to a folder of yours, in every terminal the same",
        )
    return path


def folders() -> tuple[list[Path], list[LinkError]]:
    """The folders that can be used, and the errors of the others."""
    if not hasattr(socket, "AF_UNIX") or not hasattr(os, "getuid"):
        return [], [LinkError("this operating system has no local sockets", "stop with Ctrl-C")]
    usable, wrong = [], []
    for path in candidates():
        try:
            usable.append(made(path))
        except LinkError as error:
            wrong.append(error)
    return usable, wrong
