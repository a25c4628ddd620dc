"""A LiDAR that is frozen, unplugged, busy, or something else."""

from __future__ import annotations

import functools
import re
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from serial_lidar_tools import MODELS, Open, Start, reset, shows_the_room
from serial_tools import no_leak, wait_until

from acsar_gym.errors import ConfigError, LidarError
from acsar_gym.lidar import serial as serial_lidar
from acsar_gym.lidar.drivers import rplidar
from acsar_gym.lidar.serial import SerialLidar

pytestmark = pytest.mark.usefixtures("deadline")


def error_of(action: Callable[[], object]) -> str:
    """The LidarError's message, which is one line. The device is closed again."""
    with no_leak(), pytest.raises(LidarError) as caught:
        action()
    message = str(caught.value)
    assert "\n" not in message
    assert caught.value.fix
    return message


def is_lost(lidar: SerialLidar) -> bool:
    try:
        lidar.scan()
    except LidarError as error:
        return "lost while in use" in str(error)
    return False


def scans_again(lidar: SerialLidar) -> bool:
    try:
        return shows_the_room(lidar.scan())
    except LidarError:
        return False


def test_serial_lidar_comes_back_after_a_freeze(
    start: Start, make: Open, monkeypatch: pytest.MonkeyPatch
) -> None:
    emulated = start()
    lidar = make(emulated, timeout=0.5)
    reset(lidar)
    emulated.pause()
    wait_until(lambda: not scans_again(lidar), "the time-out")

    with pytest.raises(LidarError, match=r"no complete turn for .* \(lidar.timeout = 0.5 s\)"):
        lidar.scan()
    monkeypatch.setattr(rplidar, "ANSWER_TIMEOUT", 0.05)
    with pytest.raises(LidarError, match="no answer"):
        reset(lidar)
    with pytest.raises(LidarError, match="is closed"):
        lidar.scan()
    emulated.process.send_signal(signal.SIGCONT)
    monkeypatch.undo()
    reset(lidar)


@pytest.fixture
def plug(tmp_path: Path) -> Path:
    """A name of this device: the terminal's name may be given to another once it is unplugged."""
    return tmp_path / "rplidar"


@pytest.mark.parametrize("model", MODELS)
def test_serial_lidar_is_opened_again_after_it_was_unplugged(
    start: Start, make: Open, plug: Path, model: str
) -> None:
    emulated = start("--model", model)
    plug.symlink_to(emulated.device)
    lidar = make(str(plug), model)
    reset(lidar)
    emulated.kill()
    plug.unlink()
    wait_until(lambda: is_lost(lidar), "an error")
    lidar.close()
    assert "no such device" in error_of(lambda: reset(lidar))
    plug.symlink_to(start("--model", model).device)
    reset(lidar)
    assert shows_the_room(lidar.scan())


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--fault", "silent"), "no answer in .* s: check its power and cable"),
        (("--fault", "garbage"), "bytes in .* s, but none from .*: check the port's name"),
        (("--baud", "57600"), "bytes in .* s, but none from .*: check|no answer in"),
        (("--fault", "stuck"), "no complete turn in 0.3 s: check that its head|no answer in 0.3"),
        (("--fault", "broken"), "reports error 0x8001"),
    ],
    ids=["silent", "garbage", "baud", "stuck", "broken"],
)
def test_serial_lidar_explains_why_it_does_not_measure(
    start: Start,
    make: Open,
    monkeypatch: pytest.MonkeyPatch,
    model: str,
    arguments: Any,
    said: str,
) -> None:
    if "broken" in arguments and "rplidar" not in model:
        pytest.skip("it can't say so")
    monkeypatch.setattr(rplidar, "ANSWER_TIMEOUT", 0.1)
    monkeypatch.setattr(serial_lidar, "SPIN_UP_TIMEOUT", 0.3)
    lidar = make(start("--model", model, *arguments), model)
    message = error_of(lambda: reset(lidar))
    assert message.startswith(f"LiDAR {lidar.device}: ")
    assert re.search(said, message)


def test_serial_lidar_names_what_cannot_be_opened(make: Open, tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.touch()
    for name, message in (("gone", "no such device"), ("file", "isn't a serial port")):
        lidar = make(str(tmp_path / name))
        assert message in error_of(functools.partial(reset, lidar))
    with pytest.raises(ConfigError, match="must be like"):
        reset(make("socket://nowhere"))
