"""How soon wheels are commanded to stop after a fault of the driving program: `make stopping`.

Three processes take part: the emulator, whose log holds the times of commands; the program, which
drives at 100 Hz; and one that starts programs and causes faults. All use the same monotonic clock.
The measured time is from the fault to the first zero command at the emulator, which polls every
5 ms. While a cable is unplugged no command can arrive, so then it starts when the cable is plugged
in again.
"""

from __future__ import annotations

import argparse
import asyncio
import atexit
import concurrent.futures
import contextlib
import ctypes
import errno
import hashlib
import itertools
import math
import os
import pty
import random
import select
import signal
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import gamepad_tools
from rich.console import Console
from rich.table import Table
from serial_tools import Emulated, start

from acsar_gym.config import RobotConfig
from acsar_gym.errors import AcsarError
from acsar_gym.guard.estop import stop_all
from acsar_gym.links import open_link
from acsar_gym.links.serial import SerialLink
from acsar_gym.protocol import ZERO, Decoder
from acsar_gym.robot import Robot
from acsar_gym.testing import EmulatedBoard
from acsar_gym.tools import teleop
from acsar_gym.worlds import Scene

KINDS = {
    "kill": "SIGKILL",
    "fork": "SIGKILL while a forked child lives on",
    "stop": "SIGSTOP",
    "hang": "the policy sleeps for 5 s",
    "busy": "the policy never returns",
    "exception": "the policy raises an exception",
    "exit": "os._exit in the policy",
    "terminal": "the terminal is closed",
    "unplug": "unplug-replug; the program has ended",
    "reset": "unplug-replug; the program resets",
    "pid1-term": "SIGTERM to a container's PID 1",
    "pid1-hup": "SIGHUP to a container's PID 1",
    "thread-term": "SIGTERM while a thread drives",
    "thread-hup": "SIGHUP while a thread drives",
    "thread-end": "the program ends while a thread drives",
    "watchdog": "the watchdog is suspended",
    "estop-out": "acsar-gym estop while the cable is out",
    "estop-resets": "acsar-gym estop; the program resets",
    "waitpid": "the watchdog is suspended; waitpid is gevent's",
    "pause": "SIGSTOP of program and watchdog, then SIGCONT",
    "ctrl-z": "Ctrl-Z, then fg",
    "call-term": "SIGTERM in a C call while a thread drives",
    "call-hup": "SIGHUP in a C call while a thread drives",
    "call-quit": "SIGQUIT in a C call while a thread drives",
    "call-int": "Ctrl-C in a C call while a thread drives",
    "call-asyncio": "SIGTERM to asyncio in a C call; a thread drives",
    "to-thread": "Ctrl-C while asyncio.to_thread drives",
    "main-raises": "the main thread raises; another one drives",
    "pool": "the main thread raises; an executor's drives",
    "atexit": "sys.exit, slow atexit handler; a thread drives",
    "keys": "hands off the keyboard",
    "deadman": "the gamepad's deadman is let go",
    "pad-cable": "the gamepad's cable is pulled",
}
OWN_FAULTS = ("hang", "busy", "exception", "exit", "watchdog", "waitpid")
"""Kinds that a policy causes in its own program."""
REPLUGGED = ("unplug", "reset", "estop-out")
"""Kinds in which the cable is pulled and plugged in again."""
CONTAINED = ("pid1-term", "pid1-hup")
"""Kinds that need a new PID namespace."""
ESTOPPED = ("estop-out", "estop-resets")
"""Kinds that another process causes by an emergency stop."""
CALLING = ("call-term", "call-hup", "call-quit", "call-int", "call-asyncio")
"""Kinds in which the main thread is in C code, so that it runs no signal handler."""
MAIN_ENDS = ("thread-end", "main-raises", "pool", "atexit")
"""Kinds in which the main thread ends."""
THREADED = ("thread-term", "thread-hup", "to-thread", *CALLING, *MAIN_ENDS)
BY_HAND = ("keys", "deadman", "pad-cable")
"""Kinds in which a person drives; the fault is that the hands let go."""
PAUSED = ("pause", "ctrl-z")
"""Kinds in which the program is suspended and continued; the fault is that it goes on."""
SIGNALS = {
    "kill": signal.SIGKILL,
    "fork": signal.SIGKILL,
    "stop": signal.SIGSTOP,
    "pid1-term": signal.SIGTERM,
    "pid1-hup": signal.SIGHUP,
    "thread-term": signal.SIGTERM,
    "thread-hup": signal.SIGHUP,
    "call-term": signal.SIGTERM,
    "call-hup": signal.SIGHUP,
    "call-quit": signal.SIGQUIT,
    "call-int": signal.SIGINT,
    "call-asyncio": signal.SIGTERM,
    "to-thread": signal.SIGINT,
}
"""Signals sent to the program, by kind."""
LIMIT = 0.25
"""Required time from fault to zero command [s]."""
LIMITS = {"keys": 0.6, "deadman": 0.1, "pad-cable": 0.1}
"""The same where it isn't LIMIT. A key counts for 0.5 s, as terminals repeat one that is held."""
KEY_REPEAT = 1.0 / 30.0
"""Time between two repetitions of a key that is held [s]."""
HOLD_TIMEOUT = 30.0
"""Longest wait for a program that is driven by hand [s]."""
MAX_STARTS = 3
"""Attempts per trial, as a program may end or stop before its fault."""
ZERO_TIMEOUT = 3.0
"""Longest wait for a zero command [s]."""
QUIET_TIME = 1.0
"""Time after a zero command without other commands [s]; a reset takes half of it."""
UNPLUGGED = (0.05, 0.5)
"""Range of the random time for which a cable is unplugged [s]."""
TICKS = 30
"""Ticks before the fault, at least."""
FAULT_JITTER = 0.02
"""Range of the random delay before a fault [s]; two ticks."""
EPISODE_TICKS = 40
"""Ticks between two resets."""
PAUSE = (1.0, 3.0)
"""Range of the random time for which a program is suspended [s]."""
SLOW_EXIT = 3.0
"""Time that an atexit handler takes [s]."""
CLONE_NEWUSER, CLONE_NEWPID, PR_SET_PDEATHSIG = 0x10000000, 0x20000000, 1
"""Constants of Linux that Python has since 3.12."""


@dataclass(frozen=True, slots=True)
class Stops:
    """Times from one kind of fault to the zero command [s]; inf if none arrived."""

    kind: str
    times: tuple[float, ...]
    skipped: str = ""
    """Why this kind can't be tested on this computer; empty if it can."""

    @property
    def in_time(self) -> int:
        """Number of trials within the limit."""
        return sum(took <= self.limit for took in self.times)

    @property
    def limit(self) -> float:
        """Required time [s]."""
        return LIMITS.get(self.kind, LIMIT)

    @property
    def sound(self) -> bool:
        """Whether all trials were within the limit."""
        return self.in_time == len(self.times)


def measure(
    trials: int,
    kinds: Sequence[str] = tuple(KINDS),
    config: RobotConfig | None = None,
    board: str | None = None,
) -> Iterator[Stops]:
    """Run trials of each kind of fault on an emulated robot, each with a new program.

    `board` is the command of another program with the emulator's --log, --name, output and signals.
    """
    config = config or RobotConfig.of(None)
    skipped = no_namespace() if set(kinds) & set(CONTAINED) else ""
    with tempfile.TemporaryDirectory(prefix="acsar-stopping-") as folder:
        name, robot = Path(folder, "robot"), Path(folder, "robot.yaml")
        robot.write_text(config.model_dump_json(), encoding="utf-8")  # YAML contains JSON
        options = ("--name", str(name), *(() if board else ("--robot", str(robot))))
        emulated = start(Path(folder, "log.jsonl"), *options, board=board)
        try:
            with programs(str(name), config) as started:
                for kind in kinds:
                    if skipped and kind in CONTAINED:
                        yield Stops(kind, (), skipped)
                        continue
                    times = [_time_stop(kind, started, emulated, name) for _ in range(trials)]
                    yield Stops(kind, tuple(times))
        finally:
            emulated.end()


def _time_stop(kind: str, program: Programs, board: Emulated, name: Path) -> float:
    """Run one trial; returns the time from fault to zero command [s].

    It is repeated where the program ended before the fault, or the robot stood already: on a busy
    computer the watchdog may have stopped it.
    """
    for attempt in range(1, MAX_STARTS + 1):
        board.forget()
        try:
            fault = _cause_fault(kind, program, board, name)
        except AcsarError:
            program.bury()
            if attempt == MAX_STARTS:
                raise
            continue
        while time.monotonic() < fault + ZERO_TIMEOUT + QUIET_TIME:
            time.sleep(0.02)
            zero = _last_stop(board, fault)
            if fault <= zero <= time.monotonic() - QUIET_TIME:
                break
        program.bury()
        zero = _last_stop(board, fault)
        if zero >= fault:
            return zero - fault
    return math.inf


def _cause_fault(kind: str, program: Programs, board: Emulated, name: Path) -> float:
    """Cause a fault in a driving program; returns its time [s]. AcsarError: it didn't drive."""
    fault = program.fault(kind)
    if kind in REPLUGGED:
        board.pull()
        time.sleep(random.uniform(*UNPLUGGED))
        if kind in ESTOPPED:
            stop_all(str(name))
        fault = time.monotonic()
        board.plug()
    elif kind in ESTOPPED:
        fault = time.monotonic()
        stop_all(str(name))
    return fault


def _last_stop(board: Emulated, fault: float) -> float:
    """When the board was commanded to stop and not to drive again [s]; inf: it wasn't."""
    return find_stop(list_commands(board), fault)


def list_commands(board: EmulatedBoard) -> Iterator[tuple[float, bool]]:
    """When each command came [s], and whether it turned wheels."""
    decoder = Decoder()
    for event in board.events():
        for reading in decoder.feed(event.get("rx", "").encode("latin-1")):
            yield event["t"], reading.speeds != ZERO


def find_stop(commands: Iterable[tuple[float, bool]], fault: float) -> float:
    """When a robot was commanded to stop and not to drive again [s]; inf: it wasn't.

    That is the first zero command after the fault; or the last one, where all came before.

    Args:
        commands: when each came [s], and whether it turned wheels.
        fault: when that was [s].
    """
    zero = math.inf
    for when, turns in commands:
        if turns:
            zero = math.inf
        elif zero == math.inf or zero < fault:
            zero = when
    return zero


class Programs:
    """Starts driving programs and causes faults in them; client of `serve`."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process

    def fault(self, kind: str) -> float:
        """Start a program, let it drive, and cause a fault; returns its time [s, monotonic clock].

        Raises AcsarError where the program didn't drive.
        """
        answer = self._ask(kind)
        try:
            return float(answer)
        except ValueError:
            raise AcsarError(f"{kind}: the program didn't drive: {answer}") from None

    def bury(self) -> None:
        """End the program, if it still runs."""
        self._ask("")

    def _ask(self, line: str) -> str:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(f"{line}\n")
        self._process.stdin.flush()
        answer = self._process.stdout.readline().strip()
        if not answer:
            raise AcsarError("no programs any more: its own message says why")
        return answer


@contextlib.contextmanager
def programs(device: str, config: RobotConfig) -> Iterator[Programs]:
    """Run a process that starts programs and causes faults."""
    command = [sys.executable, __file__, "--serve", device, config.model_dump_json()]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True
    ) as process:
        try:
            yield Programs(process)
        finally:  # it ends its program before itself
            with contextlib.suppress(OSError, subprocess.TimeoutExpired):
                process.communicate(timeout=ZERO_TIMEOUT)
            process.kill()


def serve(device: str, config: str) -> None:
    """Fork a program for each kind of fault read from stdin, and print the time of the fault.

    The fork has all modules imported already. From there on it behaves like a separate program,
    including the shutdown of the interpreter; so `_drive` may return or raise from here.
    """
    robot = RobotConfig.model_validate_json(config)
    for line in sys.stdin:
        kind = line.strip()
        reader, writer = os.pipe()
        hands = (
            gamepad_tools.EmulatedPad(Path(tempfile.mkdtemp(), "hands"))
            if kind in BY_HAND
            else None
        )
        program, terminal = pty.fork() if kind == "terminal" else (os.fork(), -1)
        if program == 0:
            os.close(reader)
            if hands is not None:
                hands.let_go()
                _drive_by_hand(device, robot, kind, writer, hands.path)
                return
            if kind in CONTAINED:
                become_pid_1(writer)
            _drive(device, robot, kind, writer)
            return
        os.close(writer)
        try:
            with open(reader, encoding="ascii") as report:
                if hands is None:
                    print(_harm(kind, program, terminal, report), flush=True)
                else:
                    print(_hold_and_let_go(kind, hands, report), flush=True)
                sys.stdin.readline()
        finally:  # the program's children are in its session
            with contextlib.suppress(ProcessLookupError):
                os.killpg(program, signal.SIGKILL)
            os.waitpid(program, 0)
            if hands is not None:
                hands.pull()
        print("ended", flush=True)


def no_namespace() -> str:
    """Why this process can't create a PID namespace; empty if it can."""
    child = os.fork()
    if child == 0:
        os._exit(_unshare())
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    return f"no PID namespace here ({os.strerror(code)})" if code else ""


def _unshare() -> int:
    """Put the next child into a new PID namespace; returns 0 or an errno."""
    try:
        libc = ctypes.CDLL(None, use_errno=True)
        if libc.unshare(CLONE_NEWPID) == 0 or libc.unshare(CLONE_NEWUSER | CLONE_NEWPID) == 0:
            return 0
        return ctypes.get_errno()
    except (AttributeError, OSError):  # not Linux
        return errno.ENOSYS


def become_pid_1(writer: int) -> None:
    """Continue as PID 1 of a new namespace; a process outside reports its outer PID."""
    os.setsid()
    _unshare()
    inner = os.fork()
    if inner == 0:
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
        return
    os.write(writer, f"{inner}\n".encode())
    os.close(writer)
    status = os.waitstatus_to_exitcode(os.waitpid(inner, 0)[1])
    os._exit(status if status >= 0 else 128 - status)


def _harm(kind: str, program: int, terminal: int, report: IO[str]) -> str:
    """Wait until the program drives, cause the fault, and return its time."""
    first = report.readline().strip()
    if kind in CONTAINED and first.isdecimal():
        program, first = int(first), report.readline().strip()
    if not first.startswith("drives"):
        return first or "it ended"
    if kind in OWN_FAULTS or kind in MAIN_ENDS:
        return report.readline().strip() or "it ended"
    time.sleep(random.uniform(0.0, FAULT_JITTER))
    if kind in PAUSED:
        return repr(_pause(kind, program, int(first.removeprefix("drives "))))
    now = time.monotonic()
    if kind == "terminal":
        os.close(terminal)
    elif kind in SIGNALS:
        os.kill(program, SIGNALS[kind])
    return repr(now)


def _hold_and_let_go(kind: str, hands: gamepad_tools.EmulatedPad, report: IO[str]) -> str:
    """Drive by hand until the robot does, let go, and return the time."""
    if kind != "keys":
        hands.send(gamepad_tools.LB + gamepad_tools.FULL)
    patience = time.monotonic() + HOLD_TIMEOUT
    while not select.select([report], [], [], KEY_REPEAT)[0]:
        if kind == "keys":
            hands.type_keys(b"w")
        if time.monotonic() > patience:
            return "it doesn't drive"
    if (first := report.readline().strip()) != "drives":
        return first or "it ended"
    time.sleep(random.uniform(0.0, FAULT_JITTER))
    now = time.monotonic()
    if kind == "keys":
        hands.type_keys(b"w")  # for the last time
    elif kind == "deadman":
        hands.send(gamepad_tools.LET_GO)
    else:
        hands.pull()
    return repr(now)


def _drive_by_hand(device: str, config: RobotConfig, kind: str, writer: int, hands: Path) -> None:
    """Run `acsar-gym drive`, with `hands` as keyboard or gamepad; report when it has driven."""
    os.setsid()
    for number in (0, 1, 2):  # blessed reads keys only where it shows them
        os.dup2(os.open(hands if kind == "keys" else os.devnull, os.O_RDWR | os.O_NOCTTY), number)
    driven = itertools.count(1)

    class Reporting(Robot):
        def drive(self, linear: float, angular: float) -> None:
            super().drive(linear, angular)
            if linear and next(driven) == TICKS:
                os.write(writer, b"drives\n")

    robot = Reporting(open_link(device, config), config)
    with contextlib.suppress(AcsarError):
        if kind == "keys":
            teleop.drive_keyboard(robot)
        else:
            gamepad_tools.install()
            teleop.drive_gamepad(robot, str(hands))


def _pause(kind: str, program: int, watchdog: int) -> float:
    """Suspend the program, for "pause" with its watchdog; returns the time at which they go on.

    The program is first, as it notices a suspended watchdog at once, and would end in good order.
    """
    paused = [program, watchdog] if kind == "pause" else [program]
    for process in paused:
        os.kill(process, signal.SIGSTOP if kind == "pause" else signal.SIGTSTP)
    time.sleep(random.uniform(*PAUSE))
    random.shuffle(paused)
    now = time.monotonic()
    for process in paused:
        with contextlib.suppress(ProcessLookupError):  # the first one has ended the second
            os.kill(process, signal.SIGCONT)
    return now


def _drive(device: str, config: RobotConfig, kind: str, writer: int) -> None:
    """Run the driving program, which causes its own fault for some kinds."""
    if kind != "terminal":
        os.setsid()
    for number in (signal.SIGHUP, signal.SIGINT, signal.SIGTERM, signal.SIGQUIT, signal.SIGTSTP):
        signal.signal(number, signal.SIG_DFL)
    if SIGNALS.get(kind) == signal.SIGINT:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    os.dup2(os.open(os.devnull, os.O_RDWR), 2)
    with open(writer, "w", buffering=1, encoding="ascii") as report:
        robot = Robot(open_link(device, config), config)
        if kind in THREADED:
            _drive_in_a_thread(robot, kind, report)
            return
        try:
            _drive_until_harmed(robot, kind, report)
        except AcsarError as error:
            print(error, file=report)
        if kind == "reset":
            robot.activate()
            while True:
                robot.drive(0.0, 0.0)


def _drive_until_harmed(robot: Robot, kind: str, report: IO[str]) -> None:
    """Drive in the main thread until the fault."""
    robot.activate()
    if kind == "fork" and os.fork() == 0:
        time.sleep(30.0)
        os._exit(0)
    _go(robot, TICKS)
    print("drives", _watchdog_of(robot), file=report)
    _go(robot, random.randrange(3))
    if kind in OWN_FAULTS:
        print(repr(time.monotonic()), file=report)
        _cause(kind, robot)
    if kind in CONTAINED:
        _insist(robot)
    while kind in ESTOPPED:  # as a training loop that nobody watches
        with contextlib.suppress(AcsarError):
            _go(robot, EPISODE_TICKS)
        with contextlib.suppress(AcsarError):
            robot.reset(Scene())
        time.sleep(0.01)
    while True:
        _go(robot, 1)


def _drive_in_a_thread(robot: Robot, kind: str, report: IO[str]) -> None:
    """Drive in a thread, while the main thread waits, is in C code, or ends."""
    drives = threading.Event()

    def drive() -> None:
        """Drive until the process ends."""
        try:
            robot.activate()
            _go(robot, TICKS)
        except AcsarError as error:
            print(error, file=report)
        drives.set()
        _insist(robot)

    def wait() -> None:
        """Wait until the thread drives."""
        drives.wait()
        print("drives", file=report)

    if kind == "call-asyncio":
        asyncio.run(_call_in_a_loop(drive, wait))
    elif kind == "to-thread":
        asyncio.run(_await_a_thread(drive, wait))
    elif kind == "pool":
        concurrent.futures.ThreadPoolExecutor().submit(drive)
    else:
        threading.Thread(target=drive, daemon=kind != "main-raises").start()
    wait()
    if kind in CALLING:
        _call_c()
    elif kind in MAIN_ENDS:
        time.sleep(random.uniform(0.0, FAULT_JITTER))
        atexit.register(time.sleep, SLOW_EXIT if kind == "atexit" else 0.0)
        print(repr(time.monotonic()), file=report)
        if kind != "thread-end":
            raise SystemExit if kind == "atexit" else RuntimeError("a program's mistake")
    else:
        threading.Event().wait()


async def _call_in_a_loop(drive: Callable[[], None], wait: Callable[[], None]) -> None:
    """Call C code in an event loop that handles SIGTERM by itself, as a server does."""
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, lambda: None)
    threading.Thread(target=drive, daemon=True).start()
    wait()
    _call_c()


async def _await_a_thread(drive: Callable[[], None], wait: Callable[[], None]) -> None:
    """Wait for a thread of the event loop's executor."""
    await asyncio.gather(asyncio.to_thread(drive), asyncio.to_thread(wait))


def _call_c() -> None:
    """Stay in C code that leaves other threads alone, for about a minute."""
    hashlib.pbkdf2_hmac("sha512", b"", b"", 60_000_000)


def _insist(robot: Robot) -> None:
    """Drive, and after every error reset and drive again."""
    while True:
        with contextlib.suppress(AcsarError):
            robot.activate()
            _go(robot, 1)


def _go(robot: Robot, ticks: int) -> None:
    """Drive for some ticks."""
    for _ in range(ticks):
        robot.drive(0.2, 0.0)


def _cause(kind: str, robot: Robot) -> None:
    """Cause one of OWN_FAULTS, as a policy in its own program."""
    if kind == "hang":
        time.sleep(5.0)
    while kind == "busy":
        pass
    if kind == "exception":
        raise RuntimeError("a policy's mistake")
    if kind == "exit":
        os._exit(1)
    if kind == "waitpid":  # as gevent's: it doesn't tell that a process is suspended
        waitpid = os.waitpid
        os.waitpid = lambda process, options: waitpid(process, options & ~os.WUNTRACED)
    if kind in ("watchdog", "waitpid") and (watchdog := _watchdog_of(robot)):
        os.kill(watchdog, signal.SIGSTOP)


def _watchdog_of(robot: Robot) -> int:
    """The PID of the watchdog; 0 if there is none."""
    return (robot.link.watchdog.pid or 0) if isinstance(robot.link, SerialLink) else 0


def main() -> int:
    """Exit code 0 where every zero command came in time."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=40, help="of each kind of fault")
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS), metavar="KIND")
    parser.add_argument("--board", help="command that emulates the board; see `measure`")
    options = parser.parse_args()
    title = "from fault to zero command [ms]"
    drawn = Table("fault", "min", "median", "max", "in time", title=title)
    for column in drawn.columns[1:]:
        column.justify = "right"
    sound = True
    for stops in measure(options.trials, options.kinds, board=options.board):
        sound = sound and stops.sound
        cells = ["-", "-", "-", f"skipped: {stops.skipped}"]
        if times := stops.times:
            figures = (min(times), statistics.median(times), max(times))
            cells = [f"{figure * 1000.0:.1f}" for figure in figures]
            cells.append(f"{stops.in_time} of {len(times)} within {stops.limit * 1000.0:.0f}")
        drawn.add_row(KINDS[stops.kind], *cells)
        print(KINDS[stops.kind], *cells, sep="  ", file=sys.stderr)
    Console().print(drawn)
    return int(not sound)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--serve"]:
        serve(*sys.argv[2:])
    else:
        sys.exit(main())
