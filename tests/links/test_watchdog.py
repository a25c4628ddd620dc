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
import subprocess
import sys
import time
import tty
from collections.abc import Callable, Iterator
from pathlib import Path

import psutil
import pytest
from rich.console import Console
from serial_tools import BRIDGE, DRIVER, TIMEOUT, Emulated, first_line, no_leak, program, wait_until

from acsar_gym import Robot, RobotConfig, open_link, stopping
from acsar_gym.errors import AcsarError, ConfigError, LinkError
from acsar_gym.links import watchdog
from acsar_gym.links.serial import SerialLink
from acsar_gym.links.watchdog import Watchdog
from acsar_gym.links.watchdog_child import BEAT, LAST_WORDS, PAGE, REPEATS, SURE, TRIPPED, Watch
from acsar_gym.protocol import ZERO, Decoder, encode
from acsar_gym.stopping_programs import KINDS
from acsar_gym.worlds import Scene

pytestmark = pytest.mark.usefixtures("deadline")

TURNING = encode((3.0, 3.0, 3.0, 3.0))
ZEROS = b"\r\n" + encode(ZERO)
TIMEOUT_OF_DOG = 0.15
SOON = 2.0
"""What a machine busy with other things may take for what should take 0.25 s."""


@pytest.fixture
def config(config: RobotConfig) -> RobotConfig:
    """With the watchdog as in earnest."""
    return config.with_(watchdog_timeout=TIMEOUT_OF_DOG)


def children() -> list[psutil.Process]:
    """The living and the dead, without the emulators."""

    def emulates(process: psutil.Process) -> bool:
        with contextlib.suppress(psutil.Error):  # a zombie has no command line
            return "emulate" in process.cmdline()
        return False

    return [child for child in psutil.Process().children() if not emulates(child)]


def commands(emulator: Emulated) -> list[tuple[float, bool]]:
    """When each command arrived, and whether it turns wheels."""
    decoder = Decoder()
    return [
        (float(event["t"]), reading.speeds != ZERO)
        for event in emulator.events()
        for reading in decoder.feed(event.get("rx", "").encode("latin-1"))
    ]


def stopped_after(emulator: Emulated, fault: float) -> float:
    """Time from the fault to the first zero; no command that turns wheels follows it."""
    wait_until(emulator.is_stopped, "zero as the last command")
    after = [(stamp, drives) for stamp, drives in commands(emulator) if stamp >= fault]
    drives = [drives for _, drives in after]
    assert not any(drives[drives.index(False) :])
    return next(stamp for stamp, drives in after if not drives) - fault


def drives(emulator: Emulated) -> None:
    wait_until(emulator.is_driven, "a command that turns the wheels")


def ended(process: subprocess.Popen[str]) -> tuple[int, str]:
    """Exit status and standard error."""
    _, error = process.communicate(timeout=TIMEOUT)
    return process.returncode, error


# Faults of a program that drives, in a process of its own


def test_every_kind_of_fault_ends_in_a_zero_command() -> None:
    told: list[str] = []
    stops = stopping.measure(1, progress=lambda kind, _: told.append(kind))
    assert [one.kind for one in stops] == list(KINDS)
    assert told == list(KINDS)
    for one in stops:
        assert max(one.times) < SOON, one
        assert one.in_time, one
    report = json.loads(json.dumps(stopping.as_json(stops), allow_nan=False))
    assert set(report["stops"]) == set(KINDS)
    console = Console(record=True, width=100, file=open(os.devnull, "w"))  # noqa: SIM115
    console.print(stopping.table(stops))
    console.file.close()
    assert "SIGKILL" in console.export_text()


def test_without_a_watchdog_the_measurement_finds_no_zero() -> None:
    """So it can fail."""
    config = RobotConfig.preset("acsar").with_(watchdog_timeout=None)
    (kill,) = stopping.measure(1, ["kill"], config)
    assert kill.times == (math.inf,)
    assert kill.in_time == 0
    assert stopping.as_json([kill])["stops"]["kill"]["times"] == [None]


def test_bad_questions_to_the_measurement_are_errors() -> None:
    with pytest.raises(ConfigError, match="did you mean 'kill'"):
        stopping.measure(1, ["kil"])
    impossible = RobotConfig.preset("acsar").with_(connect_timeout=1e-6)
    with pytest.raises(AcsarError, match=r"kill: the program didn't drive: .* no byte"):
        stopping.measure(1, ["kill"], impossible)


def test_a_suspended_program_does_not_drive_on_by_itself(emulator: Emulated) -> None:
    with program(DRIVER + "robot.activate(); drive(10**9)", emulator.device) as process:
        drives(emulator)
        fault = time.monotonic()
        process.send_signal(signal.SIGSTOP)
        assert stopped_after(emulator, fault) < SOON
        time.sleep(0.3)
        process.send_signal(signal.SIGCONT)
        status, error = ended(process)
    assert status == 1
    assert "the watchdog stopped the robot: nothing was commanded for" in error
    assert "find what held the program up, then reset" in error
    stopped_after(emulator, fault)


def test_a_program_suspended_at_standstill_drives_on(emulator: Emulated) -> None:
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
    with program(DRIVER + code, emulator.device) as process:
        assert first_line(process) == "stands"
        process.send_signal(signal.SIGSTOP)
        time.sleep(3 * TIMEOUT_OF_DOG)
        process.send_signal(signal.SIGCONT)
        drives(emulator)


def test_a_policy_that_hangs_is_told_so(emulator: Emulated) -> None:
    code = "import time; robot.activate(); drive(30); time.sleep(1.0); drive(1)"
    with program(DRIVER + code, emulator.device) as process:
        status, error = ended(process)
    assert status == 1
    assert "LinkError: the watchdog stopped the robot" in error
    wait_until(emulator.is_stopped, "zero as the last command")


STRAY = """
import subprocess
robot.activate()
lifeline = robot.link._watchdog._lifeline
stray = subprocess.Popen(["sleep", "60"], pass_fds=(lifeline,), stdout=subprocess.DEVNULL,
                         stderr=subprocess.DEVNULL)
drive(30)
print(stray.pid, flush=True)
drive(10**9)
"""


def test_a_stray_copy_of_the_lifeline_only_delays_the_zero(
    emulator: Emulated, config: RobotConfig
) -> None:
    with program(DRIVER + STRAY, emulator.device) as process:
        stray = psutil.Process(int(first_line(process)))
        drives(emulator)
        fault = time.monotonic()
        process.kill()
        assert stopped_after(emulator, fault) < SOON
        assert ended(process)[0] == -signal.SIGKILL
        with Robot(open_link(emulator.device, config), config) as robot:
            assert robot.active
        stray.kill()


def test_a_program_behind_a_socket_is_watched_too(emulator: Emulated) -> None:
    with program(BRIDGE, emulator.device) as bridge:
        url = f"socket://127.0.0.1:{first_line(bridge)}"
        with program(DRIVER + "robot.activate(); drive(10**9)", url) as process:
            drives(emulator)
            fault = time.monotonic()
            process.kill()
            assert stopped_after(emulator, fault) < SOON


def test_the_port_is_free_soon_after_a_kill(emulator: Emulated, config: RobotConfig) -> None:
    with program(DRIVER + "robot.activate(); drive(10**9)", emulator.device) as process:
        drives(emulator)
        process.kill()
        begin = time.monotonic()
        ended(process)
        link = SerialLink(emulator.device, config)
        link.open()
        took = time.monotonic() - begin
        link.close()
    assert took < SOON


def test_a_busy_machine_trips_nothing(shared_device: str, config: RobotConfig) -> None:
    with (
        program("while True: pass"),
        Robot(open_link(shared_device, config), config) as robot,
    ):
        for _ in range(500):
            robot.drive(0.2, 0.0)
            assert isinstance(robot.link, SerialLink)
            assert robot.link.watched


# The link


@pytest.fixture
def link(shared_device: str, config: RobotConfig) -> Iterator[SerialLink]:
    link = SerialLink(shared_device, config)
    link.open()
    link.reset(Scene())
    yield link
    link.close()


def test_after_a_trip_only_zeros_go_out_until_the_reset(link: SerialLink) -> None:
    link.write(TURNING)
    time.sleep(3 * TIMEOUT_OF_DOG)
    for _ in range(2):
        with pytest.raises(LinkError, match=r"nothing was commanded for [0-9]+ ms") as caught:
            link.write(TURNING)
        assert caught.value.fix == "find what held the program up, then reset"
        link.write(encode(ZERO))
        link.write(b"")
        link.advance(0.01)
    link.reset(Scene())
    link.write(TURNING)
    link.advance(0.01)
    link.write(encode(ZERO))


def test_the_pause_is_told_in_full(link: SerialLink) -> None:
    link.write(TURNING)
    time.sleep(0.5)
    with pytest.raises(LinkError) as caught:
        link.write(TURNING)
    pause = float(caught.value.found.removesuffix(" ms").rpartition(" ")[2])
    assert 500.0 <= pause < 500.0 + 1000.0 * SOON


def test_no_pause_at_standstill_is_too_long(link: SerialLink) -> None:
    stops: list[Callable[[], None]] = [
        lambda: link.write(encode(ZERO)),
        link.stop,
        lambda: link.reset(Scene()),
    ]
    for stop in stops:
        link.write(TURNING)
        stop()
        time.sleep(3 * TIMEOUT_OF_DOG)
        link.write(TURNING)
    link.stop()


def test_reading_is_a_sign_of_life(link: SerialLink) -> None:
    """A program that listens doesn't hang: `doctor` waits for the board's own time-out."""
    link.write(TURNING)
    for _ in range(30):
        time.sleep(0.02)
        link.read_now()
    link.write(TURNING)


def test_periods_longer_than_the_timeout_are_no_pause(link: SerialLink) -> None:
    for _ in range(2):
        link.write(TURNING)
        link.advance(3 * TIMEOUT_OF_DOG)


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
    assert [child.pid for child in children()] != [dog.pid]


def test_the_terminal_s_signals_do_not_reach_it(link: SerialLink) -> None:
    (dog,) = children()
    assert os.getsid(dog.pid) == dog.pid
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT, signal.SIGTSTP):
        dog.send_signal(number)
    time.sleep(0.05)
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
    assert not children()
    link.write(TURNING)
    time.sleep(3 * TIMEOUT_OF_DOG)
    link.write(TURNING)
    link.reset(Scene())
    link.close()


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


def test_fifty_times_leave_nothing_behind(shared_device: str, config: RobotConfig) -> None:
    link = SerialLink(shared_device, config)
    with no_leak():
        for _ in range(50):
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


def test_it_ends_even_where_it_was_suspended(
    link: SerialLink, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(watchdog, "PATIENCE", 0.1)
    (dog,) = children()
    dog.suspend()
    link.write(TURNING)
    link.close()
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
        dog = Watchdog(wire[1], ZEROS, TIMEOUT_OF_DOG)
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


def test_it_says_nothing_while_it_is_fed(wire: tuple[int, int], dog: Watchdog) -> None:
    dog.drive()
    for _ in range(40):
        dog.beat()
        assert not heard(wire[0], 0.01)
    assert not dog.tripped


def test_it_trips_once_says_so_for_a_second_and_can_be_armed_again(
    wire: tuple[int, int], dog: Watchdog
) -> None:
    for _ in range(2):
        begin = time.monotonic()
        dog.drive()
        assert select.select([wire[0]], [], [], SOON)[0]
        assert TIMEOUT_OF_DOG <= time.monotonic() - begin < SOON
        assert dog.tripped
        dog.beat()
        with pytest.raises(LinkError):
            dog.drive()
        assert heard(wire[0], 0.5) == ZEROS * REPEATS
        dog.rearm()
        assert not dog.tripped
        assert not heard(wire[0], 2 * TIMEOUT_OF_DOG)


def test_closing_is_silent(wire: tuple[int, int], dog: Watchdog) -> None:
    dog.drive()
    dog.close()
    assert not dog.alive
    assert not dog.tripped
    assert not heard(wire[0], 0.1)


def test_it_makes_way_where_the_port_is_stuck(wire: tuple[int, int], dog: Watchdog) -> None:
    """As where the board takes no bytes: its zeros are the first that it gets."""
    with contextlib.suppress(BlockingIOError):
        while True:
            os.write(wire[1], b"x" * 4096)
    dog.drive()
    wait_until(lambda: dog.tripped, "a trip")
    time.sleep(0.1)
    assert ZEROS in heard(wire[0], 0.3)


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
    dog = Watchdog(wire[1], ZEROS, TIMEOUT_OF_DOG)
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
    dog = Watchdog(wire[1], ZEROS, TIMEOUT_OF_DOG)
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
from acsar_gym import errors, realtime
robot.activate()
try:
    realtime.prepare(priority=10)
except errors.ConfigError:
    print("not allowed", flush=True)
    sys.exit()
robot.deactivate()
robot.activate()
print(os.sched_getparam(robot.link._watchdog.pid).sched_priority, flush=True)
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

    def stop(self) -> bool:
        self.zeros += 1
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


def test_what_it_writes_is_whole_and_starts_with_a_line_end() -> None:
    for cut in range(len(TURNING) + 1):
        assert Decoder().feed(TURNING[:cut] + ZEROS)[-1].speeds == ZERO
