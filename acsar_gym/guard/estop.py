"""Emergency stop from another terminal, by sockets in folders that only their owner can use.

Every process that drives a real robot has such sockets, and its control loop reads them once a
tick, and while it waits for its port and board. A datagram stops its robots, and is answered when
they have been stopped. From then on nothing in that process drives, whatever it resets, opens or
makes anew, until a person releases it. This module imports the standard library only, so that
`acsar-gym estop` acts at once.
"""

from __future__ import annotations

import atexit
import contextlib
import errno
import os
import re
import select
import socket
import stat
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import ClassVar

from acsar_gym.errors import (
    MORE_FILES_ADVICE,
    EmergencyStopError,
    LinkError,
    SafetyWarning,
    escape_unprintable,
)
from acsar_gym.streams import print_error

SESSION_FOLDERS = Path("/run/user")  # of users who are logged in, each their own
SHARED_FOLDER = Path("/tmp")  # noqa: S108 - what is found there is checked
"""A folder in which everybody can create files; it exists on every system."""
FOLDER_VARIABLE = "ACSAR_GYM_RUNTIME_DIR"  # environment variable: a folder instead of these two
MAX_FOLDER_PATH = 80  # bytes, as a socket's address has at most 103 on every system
OTHER_FOLDER = f"set {FOLDER_VARIABLE} to a folder of yours, in every terminal the same"
"""What to do where a folder can't be used."""


def list_candidates() -> list[Path]:
    """List the folders for sockets. Drivers listen in all of them, and a stop asks in all of them.

    A process that was started before its user logged in knows only the shared folder; where another
    user has made that, only the session's works. Unlike XDG_RUNTIME_DIR, both are always the same.
    """
    name = f"acsar_gym-{os.getuid()}"
    if os.environ.get(FOLDER_VARIABLE):
        return [Path(os.environ[FOLDER_VARIABLE]) / name]
    session, folders = SESSION_FOLDERS / str(os.getuid()), [SHARED_FOLDER / name]
    with contextlib.suppress(OSError):
        status = session.lstat()
        ours = stat.S_ISDIR(status.st_mode) and status.st_uid == os.getuid()
        if ours and not status.st_mode & 0o22:  # nobody else can create files in it
            folders.insert(0, session / name)
    return folders


def make_folder(path: Path) -> Path:
    """Make a folder, with its parents, that only its owner can use; LinkError where it can't be."""
    if not path.is_absolute():  # it would be another one in another terminal
        raise LinkError(f"{path}: isn't an absolute path", OTHER_FOLDER)
    if len(os.fsencode(path)) > MAX_FOLDER_PATH:
        raise LinkError(
            f"{path}: too long for the address of a socket",
            f"set {FOLDER_VARIABLE} to a folder of a shorter path",
        )
    try:
        for folder in reversed((path, *path.parents)):
            # A file in the way is named by the next folder's error.
            with contextlib.suppress(FileExistsError):
                if not folder.is_dir():
                    folder.mkdir(mode=0o700)
        status = path.lstat()
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or str(error)
        raise LinkError(f"{path}: can't be made a folder: {why}", OTHER_FOLDER) from error
    if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.getuid() or status.st_mode & 0o077:
        raise LinkError(f"{path}: isn't a folder of yours alone", f"remove it, or {OTHER_FOLDER}")
    return path


def find_folders() -> tuple[list[Path], list[LinkError]]:
    """The folders that can be used, and the errors of the others."""
    if not hasattr(socket, "AF_UNIX") or not hasattr(os, "getuid"):
        return [], [LinkError("this operating system has no local sockets", "stop with Ctrl-C")]
    usable, wrong = [], []
    for path in list_candidates():
        try:
            usable.append(make_folder(path))
        except LinkError as error:
            wrong.append(error)
    return usable, wrong


ANSWER_TIMEOUT = 2.0  # how long a stop waits for answers [s]; a control loop answers within a tick
STOP_REQUEST = b"stop"
"""Request to stop, or to stop the robot whose name follows; also the answer that it stopped."""
HELD_ANSWER = b"held"  # answer to a stop: no robot is connected, and none will be driven
RELEASE_REQUEST = b"release"  # likewise
FREE_ANSWER = b"free"  # answer to a release: there was no stop
WHO_REQUEST = b"who"  # request to tell the names of the robot
OTHER_ANSWER = b"other"
"""Beginning of the answer of a robot that wasn't meant, or was asked for its names."""
MAX_REQUEST_BYTES = 8192  # most bytes of a request or an answer
HIDDEN = "."  # before the name of a socket that doesn't listen yet
NUMBER_BYTES = 5
"""Random bytes of a socket's number, so that no address is given out twice: not to another thread,
not to a process of the same id in a container, and not to one after this one."""
RESEND_PERIOD = 0.01  # how soon a request is sent again that found a full queue [s]
MAX_REQUESTS = 8  # requests that are read in one tick


@dataclass(frozen=True, slots=True)
class StopResult:
    """The result of a stop for one process that drives a robot."""

    process: int
    answered: bool
    """Whether it confirmed that it stopped."""
    connected: bool = True
    """Whether that commanded wheels to stop; False where no robot was connected."""

    def __str__(self) -> str:
        if not self.answered:
            return "doesn't answer: its watchdog stops wheels that turn, and it stops when it hears"
        if self.connected:
            return "stopped"
        return "isn't connected to its robot, and won't drive it when it is"


@dataclass(frozen=True, slots=True)
class ReleaseResult:
    """The result of a release for one process that drives a robot."""

    process: int
    answered: bool
    was_stopped: bool

    def __str__(self) -> str:
        if not self.answered:
            return "doesn't answer: it is released when it hears"
        return "released: it drives after its next reset" if self.was_stopped else "wasn't stopped"


@dataclass(frozen=True, slots=True)
class DriverProcess:
    """A process that listens while it drives a robot."""

    process: int
    since: float
    """Since when it listens, seconds since 1970."""
    device: str
    """Device of the robot; empty where the process doesn't answer."""
    name: str
    """Name of the robot; empty where it has none, or the process doesn't answer."""
    recording: str
    """File that the process records to; empty where it doesn't record, or doesn't answer."""


class StopListener:
    """Receives emergency stops, on one socket in each usable folder.

    Where no socket can be opened nothing is received, and `unavailable` says why: a robot must be
    drivable on such a computer. After a stop it stays open until the release, even where its robot
    is closed meanwhile.

    Attributes: `paths`, the addresses; `faults`, the errors of folders that can't be used;
    `closed`, whether its robot is; `held`, all listeners of this process that are stopped.
    """

    held: ClassVar[list[StopListener]] = []

    def __init__(self, device: str = "", name: str = "", recording: str = "") -> None:
        self._about = (device, name, recording)
        self._identity = b"\t".join((OTHER_ANSWER, *map(os.fsencode, self._about)))
        real = os.path.realpath(device) if device.startswith("/") else device
        names = {device, os.path.basename(device), real, os.path.basename(real), name}  # noqa: PTH119
        self._names = {os.fsencode(alias) for alias in names if alias} | {b"%d" % os.getpid()}
        self._sockets: list[socket.socket] = []
        self.paths: list[Path] = []
        self._process = os.getpid()
        self._waiting: list[tuple[socket.socket, str]] = []
        self._unsent: list[tuple[socket.socket, bytes, str, float]] = []
        self.closed = False
        usable, self.faults = find_folders()
        name = f"{os.getpid()}-{_make_number()}"
        for folder in usable:
            path = folder / name
            try:
                self._sockets.append(_bind_listener(path))
                self.paths.append(path)
            except OSError as error:
                fix = OTHER_FOLDER
                if error.errno in (errno.EMFILE, errno.ENFILE):
                    fix = f"close robots that aren't driven: {MORE_FILES_ADVICE}"
                why = f"{path}: no socket: {error.strerror or error}"
                self.faults.append(LinkError(why, fix))

    @staticmethod
    def check_available(device: str) -> None:
        """Raise LinkError, which says why, unless a stop would reach a program that drives."""
        listener = StopListener()
        paths, faults = listener.paths, listener.faults
        listener.close()
        if not paths:
            why = "; ".join(fault.found for fault in faults)
            fixes = "; ".join(dict.fromkeys(fault.fix for fault in faults if fault.fix))
            raise LinkError(f"{device}: 'acsar-gym estop' couldn't stop this robot: {why}", fixes)

    @property
    def unavailable(self) -> str:
        """Why no stop can be received; empty where it can."""
        return "" if self._sockets else "; ".join(map(str, self.faults))

    def warn(self) -> None:
        """Warn (SafetyWarning) where no stop can be received."""
        if why := self.unavailable:
            warnings.warn(f"'acsar-gym estop' can't stop this robot: {why}", SafetyWarning, 5)

    def is_requested(self) -> bool:
        """Whether a stop of this robot has been requested; doesn't block."""
        if self._unsent:
            unsent, self._unsent = self._unsent, []
            for answer in unsent:
                self._answer(*answer)
        for listening in self._sockets if self._process == os.getpid() else ():
            with contextlib.suppress(OSError):  # no datagram
                for _ in range(MAX_REQUESTS):
                    self._take_request(listening, *listening.recvfrom(MAX_REQUEST_BYTES))
        return bool(self._waiting)

    def _take_request(self, listening: socket.socket, data: bytes, sender: str) -> None:
        """Take a request, and answer it at once where it isn't a stop of this robot."""
        request, _, names = data.partition(b" ")
        is_meant = not names or not self._names.isdisjoint(names.split(b"\0"))
        if request == STOP_REQUEST and is_meant:
            self.hold()
            self._waiting.append((listening, sender))
        elif request == RELEASE_REQUEST and is_meant:
            answer = RELEASE_REQUEST if self in self.held else FREE_ANSWER
            self._drop_hold()  # before the answer, which says that it is released
            self._answer(listening, answer, sender)
            self.release()
        elif request in (STOP_REQUEST, RELEASE_REQUEST, WHO_REQUEST):
            self._answer(listening, self._identity, sender)

    def confirm(self, *, connected: bool = True) -> None:
        """Answer the requests for a stop."""
        with contextlib.suppress(IndexError):  # another thread may add or take one meanwhile
            while True:
                listening, sender = self._waiting.pop()
                self._answer(listening, STOP_REQUEST if connected else HELD_ANSWER, sender)

    def _answer(
        self, listening: socket.socket, data: bytes, sender: str, deadline: float | None = None
    ) -> None:
        """Send an answer; one that finds the other's queue full goes along with the next tick."""
        try:
            listening.sendto(data, sender)
        except BlockingIOError:  # it takes ten at a time, and many robots may answer it
            deadline = deadline or time.monotonic() + ANSWER_TIMEOUT
            if time.monotonic() < deadline:
                self._unsent.append((listening, data, sender, deadline))
        except (OSError, TypeError):  # it ended, or its socket has no address
            pass

    def hold(self) -> None:
        """Let nothing in this process drive before the release."""
        if self not in self.held:
            self.held.append(self)

    def release(self) -> None:
        """Let this process drive again, after its next reset, unless another robot's stop holds."""
        self._drop_hold()
        if self.closed:
            self._close_sockets()

    def _drop_hold(self) -> None:
        # What a fork has inherited can't be reached by name, so that it goes along.
        process = os.getpid()
        for listener in self.held.copy():
            if listener is self or listener._process != process:  # noqa: SLF001
                with contextlib.suppress(ValueError):  # another thread has dropped it
                    self.held.remove(listener)

    def close(self) -> None:
        """Close the sockets, after a stop once it is released; idempotent.

        A forked child doesn't remove its parent's sockets.
        """
        self.closed = True
        if self.is_requested():
            self.confirm(connected=False)
        if self not in self.held:
            self._close_sockets()

    def _close_sockets(self) -> None:
        sockets, self._sockets = self._sockets, []
        for listening, path in zip(sockets, self.paths, strict=True):
            listening.close()
            if self._process == os.getpid():
                with contextlib.suppress(OSError):
                    path.unlink()
        self.paths = []

    def __reduce__(self) -> tuple[type[StopListener], tuple[str, str, str]]:
        """Copies and pickles listen on sockets of their own, for the same robot."""
        return StopListener, self._about

    def __del__(self) -> None:
        if hasattr(self, "faults"):
            self.close()


def check_released() -> None:
    """Raise EmergencyStopError where a stop holds this process; a person has to release it."""
    for listener in StopListener.held.copy():
        if listener.is_requested() and listener.closed:  # else its robot answers when it stopped
            listener.confirm(connected=False)
    if StopListener.held:
        raise EmergencyStopError


def release_process() -> None:
    """Release all stops of this process."""
    for listener in StopListener.held.copy():
        listener.release()


@atexit.register
def _remove_sockets() -> None:
    """Remove the sockets of stopped robots; nothing is released, as threads may go on driving."""
    for listener in StopListener.held:
        listener._close_sockets()  # noqa: SLF001


def _make_number() -> int:
    return int.from_bytes(os.urandom(NUMBER_BYTES))


def _bind_listener(path: Path) -> socket.socket:
    """A new socket that listens at this address, which it gets when it listens.

    Between the two halves of a bind it would refuse requests, and a stop would remove it.
    """
    hidden = path.with_name(HIDDEN + path.name)
    listener = _bind_socket(hidden)
    try:
        hidden.rename(path)
    except OSError:
        listener.close()
        raise
    return listener


def _bind_socket(path: Path) -> socket.socket:
    """Return a socket at this address; FileExistsError or EADDRINUSE where there is something."""
    ours = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    try:
        ours.setblocking(False)
        ours.bind(str(path))
        path.chmod(0o600)
    except OSError:
        ours.close()
        raise
    return ours


def stop_all(name: str = "") -> list[StopResult]:
    """Ask this user's processes that drive a robot to stop, and wait for the answers.

    Args:
        name: Of one robot: its device, the last part of that, the name in its configuration, or
            the id of the process. Empty for all robots.

    Returns:
        One result for each process, by its id, without those that drive another robot.

    Raises:
        LinkError: no folder can be used.
    """
    return [
        StopResult(
            _process_of(socket_name), answer in (STOP_REQUEST, HELD_ANSWER), answer != HELD_ANSWER
        )
        for socket_name, answer in _ask_drivers(STOP_REQUEST, name)
        if not answer.startswith(OTHER_ANSWER)
    ]


def release_all(name: str = "") -> list[ReleaseResult]:
    """Release stops likewise; the processes may drive again after their next reset."""
    return [
        ReleaseResult(
            _process_of(socket_name),
            answer in (RELEASE_REQUEST, FREE_ANSWER),
            answer == RELEASE_REQUEST,
        )
        for socket_name, answer in _ask_drivers(RELEASE_REQUEST, name)
        if not answer.startswith(OTHER_ANSWER)
    ]


def list_drivers() -> list[DriverProcess]:
    """List the processes of this user that drive a robot; LinkError where no folder can be used."""
    drivers = []
    for socket_name, answer in _ask_drivers(WHO_REQUEST):
        _, *identity = (*answer.split(b"\t", 3), b"", b"", b"")[:4]
        since = 0.0
        for folder in find_folders()[0]:
            with contextlib.suppress(OSError):
                since = max(since, (folder / socket_name).stat().st_mtime)
        drivers.append(DriverProcess(_process_of(socket_name), since, *map(os.fsdecode, identity)))
    return drivers


def _find_sockets(folder: Path) -> list[Path]:
    """Addresses of all listeners in a folder; named by a process's id and a number."""
    try:
        return [path for path in folder.iterdir() if re.fullmatch("[0-9]+-[0-9]+", path.name)]
    except OSError:  # the folder was removed meanwhile
        return []


def _process_of(socket_name: str) -> int:
    return int(socket_name.split("-", maxsplit=1)[0])


def _ask_drivers(request: bytes, name: str = "") -> list[tuple[str, bytes]]:
    """Send a request to listeners; names of their sockets, and answers, b"" for none."""
    if name:
        real = os.path.realpath(name) if "/" in name else name
        request += b" " + os.fsencode(name) + b"\0" + os.fsencode(real)
    usable, wrong = find_folders()
    if not usable:
        raise wrong[0]
    answers: dict[str, bytes] = {}
    with contextlib.ExitStack() as stack:
        askers = [stack.enter_context(_open_asker(folder)) for folder in usable]
        unsent = [
            (asker, path)
            for folder, asker in zip(usable, askers, strict=True)
            for path in _find_sockets(folder)
        ]
        poll = select.poll()  # select.select refuses descriptors from 1,024 on
        for asker in askers:
            poll.register(asker, select.POLLIN)
        deadline = time.monotonic() + ANSWER_TIMEOUT
        while True:
            unsent = [pair for pair in unsent if not _send_request(*pair, request, answers)]
            left = deadline - time.monotonic()
            if left <= 0.0 or (all(answers.values()) and not unsent):
                break
            poll.poll(1000.0 * (min(left, RESEND_PERIOD) if unsent else left))
            for asker in askers:
                with contextlib.suppress(OSError, TypeError):
                    answer, sender = asker.recvfrom(MAX_REQUEST_BYTES)
                    sender = Path(sender).name.removeprefix(HIDDEN)
                    # Of two sockets of one listener, the other may have been asked before.
                    if answer != FREE_ANSWER or not answers.get(sender):
                        answers[sender] = answer
    return sorted(answers.items(), key=lambda item: _process_of(item[0]))


@contextlib.contextmanager
def _open_asker(folder: Path) -> Iterator[socket.socket]:
    """A socket that sends requests. If it can't be bound, it still sends, but gets no answers."""
    path = folder / f"estop-{os.getpid()}-{_make_number()}"
    try:
        asker = _bind_socket(path)
    except OSError:
        asker = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        asker.setblocking(False)
    with asker:
        yield asker
    with contextlib.suppress(OSError):
        path.unlink()


def _send_request(
    asker: socket.socket, path: Path, request: bytes, answers: dict[str, bytes]
) -> bool:
    """Send a request, note in `answers` that somebody listens; whether that is done.

    It isn't where the listener's queue is full. Removes the socket of a dead process.
    """
    try:
        asker.sendto(request, str(path))
    except ConnectionRefusedError:
        with contextlib.suppress(OSError):
            if path.is_socket():
                path.unlink()
        return True
    except FileNotFoundError:
        return True
    except OSError:
        answers.setdefault(path.name, b"")
        return False
    answers.setdefault(path.name, b"")
    return True


def run_command(name: str = "", *, listing: bool = False, release: bool = False) -> int:
    """Run `acsar-gym estop`: stop robots, release them, or list who drives them; the exit code."""
    try:
        if listing:
            return _print_drivers()
        results: Sequence[StopResult | ReleaseResult] = (release_all if release else stop_all)(name)
        for result in results:
            print(f"process {result.process}: {result}")
        if not results and name and list_drivers():
            robot = escape_unprintable(name)
            print(f"no robot {robot} is being driven from this computer; these are:")
        if not results:
            _print_drivers()
    except LinkError as error:
        print_error(f"acsar-gym: {escape_unprintable(str(error))}")
        return error.exit_code
    return 0 if results and all(result.answered for result in results) else 1


def _print_drivers() -> int:
    """Print who drives a robot; exit code 1 where nobody does."""
    drivers = list_drivers()
    for driver in drivers:
        since = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(driver.since))
        robot = escape_unprintable(driver.device or "doesn't answer")
        called = f" ({escape_unprintable(driver.name)})" if driver.name else ""
        print(f"{robot}{called}: process {driver.process}, since {since}")
    if not drivers:
        print(
            "you drive no robot from this computer; "
            "'sudo -u USER acsar-gym estop' stops what another user drives"
        )
    return 0 if drivers else 1


def parse_stop(arguments: list[str]) -> Callable[[], int] | None:
    """Return what runs `acsar-gym estop` with these arguments; None for others than it knows."""
    options = [argument for argument in arguments if argument.startswith("-")]
    names = [argument for argument in arguments if not argument.startswith("-")]
    if len(names) > 1 or options not in ([], ["--list"], ["--release"]):
        return None
    if options == ["--list"] and names:
        return None
    return partial(run_command, *names, listing="--list" in options, release="--release" in options)
