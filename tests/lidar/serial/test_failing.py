"""A LiDAR that is frozen, unplugged, busy, or something else."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest
from lidar_tools import MODELS, Open, Start, reset, shows_the_room
from serial_tools import no_leak, wait_until

from acsar_gym.errors import ConfigError, LidarError
from acsar_gym.lidar import serial as serial_lidar
from acsar_gym.lidar.drivers import rplidar
from acsar_gym.lidar.serial import SerialLidar

pytestmark = pytest.mark.usefixtures("deadline")


def check_refusal(lidar: SerialLidar, found: str) -> None:
    """Reset a LiDAR in vain. The error is one line, and the device is closed again."""
    with no_leak(), pytest.raises(LidarError, match=f"LiDAR {lidar.device}: .*({found})") as caught:
        reset(lidar)
    assert "\n" not in str(caught.value)
    assert caught.value.fix


def fails(lidar: SerialLidar, found: str) -> bool:
    """Whether a scan is an error of this kind."""
    try:
        lidar.scan()
    except LidarError as error:
        return found in str(error)
    return False


def test_serial_lidar_comes_back_after_a_freeze(
    start: Start, make: Open, monkeypatch: pytest.MonkeyPatch
) -> None:
    emulated = start()
    lidar = make(emulated, timeout=0.5)
    reset(lidar)
    emulated.pause()
    wait_until(lambda: fails(lidar, "(lidar.timeout = 0.5 s)"), "the time-out")
    monkeypatch.setattr(rplidar, "ANSWER_TIMEOUT", 0.05)
    with pytest.raises(LidarError, match="no answer"):
        reset(lidar)
    assert fails(lidar, "is closed")
    emulated.process.send_signal(signal.SIGCONT)
    monkeypatch.undo()
    reset(lidar)


@pytest.mark.parametrize("model", MODELS)
def test_serial_lidar_is_opened_again_after_it_was_unplugged(
    start: Start, make: Open, tmp_path: Path, model: str
) -> None:
    plug = tmp_path / "rplidar"  # the terminal's name may be given to another device
    emulated = start("--model", model)
    plug.symlink_to(emulated.device)
    lidar = make(str(plug), model)
    reset(lidar)
    emulated.kill()
    plug.unlink()
    wait_until(lambda: fails(lidar, "lost while in use"), "an error")
    lidar.close()
    check_refusal(lidar, "no such device")
    plug.symlink_to(start("--model", model).device)
    reset(lidar)
    assert shows_the_room(lidar.scan())


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize(
    ("option", "problem", "found"),
    [
        ("--fault", "silent", "no answer in .* s: check its power and cable"),
        ("--fault", "garbage", "bytes in .* s, but none from .*: check the port's name"),
        ("--baud", "57600", "bytes in .* s, but none from .*: check|no answer in"),
        ("--fault", "stuck", "no complete turn in 0.3 s: check that its head|no answer in 0.3"),
        ("--fault", "broken", "reports error 0x8001"),
    ],
)
def test_serial_lidar_explains_why_it_does_not_measure(
    start: Start,
    make: Open,
    monkeypatch: pytest.MonkeyPatch,
    model: str,
    option: str,
    problem: str,
    found: str,
) -> None:
    if problem == "broken" and "rplidar" not in model:
        pytest.skip("it can't say so")
    monkeypatch.setattr(rplidar, "ANSWER_TIMEOUT", 0.1)
    monkeypatch.setattr(serial_lidar, "SPIN_UP_TIMEOUT", 0.3)
    check_refusal(make(start("--model", model, option, problem), model), found)


def test_serial_lidar_names_what_cannot_be_opened(make: Open, tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.touch()
    check_refusal(make(str(tmp_path / "gone")), "no such device")
    check_refusal(make(str(file)), "isn't a serial port")
    with pytest.raises(ConfigError, match="must be like"):
        reset(make("socket://nowhere"))
