"""Emergency stop from another terminal: an owner-only socket in the file system, no network port.

Every process that drives a real robot listens on a socket of its own, which its control loop looks
at once a tick. A datagram there stops its robots, and is answered when they have been stopped.
"""

from __future__ import annotations

import contextlib
import os
import socket
import stat
import time
from dataclasses import dataclass
from pathlib import Path

from acsar_gym.errors import LinkError

ANSWER = 2.0
"""How long a stop waits for each process [s]; a control loop answers within a tick."""
STOP = b"stop"


@dataclass(frozen=True, slots=True)
class Stopped:
    """What became of one process that drives a robot."""

    process: int
    answered: bool
    """Whether it said that its wheels were commanded to stop."""


def folder() -> Path:
    """Where the sockets are: readable and writable by their owner alone.

    The same in every environment of a user's, as /run/user isn't; ACSAR_GYM_RUNTIME_DIR overrides
    it. Raises LinkError where it can't be made, somebody else has made it, or there are no such
    sockets, as on Windows.
    """
    if not hasattr(socket, "AF_UNIX") or not hasattr(os, "getuid"):
        raise LinkError("this operating system has no local sockets", "stop with Ctrl-C")
    base = Path(os.environ.get("ACSAR_GYM_RUNTIME_DIR") or "/tmp")  # noqa: S108 - checked below
    path = base / f"acsar_gym-{os.getuid()}"
    try:
        path.mkdir(mode=0o700, exist_ok=True)
        found = path.lstat()
    except OSError as error:
        raise LinkError(f"{path}: can't be made a folder: {error.strerror}", "make room") from None
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid() or found.st_mode & 0o077:
        raise LinkError(f"{path}: isn't a folder of yours alone", "remove it")
    return path


class Ears:
    """A socket that hears an emergency stop.

    Where it can't be opened it stays deaf: a robot must be drivable on a computer without such
    sockets, and Ctrl-C stops it everywhere.
    """

    _count = 0

    def __init__(self) -> None:
        self._socket: socket.socket | None = None
        self._path: Path | None = None
        self._process = os.getpid()
        self._asker = ""
        with contextlib.suppress(OSError, LinkError):
            Ears._count += 1
            path = folder() / f"{self._process}-{Ears._count}"
            made = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
            try:
                made.setblocking(False)
                path.unlink(missing_ok=True)
                made.bind(str(path))
                path.chmod(0o600)
            except OSError:
                made.close()
                raise
            self._socket, self._path = made, path

    def heard(self) -> bool:
        """Whether somebody has asked for a stop; waits for nothing."""
        if self._socket is None or self._process != os.getpid():
            return False
        try:
            data, self._asker = self._socket.recvfrom(len(STOP))
        except OSError:  # nothing there
            return False
        return data == STOP

    def answer(self) -> None:
        """Tell whoever asked that the wheels have been commanded to stop."""
        if self._socket is not None and self._asker:
            with contextlib.suppress(OSError):
                self._socket.sendto(STOP, self._asker)

    def close(self) -> None:
        """Twice is once; a forked child leaves its parent's socket alone."""
        ears, self._socket = self._socket, None
        if ears is not None:
            ears.close()
            if self._path is not None and self._process == os.getpid():
                self._path.unlink(missing_ok=True)

    def __reduce__(self) -> tuple[type[Ears], tuple[()]]:
        """Copies listen on sockets of their own."""
        return Ears, ()

    def __del__(self) -> None:
        if hasattr(self, "_socket"):
            self.close()


def stop_all() -> list[Stopped]:
    """Ask every process of this user that drives a robot to stop, and wait for its answer."""
    place = folder()
    mine = place / f"estop-{os.getpid()}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as asker:
        asker.bind(str(mine))
        try:
            asker.settimeout(ANSWER)
            drivers = [path for path in sorted(place.iterdir()) if path.name[0].isdigit()]
            asked = [path for path in drivers if _ask(asker, path)]
            answered = _answers(asker, len(asked))
        finally:
            mine.unlink(missing_ok=True)
    return [Stopped(int(path.name.split("-")[0]), path.name in answered) for path in asked]


def _ask(asker: socket.socket, path: Path) -> bool:
    """Whether somebody listens there; the socket of a dead process is removed."""
    try:
        asker.sendto(STOP, str(path))
    except ConnectionRefusedError:
        path.unlink(missing_ok=True)
        return False
    except OSError:
        return False
    return True


def _answers(asker: socket.socket, count: int) -> set[str]:
    """Names of the sockets that have answered in time."""
    found: set[str] = set()
    deadline = time.monotonic() + ANSWER
    while len(found) < count and time.monotonic() < deadline:
        with contextlib.suppress(TimeoutError):
            _, sender = asker.recvfrom(len(STOP))
            found.add(Path(sender).name)
    return found
