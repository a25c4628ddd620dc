"""The RPLIDAR's driver against a sensor in another process, behind a real terminal."""

from __future__ import annotations

import copy
import gc
import math
import os
import pickle
import signal
import statistics
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from lds2d.drivers import rplidar as library
from lidar_tools import Floats, nothing, room, start_lidar, state, turns
from serial_tools import TIMEOUT, Emulated, first_line, no_leak, program, wait_until

from acsar_gym import RobotConfig
from acsar_gym.config import LidarConfig
from acsar_gym.emulation.rplidar import RplidarTwin
from acsar_gym.errors import ConfigError, LidarError, MissingExtraError
from acsar_gym.lidars import rplidar, rplidar_device
from acsar_gym.lidars.base import Lidar, Scan
from acsar_gym.lidars.revolutions import Turns, binned
from acsar_gym.lidars.rplidar import RplidarLidar
from acsar_gym.links import ports, shutdown
from acsar_gym.worlds import Scene

pytestmark = pytest.mark.usefixtures("deadline")

MILLIMETRES = 0.002
"""What the wire and lds2d round away [m]."""
MAX = 5.0
STANDSTILL = (False, 0)
PROGRAM = """
import os, resource, signal, sys, time
import numpy as np
from acsar_gym import RobotConfig
from acsar_gym.lidars.rplidar import RplidarLidar
from acsar_gym.worlds import Scene

resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
config = RobotConfig.preset("acsar").with_(lidar={"timeout": 20.0})
lidar = RplidarLidar(sys.argv[1], config, time.monotonic)
lidar.reset(Scene(), np.random.default_rng(0))
print("scanning", flush=True)
"""
"""Beginning of a program that scans with the device in argv[1]."""

Start = Callable[..., Emulated]
Open = Callable[..., RplidarLidar]


@pytest.fixture(scope="module")
def sensor(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Emulated]:
    """A sensor in a room, for tests that leave it as it is."""
    emulated = start_lidar(tmp_path_factory.mktemp("lidar") / "log.jsonl")
    yield emulated
    emulated.end()


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    """`start("--spin-up", "1", ...)` starts a sensor of the test's own."""
    running: list[Emulated] = []

    def begin(*arguments: str) -> Emulated:
        running.append(start_lidar(tmp_path / f"lidar{len(running)}.jsonl", *arguments))
        return running[-1]

    yield begin
    for emulated in running:
        emulated.end()


@pytest.fixture
def make() -> Iterator[Open]:
    """`make(emulated, rays=63, ...)` is a LiDAR; all of them are closed with the test."""
    made: list[RplidarLidar] = []

    def begin(device: Emulated | str, **lidar: float) -> RplidarLidar:
        config = RobotConfig.preset("acsar").with_(
            lidar={"timeout": 20.0, **lidar}, reconnect_timeout=0.5
        )
        name = device if isinstance(device, str) else device.device
        made.append(RplidarLidar(name, config, time.monotonic))
        return made[-1]

    yield begin
    for lidar in made:
        lidar.close()


def reset(lidar: Lidar) -> None:
    lidar.reset(Scene(), np.random.default_rng(0))


def measure(lidar: RplidarLidar) -> Floats:
    reset(lidar)
    ranges = lidar.scan().ranges
    lidar.close()
    return ranges


def directions(rays: int, field: float = 2.0 * math.pi) -> Floats:
    """As the contract says: from -field / 2, and a full turn has none twice."""
    step = field / (rays if field > 6.28 else max(rays - 1, 1))
    return -field / 2.0 + step * np.arange(rays, dtype=np.float64)


def shows_the_room(ranges: Floats, field: float = 2.0 * math.pi) -> bool:
    """Whether each direction has the wall where the measurement next to it met it.

    Of two measurements just as near either will do.
    """
    bearings = wrapped(-np.radians(np.arange(360.0)))
    off = np.abs(wrapped(directions(len(ranges), field)[:, None] - bearings))
    next_to_it = off <= off.min(axis=1, keepdims=True) + 1e-6
    low = np.where(next_to_it, room(bearings), np.inf).min(axis=1)
    high = np.where(next_to_it, room(bearings), -np.inf).max(axis=1)
    return bool(((ranges >= low - MILLIMETRES) & (ranges <= high + MILLIMETRES)).all())


def wrapped(angles: Floats) -> Floats:
    return (angles + math.pi) % (2.0 * math.pi) - math.pi


def error_of(action: Callable[[], object]) -> str:
    """The LidarError's message; one line, and the device is closed again."""
    with no_leak(), pytest.raises(LidarError) as caught:
        action()
    message = str(caught.value)
    assert "\n" not in message
    assert caught.value.fix
    return message


def is_lost(lidar: RplidarLidar) -> bool:
    try:
        lidar.scan()
    except LidarError as error:
        return "lost while in use" in str(error)
    return False


def newer(lidar: RplidarLidar, than: float) -> Scan:
    """The first turn after that."""
    wait_until(lambda: lidar.scan().stamp > than, "a newer turn")
    return lidar.scan()


@pytest.mark.parametrize("rays", [1, 2, 5, 63, 64, 180])
def test_every_direction_has_its_own_wall(sensor: Emulated, make: Open, rays: int) -> None:
    ranges = measure(make(sensor, rays=rays))
    assert ranges.shape == (rays,)
    assert shows_the_room(ranges)
    assert rays < 63 or not shows_the_room(ranges[::-1])


@pytest.mark.parametrize("rays", [2, 46, 91, 271])
def test_a_field_of_view_ends_on_both_sides(sensor: Emulated, make: Open, rays: int) -> None:
    field = math.radians(270.0)
    ranges = measure(make(sensor, rays=rays, field_of_view=field))
    assert shows_the_room(ranges, field)
    assert not shows_the_room(ranges[::-1], field)


@pytest.mark.parametrize("field", [270.0, 360.0])
def test_directions_finer_than_the_sensors_have_no_gaps(
    sensor: Emulated, make: Open, field: float
) -> None:
    field = math.radians(field)
    angles = directions(1500, field)
    ranges = measure(make(sensor, rays=1500, field_of_view=field))
    near = np.stack([room(angles + off) for off in np.radians(np.linspace(-0.6, 0.6, 25))])
    assert (ranges >= near.min(axis=0) - MILLIMETRES).all()
    assert (ranges <= near.max(axis=0) + MILLIMETRES).all()


def test_ranges_are_clamped(sensor: Emulated, make: Open) -> None:
    ranges = measure(make(sensor, rays=360, min_range=1.0, max_range=2.0))
    expected = np.clip(room(directions(360)), 1.0, 2.0)
    assert np.abs(ranges - expected).max() < MILLIMETRES


def measured(degrees: list[float], distances: list[float], **lidar: float) -> list[float]:
    """The ranges of a turn that measured this, and missed in a hundred other directions."""
    bearings, missed = np.radians([*degrees, *range(100)]), [0.0] * 100
    config = LidarConfig(**{"rays": 4, "max_range": MAX, **lidar})
    found: list[float] = binned(bearings, np.array([*distances, *missed]), config).tolist()
    return found


def test_the_measurement_next_to_a_direction_counts_and_zero_is_none() -> None:
    assert measured([1.0, 10.0, 350.0, 90.0], [3.0, 2.0, 2.0, 0.0]) == [MAX, MAX, 3.0, MAX]
    assert measured([-178.0, 170.0, 91.0], [3.0, 2.0, 4.0]) == [3.0, MAX, MAX, 4.0]
    assert measured([], []) == [MAX] * 4


def test_only_neighbours_within_the_sensors_step_fill_a_gap() -> None:
    angles = list(np.arange(0.0, 360.0, 2.0))  # even directions measure, odd ones don't
    distances = [1.0 if angle < 100.0 else 0.0 for angle in angles]
    lidar = LidarConfig(rays=360)
    ranges = binned(np.radians(angles), np.array(distances), lidar).tolist()
    assert ranges[179:280] == [1.0] * 101
    assert ranges[280:] + ranges[:179] == [MAX] * 259


def test_one_direction_is_the_first_of_its_field() -> None:
    field = math.radians(90.0)
    assert measured([-45.0, 60.0], [2.0, 1.0], rays=1, field_of_view=field) == [2.0]
    assert measured([-30.0, 60.0], [2.0, 1.0], rays=1, field_of_view=field) == [MAX]


def stream(look: Callable[[Floats], Floats] = room, samples: int = 100) -> bytes:
    """Half a turn, and three whole ones."""
    twin = RplidarTwin(look, rate=1.0, samples=samples)
    twin.advance(0.5)
    twin.receive(b"\xa5\x20")
    return twin.advance(3.6)


@pytest.mark.parametrize("size", [1, 3, 5, 64, 10_000])
def test_turns_are_complete_whatever_the_pieces(size: int) -> None:
    data = stream()
    decoder = Turns(library)
    found = [
        turn for at in range(0, len(data), size) for turn in decoder.feed(data[at : at + size])
    ]
    assert [len(bearings) for bearings, _ in found] == [100, 100, 100]
    for bearings, distances in found:
        assert np.abs(distances - room(bearings)).max() < MILLIMETRES


@pytest.mark.parametrize("look", [room, nothing])
def test_a_turn_that_lost_bytes_is_dropped(look: Callable[[Floats], Floats]) -> None:
    data = stream(look)
    whole = Turns(library).feed(data)
    for at in range(250, 760):  # in the first whole turn, or just behind it
        found = Turns(library).feed(data[:at] + data[at + 1 :])
        assert 1 <= len(found) < 3
        for bearings, distances in found:
            assert len(bearings) == 100
            assert any(np.array_equal(distances, other) for _, other in whole)


def test_turns_with_holes_and_streams_without_turns_are_dropped() -> None:
    data = stream()
    assert len(Turns(library).feed(data[:400] + data[500:])) == 2
    assert len(Turns(library).feed(stream(samples=20))) == 0
    decoder = Turns(library)
    for _ in range(3):
        assert not decoder.feed(b"\x3d\x01\x00\x00\x00" + 20_000 * b"\x3e\x01\x00\x00\x00")


def test_a_turn_is_stamped_when_it_is_complete(start: Start, make: Open) -> None:
    emulated = start("--rate", "5.5")
    lidar = make(emulated)
    reset(lidar)
    stamps = [lidar.scan().stamp]
    for _ in range(7):
        stamps.append(newer(lidar, stamps[-1]).stamp)
    assert time.monotonic() >= stamps[-1]
    ends = np.array(turns(emulated))
    lags = [stamp - ends[ends <= stamp].max() for stamp in stamps]
    assert statistics.median(lags) < 0.5 / 5.5  # were it the turn before, a whole turn


def test_a_scan_is_the_callers_own_and_waits_for_nothing(sensor: Emulated, make: Open) -> None:
    lidar = make(sensor)
    reset(lidar)
    scans = [lidar.scan() for _ in range(100)]
    assert len({scan.stamp for scan in scans}) < 100  # it doesn't wait for the next turn
    scans[0].ranges[:] = 0.0
    assert scans[1].ranges.min() > 0.5


def test_an_open_one_resets_at_once(sensor: Emulated, make: Open) -> None:
    lidar = make(sensor)
    reset(lidar)
    before, states = lidar.scan().stamp, len([e for e in sensor.events() if "pwm" in e])
    for _ in range(100):
        reset(lidar)
    assert lidar.scan().stamp >= before
    newer(lidar, time.monotonic())
    assert len([e for e in sensor.events() if "pwm" in e]) == states


def test_a_frozen_device_is_an_error_after_the_timeout_and_comes_back(
    start: Start, make: Open
) -> None:
    emulated = start()
    lidar = make(emulated, timeout=1.0)
    reset(lidar)
    emulated.pause()
    newest = lidar.scan().stamp
    time.sleep(0.3)
    newest = max(newest, lidar.scan().stamp)
    wait_until(lambda: time.monotonic() > newest + 1.1, "the time-out")
    with pytest.raises(
        LidarError, match=r"no complete turn for \d+\.\d\d s \(lidar.timeout = 1 s\)"
    ):
        lidar.scan()
    emulated.process.send_signal(signal.SIGCONT)
    wait_until(lambda: scans_again(lidar), "turns")


def scans_again(lidar: RplidarLidar) -> bool:
    try:
        return bool(lidar.scan().ranges.max() < MAX)
    except LidarError:
        return False


def test_a_frozen_device_fails_a_reset_and_is_closed(
    start: Start, make: Open, monkeypatch: pytest.MonkeyPatch
) -> None:
    emulated = start()
    lidar = make(emulated, timeout=0.5)
    reset(lidar)
    emulated.pause()
    wait_until(lambda: not scans_again(lidar), "the time-out")
    monkeypatch.setattr(rplidar_device, "ANSWER", 0.05)
    with pytest.raises(LidarError, match="no answer"):
        reset(lidar)
    with pytest.raises(LidarError, match="is closed"):
        lidar.scan()
    emulated.process.send_signal(signal.SIGCONT)
    monkeypatch.undo()
    reset(lidar)


def test_a_machine_that_is_slow_to_write_has_not_lost_the_device(
    make: Open, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rplidar_device, "ANSWER", 0.02)
    monkeypatch.setattr(ports, "WRITE_TIMEOUT", 1e-9)
    board, terminal = os.openpty()
    with pytest.raises(LidarError, match="no answer"):
        reset(make(os.ttyname(terminal)))
    os.close(board)
    os.close(terminal)


@pytest.fixture
def plug(tmp_path: Path) -> Path:
    """A name of the device's own; the terminal's may be another one's once it is unplugged."""
    return tmp_path / "rplidar"


def test_unplugged_is_an_error_at_once(start: Start, make: Open, plug: Path) -> None:
    emulated = start()
    plug.symlink_to(emulated.device)
    lidar = make(str(plug))
    with no_leak():
        reset(lidar)
        emulated.kill()
        plug.unlink()
        wait_until(lambda: is_lost(lidar), "an error")
        lidar.close()
    assert "no such device" in error_of(lambda: reset(lidar))


def test_unplugged_without_a_close_is_opened_anew(start: Start, make: Open, plug: Path) -> None:
    emulated = start()
    plug.symlink_to(emulated.device)
    lidar = make(str(plug))
    reset(lidar)
    emulated.kill()
    wait_until(lambda: is_lost(lidar), "an error")
    plug.unlink()
    plug.symlink_to(start().device)
    reset(lidar)
    assert lidar.scan().ranges.max() < MAX


def refusal(lidar: RplidarLidar) -> str:
    message = error_of(lambda: reset(lidar))
    assert message.startswith(f"LiDAR {lidar.device}: ")
    return message


def test_what_is_no_rplidar_is_named(
    start: Start, make: Open, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rplidar_device, "ANSWER", 0.3)
    silent, other = make(start("--fault", "silent")), make(start("--fault", "garbage"))
    assert "no answer in 1.2 s: check its power and cable" in refusal(silent)
    assert "none from an RPLIDAR: check the port's name" in refusal(other)


def test_an_rplidar_that_does_not_measure_says_why(
    start: Start, make: Open, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rplidar, "SPIN_UP", 0.5)
    broken, stuck = make(start("--broken")), make(start("--spin-up", "1000"))
    assert "reports error 0x8001 and won't measure: unplug it" in refusal(broken)
    assert "no complete turn in 0.5 s: check that its head" in refusal(stuck)


def test_what_cannot_be_opened_is_named(make: Open, tmp_path: Path) -> None:
    assert "no such device: serial ports here" in refusal(make(str(tmp_path / "gone")))
    file = tmp_path / "file"
    file.touch()
    assert "can't be opened as a serial port" in refusal(make(str(file)))
    with pytest.raises(ConfigError, match="must be like"):
        reset(make("socket://nowhere"))


def test_a_device_in_use_stays_with_its_owner(sensor: Emulated, make: Open) -> None:
    owner, other = make(sensor), make(sensor)
    reset(owner)
    message = error_of(lambda: reset(other))
    assert "in use by another process: close it first" in message
    newer(owner, time.monotonic())
    owner.close()
    reset(other)


def test_without_lds2d_the_extra_is_named(
    sensor: Emulated, make: Open, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "lds2d.drivers", None)
    with no_leak(), pytest.raises(MissingExtraError, match=r"acsar_gym\[lidar\]"):
        reset(make(sensor))


def test_closing_stops_scan_and_motor_and_twice_is_once(start: Start, make: Open) -> None:
    emulated = start()
    lidar = make(emulated)
    lidar.close()
    with no_leak():
        reset(lidar)
        assert state(emulated) == (True, 660)
        lidar.close()
        lidar.close()
    wait_until(lambda: state(emulated) == STANDSTILL, "a stop")
    with pytest.raises(LidarError, match=r"is closed: call reset\(\) first"):
        lidar.scan()


def test_twenty_times_open_and_closed_leave_nothing_behind(sensor: Emulated, make: Open) -> None:
    lidar = make(sensor)
    threads = threading.active_count()
    with no_leak():
        for _ in range(20):
            assert measure(lidar).max() < MAX
            assert threading.active_count() == threads


def test_a_forgotten_one_is_closed(sensor: Emulated) -> None:
    config = RobotConfig.preset("acsar").with_(lidar={"timeout": 20.0})
    threads = threading.active_count()
    with no_leak():
        lidar = RplidarLidar(sensor.device, config, time.monotonic)
        reset(lidar)
        del lidar
        gc.collect()
        assert threading.active_count() == threads


def test_copies_and_pickles_are_closed(sensor: Emulated, make: Open) -> None:
    lidar = make(sensor)
    reset(lidar)
    for twin in (copy.copy(lidar), copy.deepcopy(lidar), pickle.loads(pickle.dumps(lidar))):  # noqa: S301
        assert twin.device == lidar.device
        with pytest.raises(LidarError, match="is closed"):
            twin.scan()
    newer(lidar, time.monotonic())


def test_it_spins_up_from_standstill(start: Start, make: Open) -> None:
    emulated = start("--spin-up", "0.5", "--rate", "5.5")
    lidar = make(emulated)
    for _ in range(2):
        reset(lidar)
        assert lidar.scan().ranges.max() < MAX
        lidar.close()
        wait_until(lambda: state(emulated) == STANDSTILL, "a stop")


def test_the_baud_of_a_c1_is_found(start: Start, make: Open) -> None:
    assert measure(make(start("--baud", "460800"))).max() < MAX


@pytest.mark.parametrize(
    "ending", ["os.kill(os.getpid(), signal.SIGTERM)", "pass", "raise SystemExit(1)"]
)
def test_a_process_that_ends_stops_the_motor(sensor: Emulated, ending: str) -> None:
    with program(PROGRAM + ending, sensor.device) as process:
        assert first_line(process) == "scanning"
        process.communicate(timeout=TIMEOUT)
    wait_until(lambda: state(sensor) == STANDSTILL, "a stop")


def test_after_a_crash_it_is_opened_while_it_still_scans(sensor: Emulated, make: Open) -> None:
    with program(PROGRAM + "os.kill(os.getpid(), signal.SIGKILL)", sensor.device) as process:
        process.communicate(timeout=TIMEOUT)
    assert state(sensor)[0]
    assert shows_the_room(measure(make(sensor, rays=180)))


def test_a_forked_child_leaves_its_parents_device_alone(sensor: Emulated) -> None:
    forking = """
if os.fork() == 0:
    try:
        lidar.scan()
    except Exception as error:
        print(type(error).__name__, flush=True)
    lidar.close()
    sys.exit()
os.wait()
before = time.monotonic()
while lidar.scan().stamp < before:
    time.sleep(0.01)
print("goes on", flush=True)
"""
    with program(PROGRAM + forking, sensor.device) as process:
        said, complaints = process.communicate(timeout=TIMEOUT)
    assert said.split("\n")[1:3] == ["LidarError", "goes on"]
    assert not complaints


def test_a_suspended_process_keeps_its_sensor(sensor: Emulated, make: Open) -> None:
    lidar = make(sensor)
    reset(lidar)
    assert lidar in shutdown._open
    with lidar.held():
        newer(lidar, time.monotonic())


class SlowPort:
    """A port whose reader sleeps now and then; what it missed is as old as its sleep."""

    def __init__(self) -> None:
        self.twin = RplidarTwin(room, rate=20.0, samples=100)
        self.twin.receive(b"\xa5\x20")
        self.pause = 0.0
        self.flushed = 0

    def read(self, size: int) -> bytes:
        time.sleep(self.pause)
        return self.twin.advance(0.005 + self.pause)[-size:]

    def reset_input_buffer(self) -> None:
        self.flushed += 1


def test_what_was_missed_is_dropped_not_stamped_as_new() -> None:
    port = SlowPort()
    reader = rplidar._Reader(port, Turns(library), LidarConfig(), time.monotonic)
    reader.start()
    wait_until(lambda: reader.newest is not None, "a turn")
    port.pause = 0.2
    wait_until(lambda: port.flushed > 2, "flushes")
    stale = reader.newest
    time.sleep(0.5)
    assert reader.newest is stale
    port.pause = 0.0
    wait_until(lambda: reader.newest is not stale, "a turn")
    reader.running = False
    reader.join()
