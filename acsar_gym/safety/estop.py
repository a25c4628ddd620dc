"""Emergency stop from another terminal, by sockets in folders that only their owner can use.

Every process that drives a real robot has such sockets, and its control loop reads them once a
tick. A datagram stops its robots, and is answered when they have been stopped. This module imports
the standard library only, so that `acsar-gym estop` acts at once.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import re
import select
import socket
import stat
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from acsar_gym.errors import LinkError, printable

ANSWER = 2.0
"""How long a stop waits for answers [s]; a control loop answers within a tick."""
STOP = b"stop"
SESSIONS = Path("/run/user")
"""Has a folder for each user who is logged in, in which nobody else can create files."""
SHARED = Path("/tmp")  # noqa: S108 - what is found there is checked
"""A folder in which everybody can create files; it exists on every system."""
ELSEWHERE = "ACSAR_GYM_RUNTIME_DIR"
"""Environment variable that names a folder to use instead of these two."""
LONGEST = 80
"""Most bytes of a folder's path, because the address of a socket has at most 103 on every
system."""
DRIVER = re.compile(r"[0-9]+-[0-9]+")
"""Name of a listener's socket: process id and a number."""


@dataclass(frozen=True, slots=True)
class Stopped:
    """The result of a stop for one process that drives a robot."""

    process: int
    answered: bool
    """Whether it confirmed that its wheels were commanded to stop."""


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


class StopListener:
    """Receives emergency stops, on one socket in each usable folder.

    Where no socket can be opened nothing is received, and `unavailable` says why: a robot must be
    drivable on a computer without such sockets, and Ctrl-C stops it everywhere.

    Attributes: `paths`, the addresses; `faults`, the errors of folders that can't be used.
    """

    def __init__(self) -> None:
        self._sockets: list[socket.socket] = []
        self.paths: list[Path] = []
        self._process = os.getpid()
        self._askers: list[tuple[socket.socket, str]] = []
        usable, self.faults = folders()
        name = _free_name(usable)
        for folder in usable:
            path = folder / name
            try:
                self._sockets.append(_bound(path))
                self.paths.append(path)
            except OSError as error:
                self.faults.append(LinkError(f"{path}: no socket: {error.strerror}", "make room"))

    @property
    def unavailable(self) -> str:
        """Why no stop can be received; empty where it can."""
        return "" if self._sockets else "; ".join(map(str, self.faults))

    def is_requested(self) -> bool:
        """Whether a stop has been requested; doesn't block."""
        self._askers = []
        for each in self._sockets if self._process == os.getpid() else ():
            with contextlib.suppress(OSError):  # no datagram
                data, sender = each.recvfrom(len(STOP))
                if data == STOP:
                    self._askers.append((each, sender))
        return bool(self._askers)

    def confirm(self) -> None:
        """Answer the requests: the wheels have been commanded to stop."""
        for each, sender in self._askers:
            with contextlib.suppress(OSError, TypeError):  # ended, or its socket has no address
                each.sendto(STOP, sender)

    def close(self) -> None:
        """Close the sockets; idempotent. A forked child doesn't remove its parent's sockets."""
        sockets, self._sockets = self._sockets, []
        for each, path in zip(sockets, self.paths, strict=True):
            each.close()
            if self._process == os.getpid():
                with contextlib.suppress(OSError):
                    path.unlink()
        self.paths = []

    def __reduce__(self) -> tuple[type[StopListener], tuple[()]]:
        """Copies and pickles listen on sockets of their own."""
        return StopListener, ()

    def __del__(self) -> None:
        if hasattr(self, "faults"):
            self.close()


def _free_name(usable: list[Path]) -> str:
    """A name with this process's id at which nobody listens in any of the folders.

    Processes in containers that share a folder can have the same id.
    """
    names = (f"{os.getpid()}-{number}" for number in itertools.count(1))
    return next(name for name in names if not any(_is_taken(path / name) for path in usable))


def _is_taken(path: Path) -> bool:
    """Whether somebody listens on this socket."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(str(path))
        except (ConnectionRefusedError, FileNotFoundError):
            return False
        except OSError:  # another user's socket
            return True
    return True


def _bound(path: Path) -> socket.socket:
    """A socket at this address; replaces the file that a dead process of the same id has left."""
    ours = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    try:
        ours.setblocking(False)
        path.unlink(missing_ok=True)
        ours.bind(str(path))
        path.chmod(0o600)
    except OSError:
        ours.close()
        raise
    return ours


def stop_all() -> list[Stopped]:
    """Ask every process of this user that drives a robot to stop, and wait for the answers.

    Returns:
        One result for each process, by process id.

    Raises:
        LinkError: no folder can be used.
    """
    usable, wrong = folders()
    if not usable:
        raise wrong[0]
    asked: set[str] = set()
    with contextlib.ExitStack() as stack:
        askers = [stack.enter_context(_asker(folder)) for folder in usable]
        for folder, asker in zip(usable, askers, strict=True):
            asked |= {path.name for path in _drivers(folder) if _ask(asker, path)}
        answered = _answers(askers, asked)
    return [Stopped(_process(name), name in answered) for name in sorted(asked, key=_process)]


def _process(name: str) -> int:
    """The process id in a socket's name."""
    return int(name.split("-", maxsplit=1)[0])


@contextlib.contextmanager
def _asker(folder: Path) -> Iterator[socket.socket]:
    """A socket that sends requests. If it can't be bound, it still sends, but gets no answers."""
    path = folder / f"estop-{os.getpid()}"
    try:
        asker = _bound(path)
    except OSError:
        asker = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        asker.setblocking(False)
    with asker:
        yield asker
    with contextlib.suppress(OSError):
        path.unlink()


def _drivers(folder: Path) -> list[Path]:
    """Addresses of all listeners in a folder."""
    try:
        return [path for path in folder.iterdir() if DRIVER.fullmatch(path.name)]
    except OSError:  # the folder was removed meanwhile
        return []


def _ask(asker: socket.socket, path: Path) -> bool:
    """Send a request; False where nobody listens. Removes the socket of a dead process."""
    try:
        asker.sendto(STOP, str(path))
    except ConnectionRefusedError:
        with contextlib.suppress(OSError):
            if path.is_socket():
                path.unlink()
        return False
    except FileNotFoundError:
        return False
    except OSError:  # the process is suspended and its queue is full: it stops when it resumes
        return True
    return True


def _answers(askers: list[socket.socket], asked: set[str]) -> set[str]:
    """Wait for answers; returns the names of the sockets that have answered in time."""
    found: set[str] = set()
    deadline = time.monotonic() + ANSWER
    while not asked <= found and (left := deadline - time.monotonic()) > 0.0:
        ready, _, _ = select.select(askers, [], [], left)
        for asker in ready:
            with contextlib.suppress(OSError, TypeError):
                _, sender = asker.recvfrom(len(STOP))
                found.add(Path(sender).name)
    return found


def command() -> int:
    """Run `acsar-gym estop`: stop all robots, print the results, and return the exit code."""
    try:
        found = stop_all()
    except LinkError as error:
        print(f"acsar-gym: {printable(str(error))}", file=sys.stderr)
        return error.exit_code
    for each in found:
        said = "stopped" if each.answered else "doesn't answer: its watchdog stops it"
        print(f"process {each.process}: {said}")
    if not found:
        print("no robot is being driven from this computer")
    return 0 if found and all(each.answered for each in found) else 1
