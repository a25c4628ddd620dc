"""Emergency stop from another terminal, through one socket of each process that drives real robots.

The sockets are in a folder that only their user can access. A control loop reads its process's
socket in each tick, and while it waits for a port or a board. A request to stop holds the process:
nothing in it drives, whatever it resets, opens or creates, until a person releases it. The answer
is sent when the wheels of all connected robots have been commanded to stop.

This module imports the standard library only, so that `acsar-gym estop` acts at once.
"""

from __future__ import annotations

import atexit
import contextlib
import errno
import os
import re
import socket
import stat
import threading
import time
import warnings
import weakref
from pathlib import Path
from typing import NamedTuple

from acsar_gym.errors import (
    MORE_FILES_ADVICE,
    EmergencyStopError,
    LinkError,
    SafetyWarning,
    escape_unprintable,
)
from acsar_gym.streams import print_error

SHARED_FOLDER = Path("/tmp")  # noqa: S108 - only a folder in it that belongs to the user is used
"""Parent of the folder with the sockets. Unlike XDG_RUNTIME_DIR it is the same in services and in
terminals, and remains when the user logs out."""
FOLDER_VARIABLE = "ACSAR_GYM_RUNTIME_DIR"  # environment variable: another parent
MAX_FOLDER_PATH = 80  # bytes, as the address of a socket has at most 103 on every system
OTHER_FOLDER = f"set {FOLDER_VARIABLE} to a folder of yours, the same in every terminal"
"""What to do if the folder can't be used."""

STOP = b"stop"
RELEASE = b"release"
MAX_REQUEST_BYTES = 64
MAX_REQUESTS = 8  # requests that are read in one tick

STOPPED = b"stopped"  # answer to a stop: all connected robots have been commanded to stop
HELD = b"held"  # answer to a stop: no robot is connected, and none will be driven
RELEASED = b"released"  # answer to a release
FREE = b"free"  # answer to a release: there was no stop
REPORTS = {
    STOPPED: "stopped",
    HELD: "isn't connected to its robot, and won't drive it when it is",
    RELEASED: "released: it drives after its next reset",
    FREE: "wasn't stopped",
}
"""What `acsar-gym estop` prints for each answer."""
SILENCE_REPORTS = {
    STOP: "no reply: its watchdog stops wheels that turn, and it stops once it reads the request",
    RELEASE: "no reply: it is released once it reads the request",
}
"""What it prints if a process doesn't answer a request."""
NO_DRIVERS = (
    "no robot of yours is being driven from this computer: 'sudo -u USER acsar-gym estop' stops "
    "the robots of another user"
)

ANSWER_TIMEOUT = 2.0  # longest wait for answers [s]; a control loop answers within a tick
RESEND_PERIOD = 0.01  # a request is sent again this long after it met a full queue [s]
STARTING_TIME = 1.0  # a socket refuses requests just before it listens; if it is older, forever [s]


def make_folder() -> Path:
    """Return the folder of this user's sockets; it is created if it doesn't exist.

    Raises:
        LinkError: It can't be created, or other users have access to it.
    """
    if not hasattr(socket, "AF_UNIX") or not hasattr(os, "getuid"):
        raise LinkError("this operating system has no local sockets", "stop with Ctrl-C")
    parent = Path(os.environ.get(FOLDER_VARIABLE) or SHARED_FOLDER)
    folder = parent / f"acsar_gym-{os.getuid()}"
    if not folder.is_absolute():
        raise LinkError(f"{folder}: isn't an absolute path", OTHER_FOLDER)
    if len(os.fsencode(folder)) > MAX_FOLDER_PATH:
        raise LinkError(
            f"{folder}: too long for the address of a socket",
            f"set {FOLDER_VARIABLE} to a folder with a shorter path",
        )

    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        status = folder.lstat()
    except OSError as error:
        why = f"{folder}: can't be created: {error.strerror}"
        raise LinkError(why, OTHER_FOLDER) from error
    is_private = stat.S_ISDIR(status.st_mode) and not status.st_mode & 0o077
    if not is_private or status.st_uid != os.getuid():
        raise LinkError(
            f"{folder}: isn't a folder that only you can access", f"remove it, or {OTHER_FOLDER}"
        )
    return folder


def _bind_socket(name: str) -> socket.socket:
    """Return a socket in the folder; LinkError if there can't be one.

    A random number follows its name, as processes in containers can have the same ID.
    """
    path = make_folder() / f"{name}-{os.urandom(5).hex()}"
    try:
        bound = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        try:
            bound.setblocking(False)
            bound.bind(str(path))
        except OSError:
            bound.close()
            raise
    except OSError as error:
        has_no_files = error.errno in (errno.EMFILE, errno.ENFILE)
        fix = MORE_FILES_ADVICE if has_no_files else OTHER_FOLDER
        raise LinkError(f"{path}: no socket: {error.strerror}", fix) from error
    return bound


def _close_socket(bound: socket.socket) -> None:
    path = bound.getsockname()
    bound.close()
    with contextlib.suppress(OSError):
        os.unlink(path)  # noqa: PTH108 - it is a string


class _Process:
    """The emergency stop of this process: its socket, its requests, and whether a stop holds it."""

    def __init__(self) -> None:
        self.is_held = False
        self.fault: LinkError | None = None
        self.socket: socket.socket | None = None
        self._lock = threading.RLock()
        self._listeners: weakref.WeakSet[StopListener] = weakref.WeakSet()
        self._stopping: list[str] = []
        """Addresses that wait for the answer to a stop."""
        self._answers: list[tuple[bytes, str]] = []
        """Answers that haven't been sent, and their addresses."""

    def listen(self) -> None:
        """Open the socket if it isn't open; `fault` is the reason if that fails."""
        with self._lock:
            if self.socket is not None:
                return
            try:
                self.socket = _bind_socket(str(os.getpid()))
                self.fault = None
            except LinkError as error:
                self.fault = error

    def add(self, listener: StopListener) -> None:
        """Listen for one robot more."""
        with self._lock:
            self._listeners.add(listener)
            self.listen()

    def remove(self, listener: StopListener) -> None:
        """Close the socket with the last robot, unless a release must reach this process."""
        with self._lock:
            self._listeners.discard(listener)
            self._close_if_unused()

    def _close_if_unused(self) -> None:
        if not self._listeners and not self.is_held:
            self.close()

    def close(self) -> None:
        """Close the socket."""
        with self._lock:
            if self.socket is not None:
                _close_socket(self.socket)
                self.socket = None

    def read_requests(self) -> None:
        """Take the requests that have arrived, and answer what has been done; doesn't block."""
        with self._lock:
            if self.socket is None:
                return
            with contextlib.suppress(OSError):  # there is no request
                for _ in range(MAX_REQUESTS):
                    request, address = self.socket.recvfrom(MAX_REQUEST_BYTES)
                    if request == STOP:
                        self.hold()
                        self._stopping.append(address)
                    elif request == RELEASE:
                        self._answers.append((RELEASED if self.is_held else FREE, address))
                        self.is_held = False
            if self._stopping or self._answers:
                self._answer(self.socket)
                self._close_if_unused()

    def _answer(self, bound: socket.socket) -> None:
        """Send answers; if a receiver's queue is full, the next call tries again."""
        if not any(listener.is_pending for listener in self._listeners):
            is_connected = any(listener.is_connected for listener in self._listeners)
            answer = STOPPED if is_connected else HELD
            self._answers += [(answer, address) for address in self._stopping]
            self._stopping.clear()

        for answer, address in self._answers.copy():
            try:
                bound.sendto(answer, address)
            except BlockingIOError:
                continue
            except (OSError, TypeError):  # the asking process has ended, or has no address
                pass
            self._answers.remove((answer, address))

    def hold(self) -> None:
        """Stop all connected robots at their next tick, and let nothing drive until a release."""
        with self._lock:
            self.is_held = True
            for listener in self._listeners:
                listener.is_pending = listener.is_connected

    def release(self) -> None:
        """Let robots drive after their next reset."""
        with self._lock:
            self.is_held = False
            self._close_if_unused()

    def leave_parent(self) -> None:
        """Leave the socket to the parent in a forked child, which a stop holds as well."""
        if self.socket is not None:
            self.socket.close()
        is_held = self.is_held
        self.__init__()  # type: ignore[misc]  # a thread of the parent may hold the lock
        self.is_held = is_held


_process = _Process()
atexit.register(_process.close)
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_process.leave_parent)


class StopListener:
    """Receives emergency stops for a robot.

    If no socket can be opened, it receives nothing, and `unavailable` is the reason: a robot must
    be drivable on such a computer.

    Attributes:
        is_connected: Whether the robot is connected, so that an answer waits for its stop.
        is_pending: Whether the robot must be stopped, and `confirm` called.
    """

    def __init__(self) -> None:
        self.is_connected = False
        self.is_pending = False
        _process.add(self)

    @property
    def unavailable(self) -> str:
        """Why no stop can be received; empty if it can."""
        return str(_process.fault or "")

    def warn(self) -> None:
        """Warn (SafetyWarning) if no stop can be received."""
        if self.unavailable:
            message = f"'acsar-gym estop' can't stop this robot: {self.unavailable}"
            warnings.warn(message, SafetyWarning, 5)

    def connect(self) -> None:
        """Call when the robot is connected. A stop that holds the process stops it as well."""
        self.is_connected = True
        self.is_pending = _process.is_held

    def is_requested(self) -> bool:
        """Return whether the robot must be stopped; doesn't block."""
        _process.read_requests()
        return self.is_pending

    def confirm(self) -> None:
        """Call when the wheels have been commanded to stop."""
        self.is_pending = False
        _process.read_requests()

    def disconnect(self) -> None:
        """Call when the robot is no longer connected."""
        self.is_connected = False
        self.confirm()

    def close(self) -> None:
        """Disconnect, and stop listening. Idempotent."""
        self.disconnect()
        _process.remove(self)


def hold_process() -> None:
    """Stop all connected robots of this process; none drives until a person releases the stop."""
    _process.hold()


def is_held() -> bool:
    """Return whether an emergency stop holds this process."""
    return _process.is_held


def check_released() -> None:
    """Raise EmergencyStopError if a stop holds this process; a person has to release it."""
    _process.read_requests()
    if _process.is_held:
        _process.listen()  # for the release, as a held process may have no robot yet
        raise EmergencyStopError


def release_process() -> None:
    """Release the stop of this process: its robots drive after their next reset."""
    _process.release()


def try_listening() -> Path:
    """Return the folder in which this process receives stops.

    Raises:
        LinkError: It can't receive any.
    """
    with contextlib.closing(StopListener()):
        if _process.socket is None:
            raise _process.fault or LinkError("no socket")
        return Path(_process.socket.getsockname()).parent


def check_available(device: str) -> None:
    """Raise LinkError, with the reason, unless `acsar-gym estop` can stop this program."""
    try:
        try_listening()
    except LinkError as error:
        why = f"{device}: 'acsar-gym estop' couldn't stop this robot: {error.found}"
        raise LinkError(why, error.fix) from error


class Answer(NamedTuple):
    """The answer of a process that drives real robots; empty if there was none in time."""

    process: int
    text: bytes


def stop_all() -> list[Answer]:
    """Ask all processes of this user to stop their robots, and wait for the answers.

    Raises:
        LinkError: The folder of their sockets can't be used.
    """
    return _ask_processes(STOP)


def release_all() -> list[Answer]:
    """Release the stops of all processes of this user. Errors as for `stop_all`."""
    return _ask_processes(RELEASE)


def _ask_processes(request: bytes) -> list[Answer]:
    folder = make_folder()
    names = [path.name for path in folder.iterdir() if re.fullmatch("[0-9]+-[0-9a-f]+", path.name)]
    answers = dict.fromkeys(names, b"")
    unsent = names
    try:
        asker = _bind_socket("estop")
    except LinkError:  # as on a full disk: requests are sent, but no answers come
        asker = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    asker.settimeout(RESEND_PERIOD)

    deadline = time.monotonic() + ANSWER_TIMEOUT
    while not all(answers.values()) and time.monotonic() < deadline:
        unsent = [
            name for name in unsent if not _send_request(asker, folder / name, request, answers)
        ]
        with contextlib.suppress(OSError, TypeError):  # no answer, or of a process without address
            text, address = asker.recvfrom(MAX_REQUEST_BYTES)
            answers[Path(address).name] = text
    _close_socket(asker)
    return sorted(Answer(int(name.partition("-")[0]), text) for name, text in answers.items())


def _send_request(
    asker: socket.socket, path: Path, request: bytes, answers: dict[str, bytes]
) -> bool:
    """Send a request, and return whether that is finished: it isn't if the queue is full.

    A process that doesn't listen is removed from the answers; if it is dead, its socket as well.
    """
    try:
        asker.sendto(request, str(path))
    except TimeoutError:
        return False
    except OSError:
        del answers[path.name]
        with contextlib.suppress(OSError):
            if time.time() - path.stat().st_mtime > STARTING_TIME:
                path.unlink()
    return True


def run_command(*, release: bool = False) -> int:
    """Run `acsar-gym estop`: stop robots, or release them; returns the exit code."""
    request = RELEASE if release else STOP
    try:
        answers = _ask_processes(request)
    except LinkError as error:
        print_error(f"acsar-gym: {escape_unprintable(str(error))}")
        return error.exit_code
    for answer in answers:
        print(f"process {answer.process}: {REPORTS.get(answer.text, SILENCE_REPORTS[request])}")
    if not answers:
        print(NO_DRIVERS)
    return 0 if answers and all(answer.text for answer in answers) else 1
