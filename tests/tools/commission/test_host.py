"""Real-time priority and pinning, allowed and refused; sysfs as other computers have it."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from acsar_gym import RobotConfig
from acsar_gym.errors import ConfigError
from acsar_gym.tools.commission import host as realtime
from acsar_gym.tools.commission.checks import Check

linux = pytest.mark.skipif(
    not hasattr(os, "sched_setscheduler"), reason="this system has no SCHED_FIFO"
)
CABLE = "usb-FTDI_FT232R-if00-port0"
PREPARE = """
import os, sys
from acsar_gym.errors import ConfigError
from acsar_gym.tools.commission.host import prepare_realtime
try:
    prepare_realtime(20, [min(os.sched_getaffinity(0))])
except ConfigError as error:
    print(error)
else:
    print("prepared", os.sched_getscheduler(0) == os.SCHED_FIFO,
          os.sched_getparam(0).sched_priority, len(os.sched_getaffinity(0)))
"""


def put(root: Path, file: str, text: str) -> None:
    (root / file).parent.mkdir(parents=True, exist_ok=True)
    (root / file).write_text(f"{text}\n", encoding="ascii")


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Two cores and an FTDI cable in a port of the computer, set up as it should be."""
    put(tmp_path, "proc/loadavg", "0.20 0.10 0.05 1/100 4242")
    for core in (0, 1):
        put(tmp_path, f"sys/devices/system/cpu/cpu{core}/cpufreq/scaling_governor", "performance")
    (tmp_path / "dev/serial/by-id").mkdir(parents=True)
    (tmp_path / "dev/ttyUSB0").touch()
    (tmp_path / "dev/serial/by-id" / CABLE).symlink_to("../../ttyUSB0")
    plug(tmp_path, "1-2")
    put(tmp_path, "sys/bus/usb-serial/devices/ttyUSB0/latency_timer", "1")
    return tmp_path


def plug(root: Path, port: str) -> None:
    """The cable in a USB port, as sysfs spells it."""
    place = root / f"sys/devices/pci0000:00/0000:00:14.0/usb1/1-2/{port}/{port}:1.0/ttyUSB0"
    place.mkdir(parents=True)
    link = root / "sys/class/tty/ttyUSB0/device"
    link.parent.mkdir(parents=True, exist_ok=True)
    link.unlink(missing_ok=True)
    link.symlink_to(place)


@pytest.fixture
def found(
    root: Path, config: RobotConfig, monkeypatch: pytest.MonkeyPatch
) -> Callable[..., dict[str, Check]]:
    """`found(device)`: the findings about that computer, by name."""
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1}, raising=False)

    def look(device: str | None = "/dev/ttyUSB0", config: RobotConfig = config) -> dict[str, Check]:
        return {check.name: check for check in realtime.check_computer(device, config, root)}

    return look


@pytest.mark.parametrize("device", ["/dev/ttyUSB0", f"/dev/serial/by-id/{CABLE}"])
def test_a_computer_without_a_fault(device: str, found: Callable[..., dict[str, Check]]) -> None:
    checks = found(device)
    here = {"cores", "load", "CPU governor", "baud rate"}
    assert set(checks) == here | {"FTDI latency timer", "low-latency mode", "USB hub"}
    for elsewhere in (None, "socket://192.168.4.1:2000"):
        assert set(found(elsewhere)) == here
    assert {check.status for check in checks.values()} == {"ok", "skip"}
    assert checks["low-latency mode"].status == "skip"
    assert not any(check.fix for check in checks.values())


@pytest.mark.parametrize(
    ("file", "text", "name", "said", "fix"),
    [
        ("proc/loadavg", "1.90 1 1 2/9 7", "load", "1.90 of 2", "--realtime 10"),
        (
            "sys/devices/system/cpu/cpu1/cpufreq/scaling_governor",
            "powersave",
            "CPU governor",
            "performance, powersave",
            "cpupower frequency-set -g performance",
        ),
        (
            "sys/bus/usb-serial/devices/ttyUSB0/latency_timer",
            "16",
            "FTDI latency timer",
            "16 ms",
            "echo 1 | sudo tee /sys/bus/usb-serial/devices/ttyUSB0/latency_timer",
        ),
        (
            "sys/class/tty/ttyUSB0/flags",
            "0x10000040",
            "low-latency mode",
            "off",
            "sudo setserial /dev/ttyUSB0 low_latency",
        ),
    ],
)
def test_what_makes_ticks_late(
    file: str,
    text: str,
    name: str,
    said: str,
    fix: str,
    root: Path,
    found: Callable[..., dict[str, Check]],
) -> None:
    put(root, file, text)
    checks = found()
    assert [check.name for check in checks.values() if check.status == "warn"] == [name]
    assert said in checks[name].found
    assert fix in checks[name].fix


@linux
@pytest.mark.parametrize(
    ("arguments", "user", "said"),
    [
        ((50,), 1000, "@realtime - rtprio 90' into /etc/security/limits.d/"),
        ((95,), 1000, "@realtime - rtprio 96'"),
        ((50,), 0, "--cap-add SYS_NICE"),
        ((0,), 1000, "must be 1 to 98"),
        ((99,), 0, "must be 1 to 98"),
        *(((None, cores), 0, "--cores") for cores in ([], [-1], [0, 10**6], [10**30])),
        ((50,), None, "this operating system"),
        ((None, [0]), None, "this operating system"),
    ],
)
def test_what_cannot_be_had_is_one_line(
    arguments: tuple[Any, ...], user: int | None, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`user` None is another operating system."""

    def scheduler(*_: Any) -> None:
        raise PermissionError(1, "Operation not permitted")

    before = os.sched_getaffinity(0)
    with monkeypatch.context() as patch:
        if user is None:
            patch.delattr(os, "sched_setscheduler")
            patch.delattr(os, "sched_setaffinity")
        else:
            patch.setattr(os, "sched_setscheduler", scheduler)
            patch.setattr(os, "geteuid", lambda: user)
        with pytest.raises(ConfigError) as caught:
            realtime.prepare_realtime(*arguments)
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)
    assert os.sched_getaffinity(0) == before


@linux
def test_in_a_process_of_its_own_with_room_above_for_the_watchdog(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[int] = []
    monkeypatch.setattr(
        os, "sched_setscheduler", lambda _, __, param: asked.append(param.sched_priority)
    )
    realtime.prepare_realtime(50)
    assert asked == [51, 50]
    done = subprocess.run(
        [sys.executable, "-c", PREPARE], capture_output=True, text=True, timeout=60, check=True
    )
    said = done.stdout.strip()
    assert said == "prepared True 20 1" or "run without --realtime" in said
