"""The emulator as a process: its device, its log, its ends, and how its robot moves."""

from __future__ import annotations

import json
import os
import time
import tty
from pathlib import Path

import pytest
import serial
from serial_tools import TIMEOUT, Emulated, StartEmulator, cli, no_leak, wait_until

from acsar_gym import RobotConfig
from acsar_gym.errors import ConfigError
from acsar_gym.links.serial import SerialLink
from acsar_gym.protocol import ZERO, Decoder, encode
from acsar_gym.tools.emulation.board import LONGEST_CATCH_UP, Emulator
from acsar_gym.worlds import Scene, World
from acsar_gym.worlds.crowd import PERSON_HIT
from acsar_gym.worlds.movers import walk

pytestmark = pytest.mark.usefixtures("deadline")

LOOP = 0.005
"""Period of the firmware's loop [s]."""
FORWARD = encode((4.0, 4.0, 4.0, 4.0))


def test_tests_over_serial_devices_share_a_worker(request: pytest.FixtureRequest) -> None:
    if "PYTEST_XDIST_WORKER" in os.environ:
        assert request.node.nodeid.endswith("@test_board"), "see pytest in constraints.txt"


def wait_for_log(emulator: Emulated, until: float) -> None:
    wait_until(lambda: any(e["t"] > until for e in emulator.events()[-1:]), "a log that goes on")


@pytest.mark.parametrize("body", ["planar", "bullet"])
def test_emulate_stops_the_robot_when_commands_stop(
    body: str, config: RobotConfig, start_emulator: StartEmulator
) -> None:
    emulator = start_emulator("--body", body)
    link = SerialLink(emulator.device, config.with_(watchdog_timeout=None))
    link.open()
    for _ in range(30):
        link.write(FORWARD)
        link.advance(config.period)
    wait_until(lambda: emulator.poses()[-1][0] > 0.05, "a robot that drives")
    wait_until(emulator.stands, "a robot that stands")
    assert emulator.is_driven()
    link.close()


def test_emulate_garbles_a_wrong_baud_rate_both_ways(own_emulator: Emulated) -> None:
    """The client knows nothing of this package."""
    with serial.Serial(own_emulator.device, 57600, timeout=TIMEOUT) as port:
        for _ in range(10):
            port.write(FORWARD)
            data = port.read(200)
            assert len(data) == 200
            assert Decoder().feed(data) == []
        wait_until(lambda: own_emulator.received() == FORWARD * 10, "all that was sent")
        wait_for_log(own_emulator, time.monotonic() + 0.2)
    assert set(own_emulator.poses()) == {(0.0, 0.0, 0.0)}


def test_emulate_does_not_replay_a_stall(emulator: Emulated) -> None:
    emulator.pause()
    time.sleep(2.0 * LONGEST_CATCH_UP)
    resumed = time.monotonic()
    emulator.resume()
    wait_for_log(emulator, resumed + 0.2)
    loops = [e["t"] for e in emulator.events() if "pose" in e and e["t"] > resumed]
    assert len(loops) * LOOP < loops[-1] - resumed + LONGEST_CATCH_UP + LOOP
    assert sum(event.get("lost", 0.0) for event in emulator.events()) > LONGEST_CATCH_UP


def test_emulate_ends_after_a_duration_or_if_its_log_cannot_be_written(tmp_path: Path) -> None:
    log = tmp_path / "log.jsonl"
    done = cli("emulate", "--duration", "0.2", "--log", log)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("serving a robot on /dev/")
    assert 1 <= log.read_text(encoding="ascii").count('"pose": [0.0, 0.0, 0.0]') <= 41
    done = cli("emulate", "--duration", "0.2", "--log", "/dev/full")
    assert done.returncode == 2
    assert done.stderr == "acsar-gym: /dev/full: can't be written: No space left on device\n"


def test_emulator_leaves_nothing_open(config: RobotConfig, tmp_path: Path) -> None:
    (tmp_path / "kept").touch()
    log = tmp_path / "log.jsonl"
    with no_leak():
        with Emulator(config, log=log) as emulator:
            emulator.run(duration=0.05)
            with pytest.raises(ConfigError, match="must be a finite number of seconds"):
                emulator.run(duration=float("nan"))
            emulator.close()
        with pytest.raises(ConfigError, match="balloon"):
            Emulator(config, body="balloon")
        with pytest.raises(ConfigError, match="symbolic link"):
            Emulator(config, log=log, sees=True, name=tmp_path / "kept")


@pytest.mark.parametrize("body", ["planar", "bullet"])
def test_emulator_starts_movers_with_the_first_bytes(
    body: str, config: RobotConfig, tmp_path: Path
) -> None:
    """A person touches the robot 0.2 s after them, and the log contains who ran into whom."""
    walker = walk([[-0.25 - config.body.length / 2.0 - 0.2, 0.0], [9.0, 0.0]], 1.0)
    scene = Scene((0.0, 0.0, 0.0), world=World(movers=(walker,)))
    log = tmp_path / "log.jsonl"
    with Emulator(config, body=body, scene=scene, log=log) as emulator:
        port = os.open(emulator.device, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        tty.setraw(port)
        for _ in range(60):
            emulator.run_loop()
        os.write(port, encode(ZERO))
        for _ in range(60):
            emulator.run_loop()
        os.close(port)

    events = [json.loads(line) for line in log.read_text(encoding="ascii").splitlines()]
    first = next(number for number, event in enumerate(events) if "rx" in event)
    episode = [event for event in events[first:] if "pose" in event]
    hits = {number: event["hit"] for number, event in enumerate(episode) if "hit" in event}
    assert min(hits) in range(39, 43)
    assert {*hits.values()} == {PERSON_HIT}
    assert max(event["pose"][0] for event in episode[:39]) < 1e-3
    pushed = 0.1 if body == "bullet" else 0.0
    assert episode[-1]["pose"][0] == pytest.approx(pushed, abs=0.02)
