"""Whatever holds the program up or ends it, a zero command reaches the board soon."""

from __future__ import annotations

import contextlib
import fcntl
import gc
import json
import math
import os
import select
import signal
import sys
import threading
import time
import tty
from collections.abc import Callable, Iterator
from pathlib import Path

import psutil
import pytest
from nursery import ended, first_line, program
from rich.console import Console
from serial_tools import BRIDGE, DRIVER, Emulated, no_leak, wait_until

from acsar_gym import Robot, RobotConfig, open_link
from acsar_gym.doctor import stopping, stopping_processes
from acsar_gym.doctor.stopping_programs import KINDS
from acsar_gym.errors import AcsarError, ConfigError, LinkError
from acsar_gym.links import ports, watchdog
from acsar_gym.links.serial import SerialLink
from acsar_gym.links.watchdog import Watchdog
from acsar_gym.links.watchdog_child import (
    BEAT,
    LAST_WORDS,
    PAGE,
    REPEATS,
    STANDS,
    STOOD,
    SURE,
    TRIPPED,
    Watch,
)
from acsar_gym.protocol import ZERO, Decoder, encode
from acsar_gym.worlds import Scene

pytestmark = [
    pytest.mark.usefixtures("deadline", "nursery"),
    pytest.mark.xdist_group("serial"),
]

TURNING = encode((3.0, 3.0, 3.0, 3.0))
ZEROS = b"\r\n" + encode(ZERO)
TIMEOUT_OF_DOG = 0.15
HASTY = 0.5
"""Time-out of a watchdog that shall trip, and not before a busy machine has gone on [s]."""
WATCHED = (
    DRIVER
    + f"""
config = config.with_(watchdog_timeout={HASTY})
robot = Robot(open_link(sys.argv[1], config), config)
"""
)
DRIVE = "robot.activate(); drive(10**9)"


def children() -> list[psutil.Process]:
    """Watchdogs of this process, living and dead; a dead process has no command line."""

    def watches(process: psutil.Process) -> bool:
        with contextlib.suppress(psutil.Error):
            return any("watchdog_child" in part for part in process.cmdline())
        return True

    return [child for child in psutil.Process().children() if watches(child)]


def commands(emulator: Emulated) -> list[tuple[float, bool]]:
    """When each command arrived, and whether it turns wheels."""
    decoder = Decoder()
    return [
        (float(event["t"]), reading.speeds != ZERO)
        for event in emulator.events()
        for reading in decoder.feed(event.get("rx", "").encode("latin-1"))
    ]


def assert_stopped_after(emulator: Emulated, fault: float) -> None:
    """A zero command came after the fault, and nothing turned wheels after it."""
    wait_until(emulator.is_stopped, "zero as the last command")
    driving = [drives for stamp, drives in commands(emulator) if stamp >= fault]
    assert not any(driving[driving.index(False) :])


def drives(emulator: Emulated) -> None:
    wait_until(emulator.is_driven, "a command that turns the wheels")


# Faults of a program that drives, in a process of its own


def test_every_kind_of_fault_ends_in_a_zero_command(monkeypatch: pytest.MonkeyPatch) -> None:
    """`acsar-gym doctor --stopping` tells how soon, on a machine with nothing else to do."""
    monkeypatch.setattr(stopping_processes, "SURE", 0.1)
    told: list[str] = []
    config = RobotConfig.preset("acsar").with_(watchdog_timeout=HASTY)
    stops = stopping.measure(1, config=config, progress=lambda kind, _: told.append(kind))
    assert [one.kind for one in stops] == list(KINDS)
    assert told == [one.kind for one in stops if not one.skipped]
    for one in stops:
        assert all(map(math.isfinite, one.times)), one
        assert one.times or one.skipped
    report = json.loads(json.dumps(stopping.as_json(stops), allow_nan=False))
    assert set(report["stops"]) == set(KINDS)


def test_without_a_watchdog_the_measurement_finds_no_zero(monkeypatch: pytest.MonkeyPatch) -> None:
    """So it can fail."""
    monkeypatch.setattr(stopping_processes, "PATIENCE", 0.5)
    config = RobotConfig.preset("acsar").with_(watchdog_timeout=None)
    (kill,) = stopping.measure(1, ["kill"], config)
    assert kill.times == (math.inf,)
    assert kill.in_time == 0
    assert not kill.sound
    assert stopping.as_json([kill])["stops"]["kill"]["times"] == [None]


def test_bad_questions_to_the_measurement_are_errors() -> None:
    with pytest.raises(ConfigError, match="did you mean 'kill'"):
        stopping.measure(1, ["kil"])
    impossible = RobotConfig.preset("acsar").with_(connect_timeout=1e-6)
    with pytest.raises(AcsarError, match=r"kill: the program didn't drive: .* no byte"):
        stopping.measure(1, ["kill"], impossible)


def test_the_table_says_what_could_not_be_measured_here(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stopping, "no_namespace", lambda: "no PID namespace here (not permitted)")
    monkeypatch.setattr(stopping, "emulator", lambda config: contextlib.nullcontext(Unused()))
    monkeypatch.setattr(stopping, "programs", lambda *_: contextlib.nullcontext())
    stops = stopping.measure(1, ["pid1-term", "pid1-hup"])
    stops.append(stopping.Stops("fork", (0.01, math.inf)))
    console = Console(record=True, width=100, file=open(os.devnull, "w"))  # noqa: SIM115
    console.print(stopping.table(stops))
    console.file.close()
    said = console.export_text()
    assert said.count("skipped") == 3
    assert "skipped: no PID namespace here (not permitted)" in said
    assert "1 of 2" in said
    assert max(map(len, said.splitlines())) <= 100
    assert [one.sound for one in stops] == [True, True, False]


class Unused:
    device = ""


def test_a_suspended_program_does_not_drive_on_by_itself(emulator: Emulated) -> None:
    with program(WATCHED + DRIVE, emulator.device) as process:
        drives(emulator)
        fault = time.monotonic()
        process.send_signal(signal.SIGSTOP)
        assert_stopped_after(emulator, fault)
        process.send_signal(signal.SIGCONT)
        status, error = ended(process)
    assert status == 1
    assert "the watchdog stopped the robot: nothing was commanded for" in error
    assert "find what held the program up, then reset" in error
    assert_stopped_after(emulator, fault)


def test_a_program_suspended_at_standstill_drives_on(emulator: Emulated) -> None:
    """Its zeros are repeated meanwhile: the wire may have swallowed the last one."""
    code = """
import time
robot.activate()
for _ in range(30):
    robot.drive(0.0, 0.0)
goes_on = []
signal.signal(signal.SIGCONT, lambda *_: goes_on.append(True))
print("stands", flush=True)
while not goes_on:
    time.sleep(0.01)
drive(10**9)
"""
    with program(WATCHED + code, emulator.device) as process:
        assert first_line(process) == "stands"
        process.send_signal(signal.SIGSTOP)
        said = len(emulator.commands())
        more = math.ceil(2 * HASTY / STANDS)
        wait_until(lambda: len(emulator.commands()) > said + more, "repeated zeros")
        assert set(emulator.commands()) == {ZERO}
        process.send_signal(signal.SIGCONT)
        drives(emulator)


def test_a_policy_that_hangs_is_told_so(emulator: Emulated) -> None:
    code = """
import time
robot.activate()
drive(30)
while not robot.link._watch.dog.tripped:
    time.sleep(0.01)
drive(1)
"""
    with program(WATCHED + code, emulator.device) as process:
        status, error = ended(process)
    assert status == 1
    assert "LinkError: the watchdog stopped the robot" in error
    wait_until(emulator.is_stopped, "zero as the last command")


STRAY = """
import subprocess
robot.activate()
lifeline = robot.link._watch.dog._lifeline
stray = subprocess.Popen(["sleep", "60"], pass_fds=(lifeline,), stdout=subprocess.DEVNULL,
                         stderr=subprocess.DEVNULL)
drive(30)
print(stray.pid, flush=True)
drive(10**9)
"""


def test_a_stray_copy_of_the_lifeline_only_delays_the_zero(
    emulator: Emulated, config: RobotConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ports, "BUSY_PATIENCE", config.connect_timeout)
    with program(WATCHED + STRAY, emulator.device) as process:
        stray = psutil.Process(int(first_line(process)))
        drives(emulator)
        fault = time.monotonic()
        process.kill()
        assert_stopped_after(emulator, fault)
        assert ended(process)[0] == -signal.SIGKILL
        with Robot(open_link(emulator.device, config), config) as robot:
            assert robot.active
        stray.kill()


def test_a_program_behind_a_socket_is_watched_too(emulator: Emulated) -> None:
    with program(BRIDGE, emulator.device) as bridge:
        url = f"socket://127.0.0.1:{first_line(bridge)}"
        with program(DRIVER + DRIVE, url) as process:
            drives(emulator)
            fault = time.monotonic()
            process.kill()
            assert_stopped_after(emulator, fault)


def test_the_port_is_soon_free_after_a_kill(
    emulator: Emulated, config: RobotConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One `open` is enough."""
    monkeypatch.setattr(ports, "BUSY_PATIENCE", config.connect_timeout)
    with program(DRIVER + DRIVE, emulator.device) as process:
        drives(emulator)
        process.kill()
        link = SerialLink(emulator.device, config)
        link.open()
        link.close()


# The link


def opened(device: str, config: RobotConfig) -> Iterator[SerialLink]:
    link = SerialLink(device, config)
    link.open()
    link.reset(Scene())
    yield link
    link.close()


@pytest.fixture
def link(shared_device: str, config: RobotConfig) -> Iterator[SerialLink]:
    """Its watchdog doesn't trip."""
    yield from opened(shared_device, config.with_(watchdog_timeout=60.0))


@pytest.fixture
def hasty(shared_device: str, config: RobotConfig) -> Iterator[SerialLink]:
    """Its watchdog trips soon."""
    yield from opened(shared_device, config.with_(watchdog_timeout=HASTY))


def dog_of(link: SerialLink) -> Watchdog:
    assert link._watch.dog is not None
    return link._watch.dog


def test_after_a_trip_only_zeros_go_out_until_the_reset(hasty: SerialLink) -> None:
    begin = time.monotonic()
    hasty.write(TURNING)
    wait_until(lambda: dog_of(hasty).tripped, "a trip")
    for _ in range(2):
        with pytest.raises(LinkError, match=r"nothing was commanded for [0-9]+ ms") as caught:
            hasty.write(TURNING)
        pause = float(caught.value.found.removesuffix(" ms").rpartition(" ")[2])
        assert 1000.0 * HASTY <= pause <= 1000.0 * (time.monotonic() - begin) + 1.0
        assert caught.value.fix == "find what held the program up, then reset"
        hasty.write(encode(ZERO))
        hasty.write(b"")
        hasty.advance(0.01)
    hasty.reset(Scene())
    assert not dog_of(hasty).tripped
    hasty.write(TURNING)
    hasty.write(encode(ZERO))


def test_no_pause_at_standstill_is_too_long(link: SerialLink) -> None:
    stops: list[Callable[[], None]] = [
        lambda: link.write(encode(ZERO)),
        link.stop,
        lambda: link.reset(Scene()),
    ]
    page = dog_of(link)._page
    for stop in stops:
        link.write(TURNING)
        assert page[BEAT] > 0.0
        stop()
        assert page[BEAT] == 0.0


def test_a_zero_command_is_repeated_while_the_program_says_nothing(
    emulator: Emulated, config: RobotConfig
) -> None:
    """As at an episode's end: a wire may have swallowed it."""
    link = SerialLink(emulator.device, config)
    link.open()
    link.reset(Scene())
    link.write(TURNING)
    link.stop()
    wait_until(emulator.is_stopped, "zero as the last command")
    said = len(emulator.commands())
    wait_until(lambda: len(emulator.commands()) > said + 5, "repeated zeros")
    assert emulator.is_stopped()
    link.close()


def test_reading_is_a_sign_of_life(link: SerialLink) -> None:
    """A program that listens doesn't hang: `doctor` waits for the board's own time-out."""
    link.write(TURNING)
    page = dog_of(link)._page
    before = page[BEAT]
    link.read_now()
    assert page[BEAT] > before
    link.stop()
    link.read_now()
    assert page[BEAT] == 0.0


def test_periods_longer_than_the_timeout_are_no_pause(
    link: SerialLink, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert link._watch.nap == pytest.approx(60.0 / 3.0)
    link._watch.nap = 0.01
    beats: list[float] = []
    monkeypatch.setattr(link, "_beat", lambda: beats.append(time.monotonic()))
    link.advance(0.05)
    assert len(beats) > 1
    monkeypatch.undo()


def test_a_watchdog_that_dies_stops_the_robot_and_comes_back(link: SerialLink) -> None:
    link.write(TURNING)
    (dog,) = children()
    dog.kill()
    wait_until(lambda: not link.watched, "a dead watchdog")
    with pytest.raises(LinkError, match="watchdog process has ended"):
        link.write(TURNING)
    link.write(encode(ZERO))
    link.reset(Scene())
    assert link.watched
    link.write(TURNING)
    assert link.watchdog_pid != dog.pid


def test_a_suspended_watchdog_is_none(link: SerialLink) -> None:
    """The link refuses to drive, and what is suspended doesn't keep the port busy."""
    link.write(TURNING)
    (dog,) = children()
    dog.suspend()
    wait_until(lambda: not link.watched, "a suspended watchdog")
    with pytest.raises(LinkError, match=r"watchdog process is suspended \(PID [0-9]+\)") as caught:
        link.write(TURNING)
    assert "reset" in caught.value.fix
    dog.resume()
    with pytest.raises(LinkError, match="is suspended"):
        link.write(TURNING)
    link.reset(Scene())
    assert link.watchdog_pid != dog.pid
    link.write(TURNING)
    (dog,) = children()
    dog.suspend()
    link.close()
    assert not children()
    link.open()
    assert link.watched


def test_what_another_thread_writes_goes_out_before_the_zeros_or_not_at_all(
    link: SerialLink, monkeypatch: pytest.MonkeyPatch
) -> None:
    written: list[bytes] = []
    writes = threading.Event()
    write = os.write

    def slow(descriptor: int, data: bytes) -> int:
        if data == TURNING:
            writes.set()
            time.sleep(0.1)  # the main thread closes the port meanwhile
        written.append(data)
        return write(descriptor, data)

    def drive() -> None:
        with contextlib.suppress(LinkError):
            while True:
                link.write(TURNING)

    monkeypatch.setattr(os, "write", slow)
    thread = threading.Thread(target=drive)
    thread.start()
    writes.wait()
    link.close()
    thread.join()
    assert written.count(ZEROS) > 2
    last = len(written) - written[::-1].index(TURNING)
    assert ZEROS in written[:last], "the slow write delayed the zeros"
    assert set(written[last:]) == {ZEROS}


def test_nobody_writes_while_the_link_is_held(link: SerialLink) -> None:
    """As before Ctrl-Z suspends the program."""
    page = dog_of(link)._page
    thread = threading.Thread(target=lambda: link.write(TURNING))
    with link.held():
        thread.start()
        thread.join(0.05)
        assert thread.is_alive()
        assert page[BEAT] == 0.0
    thread.join()
    assert page[BEAT] > 0.0


def test_the_terminal_s_signals_do_not_reach_it(link: SerialLink) -> None:
    (dog,) = children()
    assert os.getsid(dog.pid) == dog.pid
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT, signal.SIGTSTP):
        dog.send_signal(number)
    link.reset(Scene())
    assert link.watched
    assert dog.status() != psutil.STATUS_STOPPED


def test_it_holds_nothing_but_the_port(link: SerialLink) -> None:
    (dog,) = children()
    held = {file.resolve() for file in Path(f"/proc/{dog.pid}/fd").iterdir()}
    assert Path(link.device) in held
    assert len([path for path in held if str(path).startswith("/dev/pts/")]) == 1


def test_none_means_none(shared_device: str, config: RobotConfig) -> None:
    link = SerialLink(shared_device, config.with_(watchdog_timeout=None))
    assert not link.watched
    link.open()
    assert not link.watched
    assert link.watchdog_pid is None
    assert not children()
    link.write(TURNING)
    link.reset(Scene())
    link.close()


@pytest.mark.parametrize("timeout", [0.0, 0.001, 60.1, 1e7, math.inf])
def test_impossible_timeouts_are_refused(timeout: float) -> None:
    with pytest.raises(ConfigError, match="watchdog_timeout"):
        RobotConfig(watchdog_timeout=timeout)


FEW_FILES = """
import resource
robot.activate()
robot.deactivate()
held = len(os.listdir("/proc/self/fd")) - 1
said = set()
for room in range(100):
    resource.setrlimit(resource.RLIMIT_NOFILE, (held + room, held + 1000))
    try:
        robot.activate()
        break
    except Exception as error:
        said.add(f"{type(error).__name__}: {error}")
    assert len(os.listdir("/proc/self/fd")) == held + 1 if room else True
resource.setrlimit(resource.RLIMIT_NOFILE, (held + 1000, held + 1000))
print(*said, sep="|", flush=True)
"""


def test_too_few_descriptors_are_one_clear_error(shared_device: str) -> None:
    with program(DRIVER + FEW_FILES, shared_device) as process:
        said = first_line(process).split("|")
        assert ended(process) == (0, "")
    assert len(said) > 1
    assert all(one.startswith("LinkError: ") and "ulimit -n" in one for one in said)
    assert "watchdog" in "".join(said)


def test_windows_drives_without(
    shared_device: str, config: RobotConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(watchdog, "AVAILABLE", False)
    with Robot(open_link(shared_device, config), config) as robot:
        robot.drive(0.2, 0.0)
        assert isinstance(robot.link, SerialLink)
        assert not robot.link.watched


@pytest.mark.parametrize("python", ["/bin/false", "/acsar-missing"])
def test_where_it_cannot_start_nothing_drives(
    python: str, shared_device: str, config: RobotConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "executable", python)
    link = SerialLink(shared_device, config)
    with no_leak(), pytest.raises(LinkError, match="watchdog can't be started") as caught:
        link.open()
    assert "watchdog_timeout=None" in caught.value.fix
    assert not children()
    assert not link.watched


def test_opening_often_leaves_nothing_behind(shared_device: str, config: RobotConfig) -> None:
    link = SerialLink(shared_device, config)
    with no_leak():
        for _ in range(10):
            link.open()
            assert link.watched
            link.close()
            assert not children()


def test_a_link_that_is_dropped_takes_its_watchdog_along(
    shared_device: str, config: RobotConfig
) -> None:
    link = SerialLink(shared_device, config)
    with no_leak():
        link.open()
        del link
        gc.collect()
        assert not children()


# The watchdog alone, on a pseudo-terminal


@pytest.fixture
def wire() -> Iterator[tuple[int, int]]:
    """Master and slave."""
    master, slave = os.openpty()
    tty.setraw(slave)
    os.set_blocking(slave, False)
    yield master, slave
    os.close(master)
    os.close(slave)


@pytest.fixture
def dog(wire: tuple[int, int]) -> Iterator[Watchdog]:
    with no_leak():
        dog = Watchdog(wire[1], ZEROS, HASTY)
        dog.wait()
        yield dog
        dog.close()
        dog.close()
    assert not psutil.pid_exists(dog.pid)


def heard(descriptor: int, wait: float) -> bytes:
    """What arrives until nothing has come for so long."""
    data = b""
    while select.select([descriptor], [], [], wait)[0]:
        data += os.read(descriptor, 4096)
    return data


def heard_often(descriptor: int, times: int) -> bytes:
    """What arrives until there are so many zero commands."""
    data = b""
    while data.count(ZEROS) < times:
        data += os.read(descriptor, 4096)
    return data


def test_it_trips_once_says_so_for_a_second_and_can_be_armed_again(
    wire: tuple[int, int], dog: Watchdog
) -> None:
    begin = time.monotonic()
    dog.drive()
    said = heard_often(wire[0], 1)
    assert time.monotonic() - begin >= HASTY
    assert dog.tripped
    dog.beat()
    with pytest.raises(LinkError):
        dog.drive()
    said += heard_often(wire[0], REPEATS - 1)
    assert said + heard(wire[0], 0.2) == ZEROS * REPEATS
    dog.rearm()
    assert not dog.tripped
    dog.drive()
    assert heard_often(wire[0], 1)


def test_it_repeats_zeros_only_while_the_program_stands(
    wire: tuple[int, int], dog: Watchdog
) -> None:
    dog.stand()
    assert not heard(wire[0], 2 * STANDS), "before the first reset, while the board starts"
    dog.rearm()
    assert set(heard_often(wire[0], 3).split(ZEROS)) == {b""}


def test_closing_is_silent(wire: tuple[int, int], dog: Watchdog) -> None:
    dog.drive()
    dog.close()
    assert not dog.alive
    assert not dog.tripped
    assert not heard(wire[0], 0.1)


def test_one_that_has_not_run_for_long_is_none(
    dog: Watchdog, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A machine that stood has held up the program too, and doesn't count."""
    monkeypatch.setattr(dog, "_page", memoryview(bytearray(PAGE)).cast("d"))  # nobody else's
    now = 100.0

    def drive_until(end: float, step: float) -> None:
        nonlocal now
        while now < end:
            now += step
            dog.drive()

    monkeypatch.setattr(time, "monotonic", lambda: now)
    drive_until(200.0, step=50.0)
    with pytest.raises(LinkError, match=r"watchdog process hasn't run for 1\.0[0-9] s"):
        drive_until(300.0, step=0.01)
    monkeypatch.undo()


def test_it_makes_way_where_the_port_is_stuck(wire: tuple[int, int], dog: Watchdog) -> None:
    """As where the board takes no bytes: its zeros are the first that it gets."""
    with contextlib.suppress(BlockingIOError):
        while True:
            os.write(wire[1], b"x" * 4096)
    dog.drive()
    wait_until(lambda: dog.tripped, "a trip")
    assert heard_often(wire[0], 1)


def test_a_lost_port_does_not_end_it(dog: Watchdog, wire: tuple[int, int]) -> None:
    other = os.open(os.devnull, os.O_RDONLY)
    unwritable = Watchdog(other, ZEROS, 0.05)
    unwritable.wait()
    unwritable.drive()
    wait_until(lambda: unwritable.tripped, "a trip")
    assert unwritable.alive
    unwritable.close()
    os.close(other)


def test_it_insists_until_the_board_answers(wire: tuple[int, int]) -> None:
    dog = Watchdog(wire[1], ZEROS, HASTY)
    dog.wait()
    dog.search("mine")
    said = b""
    while said.count(ZEROS) < 2 * LAST_WORDS:
        said += os.read(wire[0], 4096)
    os.write(wire[0], encode(ZERO))
    wait_until(lambda: not psutil.pid_exists(dog.pid) or is_dead(dog.pid), "its end")
    watchdog.call_back("mine")
    assert not psutil.pid_exists(dog.pid)


def is_dead(process: int) -> bool:
    return psutil.Process(process).status() == psutil.STATUS_ZOMBIE


def test_another_program_may_take_the_port_meanwhile(wire: tuple[int, int]) -> None:
    dog = Watchdog(wire[1], ZEROS, HASTY)
    dog.wait()
    dog.search("mine")
    other = os.open(os.ttyname(wire[1]), os.O_RDWR | os.O_NOCTTY)

    def is_mine() -> bool:
        with contextlib.suppress(BlockingIOError):
            fcntl.flock(other, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return True
        return False

    wait_until(is_mine, "the lock")
    heard(wire[0], 0.01)
    wait_until(lambda: is_dead(dog.pid), "its end")
    assert ZEROS not in heard(wire[0], 0.1)
    watchdog.call_back("mine")
    os.close(other)


def test_it_is_ahead_of_a_program_with_real_time_priority(shared_device: str) -> None:
    """Else a policy that never returns would keep it from the core."""
    code = (
        DRIVER
        + """
from acsar_gym import errors
from acsar_gym.doctor import host as realtime
robot.activate()
try:
    realtime.prepare(priority=10)
except errors.ConfigError:
    print("not allowed", flush=True)
    sys.exit()
robot.deactivate()
robot.activate()
print(os.sched_getparam(robot.link._watch.dog.pid).sched_priority, flush=True)
"""
    )
    with program(code, shared_device) as process:
        said = first_line(process)
    if said == "not allowed":
        pytest.skip("real-time priority isn't allowed here")
    assert said == "11"


# When to look and what to do, without processes


class Clock:
    """A watch over a page of its own, asked at chosen times."""

    def __init__(self) -> None:
        self.page = memoryview(bytearray(PAGE)).cast("d")
        self.zeros = 0
        self.taken = False
        self.watch = Watch(self.page, -1, os.getpid(), TIMEOUT_OF_DOG, self)
        self.watch._due = 0.0

    def stop(self, wanted: Callable[[], bool] = lambda: True) -> bool:
        self.zeros += wanted()
        return True

    def find(self) -> bool:
        raise AssertionError("nothing is lost")

    answers = find

    def share(self) -> None:
        raise AssertionError("nothing is shared")

    def look(self, now: float) -> float:
        due = self.watch._look(now)
        self.watch._due = due
        return due


@pytest.fixture
def clock() -> Clock:
    return Clock()


def test_it_looks_again_when_the_newest_sign_is_too_old(clock: Clock) -> None:
    clock.page[BEAT] = 100.0
    assert clock.look(100.01) == 100.15
    clock.page[BEAT] = 100.14
    assert clock.look(100.15) == pytest.approx(100.29)
    assert clock.zeros == 0
    assert clock.look(100.29) == pytest.approx(100.34)
    assert clock.zeros == 1
    assert clock.page[TRIPPED] == pytest.approx(0.15)


def test_a_sign_that_is_new_to_it_is_given_a_moment(clock: Clock) -> None:
    clock.page[BEAT] = 100.0
    assert clock.look(100.149) == 100.149 + SURE
    clock.look(100.149 + SURE)
    assert clock.zeros == 1


def test_a_machine_that_stood_is_no_fault_of_the_program(clock: Clock) -> None:
    clock.page[BEAT] = 100.0
    clock.look(100.01)
    assert clock.look(105.0) == 105.0 + SURE
    assert clock.zeros == 0
    clock.page[BEAT] = 105.01
    assert clock.look(105.0 + SURE) == pytest.approx(105.16)
    assert clock.zeros == 0


def test_the_excuse_counts_once(clock: Clock) -> None:
    clock.page[BEAT] = 100.0
    clock.look(100.01)
    clock.look(105.0)
    clock.look(106.0)
    assert clock.zeros == 1


def test_the_excuse_is_kept_for_when_it_matters(clock: Clock) -> None:
    clock.page[BEAT] = 100.0
    clock.look(100.01)
    clock.watch._due = 100.04
    clock.look(100.06)
    clock.look(105.0)
    assert clock.zeros == 0


def test_zeros_are_repeated_only_while_the_program_says_nothing(clock: Clock) -> None:
    clock.look(100.0)
    assert clock.zeros == 0
    clock.page[STOOD] = 100.0
    for milliseconds in range(0, 1000, 10):
        if milliseconds < 500:  # the program itself commands zero
            clock.page[STOOD] = 100.0 + 0.001 * milliseconds
        clock.look(100.0 + 0.001 * milliseconds)
        assert milliseconds > 500 or not clock.zeros
    assert clock.zeros == 5
    clock.page[BEAT] = 101.0
    clock.look(101.05)
    assert clock.zeros == 5


def test_what_it_writes_is_whole_and_starts_with_a_line_end() -> None:
    for cut in range(len(TURNING) + 1):
        assert Decoder().feed(TURNING[:cut] + ZEROS)[-1].speeds == ZERO
