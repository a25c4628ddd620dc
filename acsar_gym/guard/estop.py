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
    TOO_MANY_FILES,
    EmergencyStopError,
    LinkError,
    SafetyWarning,
)
from acsar_gym.streams import print_error

FOLDER_VARIABLE = "ACSAR_GYM_RUNTIME_DIR"
"""Environment variable: parent of the folder with the sockets. It is /tmp by default, which, unlike
XDG_RUNTIME_DIR, is the same in services and terminals, and remains when the user logs out."""
OTHER_FOLDER = f"set {FOLDER_VARIABLE} to a folder of yours, the same in every terminal"
"""What to do if the folder can't be used."""

STOP = b"stop"
RELEASE = b"release"
MAX_REQUEST_BYTES = 64

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

ANSWER_TIMEOUT = 2.0  # longest wait for answers [s]. A control loop answers within a tick
STARTING_TIME = 1.0  # a younger socket that refuses requests may be about to listen [s]


def make_folder() -> Path:
    """Return the folder of this user's sockets, and create it if it doesn't exist.

    Raises:
        LinkError: It can't be created, or other users have access to it.
    """
    if os.name != "posix":
        raise LinkError("this operating system has no local sockets", "stop with Ctrl-C")
    name = f"acsar_gym-{os.getuid()}"
    folder = Path(os.environ.get(FOLDER_VARIABLE) or "/tmp", name)  # noqa: S108 - it is checked
    if not folder.is_absolute():
        raise LinkError(f"{folder}: isn't an absolute path", OTHER_FOLDER)

    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        status = folder.lstat()
    except OSError as error:
        raise LinkError(f"{folder}: can't be created: {error.strerror}", OTHER_FOLDER) from error

    is_private = stat.S_ISDIR(status.st_mode) and not status.st_mode & 0o077
    if not is_private or status.st_uid != os.getuid():
        raise LinkError(
            f"{folder}: isn't a folder that only you can access", f"remove it, or {OTHER_FOLDER}"
        )
    return folder


def _bind_socket(name: str) -> socket.socket:
    """Return a socket in the folder, whose name has a random number at its end.

    Processes in containers can have the same ID.

    Raises:
        LinkError: There can't be a socket.
    """
    path = make_folder() / f"{name}-{os.urandom(5).hex()}"
    bound = None
    try:
        bound = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        bound.setblocking(False)
        bound.bind(str(path))
    except OSError as error:
        if bound is not None:
            bound.close()
        is_full = error.errno in TOO_MANY_FILES
        advice = MORE_FILES_ADVICE if is_full else OTHER_FOLDER
        raise LinkError(f"{path}: no socket: {error.strerror or error}", advice) from error
    return bound


def _close_socket(bound: socket.socket) -> None:
    with contextlib.suppress(OSError):
        os.unlink(bound.getsockname())  # noqa: PTH108 - it is a string
    bound.close()


class _Process:
    """The emergency stop of this process: its socket, its requests, and whether a stop holds it."""

    def __init__(self) -> None:
        self.is_held = False
        self.fault: LinkError | None = None
        self.socket: socket.socket | None = None
        self._lock = threading.RLock()
        self._listeners: weakref.WeakSet[StopListener] = weakref.WeakSet()
        self._waiting: list[str] = []
        """Addresses that wait for the answer to a stop."""

    def listen(self) -> None:
        """Open the socket, unless it is open. If that fails, `fault` is the reason."""
        with self._lock:
            if self.socket is not None:
                return
            try:
                self.socket = _bind_socket(str(os.getpid()))
                self.fault = None
            except LinkError as error:
                self.fault = error

    def add(self, listener: StopListener) -> None:
        """Listen for a robot. Idempotent."""
        with self._lock:
            if listener not in self._listeners:
                # No loop reads the requests of a robot that is dropped and not closed. The newest
                # reference is called back first, and when this one is, the set must be without it.
                weakref.finalize(listener, self._note_drop)
                self._listeners.add(listener)
            self.listen()

    def _note_drop(self) -> None:
        with self._lock:
            self.read_requests()  # a stop that has arrived holds the process nevertheless
            self._close_if_unused()

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
        """Read the requests that have arrived, and answer if that is due, without blocking."""
        with self._lock:
            while self.socket is not None:
                try:
                    request, address = self.socket.recvfrom(MAX_REQUEST_BYTES)
                except OSError:  # there is none
                    break
                if request == STOP:
                    self.hold()
                    self._waiting.append(address)
                elif request == RELEASE:
                    answer = RELEASED if self.is_held else FREE
                    self.is_held = False
                    self._answer(answer, address)
                    self._close_if_unused()

            if self._waiting and not any(listener.is_pending for listener in self._listeners):
                is_connected = any(listener.is_connected for listener in self._listeners)
                answer = STOPPED if is_connected else HELD
                self._waiting = [to for to in self._waiting if not self._answer(answer, to)]

    def _answer(self, answer: bytes, address: str) -> bool:
        """Send an answer. Returns False if the queue of the sender is full, of many answers."""
        try:
            if self.socket is not None:
                self.socket.sendto(answer, address)
        except BlockingIOError:
            return False
        except (OSError, TypeError):  # the sender has ended, or has no address
            pass
        return True

    def hold(self) -> None:
        """Stop all robots of this process. Nothing drives until a person releases the stop."""
        with self._lock:
            self.is_held = True
            for listener in self._listeners:
                listener.is_pending = listener.is_connected

    def release(self) -> None:
        """Release the stop of this process: its robots drive after their next reset."""
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
hold_process = _process.hold
release_process = _process.release


class StopListener:
    """Receives emergency stops for a robot.

    If no socket can be opened, it receives nothing: a robot must be drivable on such a computer.

    Attributes:
        is_connected: Whether the robot is connected, so that an answer waits for its stop.
        is_pending: Whether the robot must be stopped, and `confirm` called.
    """

    def __init__(self) -> None:
        self.is_connected = False
        self.is_pending = False
        _process.add(self)

    def warn(self) -> None:
        """Warn (SafetyWarning) if no stop can be received."""
        if _process.fault is not None:
            message = f"'acsar-gym estop' can't stop this robot: {_process.fault}"
            warnings.warn(message, SafetyWarning, stacklevel=5)

    def connect(self) -> None:
        """Call when the robot is connected. A stop that holds the process stops it as well."""
        _process.add(self)  # a forked child has left its parent's socket
        self.is_connected = True
        self.is_pending = _process.is_held

    def is_requested(self) -> bool:
        """Return whether the robot must be stopped, without blocking."""
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


def is_held() -> bool:
    """Return whether an emergency stop holds this process."""
    return _process.is_held


def check_released() -> None:
    """Raise EmergencyStopError if a stop that no person has released holds this process."""
    _process.read_requests()
    if _process.is_held:
        _process.listen()  # for the release, as a held process may have no robot yet
        raise EmergencyStopError


def try_listening() -> Path:
    """Return the folder in which this process receives stops.

    Raises:
        LinkError: It can't receive any.
    """
    with contextlib.closing(StopListener()):
        if _process.fault is not None:
            raise _process.fault
        return make_folder()


def check_available(device: str) -> None:
    """Raise LinkError, with the reason, unless `acsar-gym estop` can stop this program."""
    try:
        try_listening()
    except LinkError as error:
        message = f"{device}: 'acsar-gym estop' couldn't stop this robot: {error.found}"
        raise LinkError(message, error.fix) from error


class Answer(NamedTuple):
    """The answer of a process that drives real robots, which is empty if none came in time."""

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
    try:
        asker = _bind_socket("estop")
    except LinkError:  # as on a full disk: requests are sent, but no answers come
        if not names:  # in a folder whose path is too long, no process can listen either
            raise
        asker = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        asker.setblocking(False)
    answers = {name: b"" for name in names if _send_request(asker, folder / name, request)}

    deadline = time.monotonic() + ANSWER_TIMEOUT
    while not all(answers.values()) and time.monotonic() < deadline:
        asker.settimeout(max(deadline - time.monotonic(), 0.0))
        with contextlib.suppress(OSError, TypeError):  # none came, or without an address
            text, address = asker.recvfrom(MAX_REQUEST_BYTES)
            answers[Path(address).name] = text
    _close_socket(asker)
    return sorted(Answer(int(name.partition("-")[0]), text) for name, text in answers.items())


def _send_request(asker: socket.socket, path: Path, request: bytes) -> bool:
    """Send a request, and return whether a process listens. Sockets of the dead are removed."""
    try:
        asker.sendto(request, str(path))
    except BlockingIOError:  # it hasn't read earlier requests
        pass
    except OSError:
        with contextlib.suppress(OSError):
            if time.time() - path.stat().st_mtime > STARTING_TIME:
                path.unlink()
        return False
    return True


def run_command(*, release: bool = False) -> int:
    """Run `acsar-gym estop`: stop robots, or release them. Returns the exit code."""
    request = RELEASE if release else STOP
    try:
        answers = release_all() if release else stop_all()
    except LinkError as error:
        print_error(f"acsar-gym: {error}")
        return error.exit_code

    for answer in answers:
        print(f"process {answer.process}: {REPORTS.get(answer.text, SILENCE_REPORTS[request])}")
    if not answers:
        print(NO_DRIVERS)
    return 0 if answers and all(answer.text for answer in answers) else 1
