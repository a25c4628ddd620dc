"""Real-time priority of this process, and checks of what delays ticks on this computer."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

from acsar_gym.config import RobotConfig
from acsar_gym.errors import BUSY_HINT, ConfigError
from acsar_gym.tools.commission.checks import Check, warn_if

LIMITS_FILE = "/etc/security/limits.d/99-realtime.conf"
BUSY_LOAD = 0.7
"""Load, as a share of the cores, above which the control loop may have to wait."""
TIGHT_LINE = 0.8
"""Utilization of the serial line above which late lines can pile up."""
LOW_LATENCY_FLAG = 1 << 13
"""ASYNC_LOW_LATENCY of linux/tty_flags.h."""
USB_PORT_NAME = re.compile(r"\d+-\d+(\.\d+)*")
"""Name of a USB port in sysfs: bus, root port, and ".port" for each hub."""


def prepare_realtime(priority: int | None = None, cores: Sequence[int] | None = None) -> None:
    """Set scheduling and CPU affinity of this thread and of those that it starts.

    Open links afterwards: their watchdogs run with one priority more, which must be allowed, too.

    Raises:
        ConfigError: it isn't allowed or possible.
    """
    if cores is not None:
        _pin_to_cores(cores)
    if priority is None:
        return
    if not hasattr(os, "sched_setscheduler"):
        raise ConfigError(
            "real-time priority: this operating system has no SCHED_FIFO; run without --realtime"
        )
    low = os.sched_get_priority_min(os.SCHED_FIFO)
    high = os.sched_get_priority_max(os.SCHED_FIFO) - 1
    if not low <= priority <= high:
        raise ConfigError(f"real-time priority = {priority}: must be {low} to {high}")
    try:
        for allowed in (priority + 1, priority):
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(allowed))
    except OSError as error:
        if os.geteuid() == 0:
            why = (
                "refused even to root, as in a container: start it with 'docker run --cap-add "
                "SYS_NICE'"
            )
        else:
            why = (
                f"not allowed for this user: put the line '@realtime - rtprio "
                f"{max(90, priority + 1)}' into {LIMITS_FILE}, then 'sudo groupadd -f realtime; "
                "sudo usermod -aG realtime $USER' and log in again"
            )
        raise ConfigError(
            f"real-time priority {priority}: {why}, or run without --realtime"
        ) from error


def _pin_to_cores(cores: Sequence[int]) -> None:
    if not hasattr(os, "sched_setaffinity"):
        raise ConfigError("cores: this operating system can't pin a process; run without --cores")
    before = os.sched_getaffinity(0)
    try:
        os.sched_setaffinity(0, cores)
        missing = set(cores) - os.sched_getaffinity(0)
    except (OSError, OverflowError, ValueError):  # ValueError: a negative number
        missing = set(cores)
    if missing or not cores:
        os.sched_setaffinity(0, before)
        asked, allowed = (", ".join(map(str, those)) or "none" for those in (cores, sorted(before)))
        raise ConfigError(
            f"cores = {asked}: this process may use {allowed}; name some of those, or run without "
            "--cores"
        )


def check_computer(
    device: str | None, config: RobotConfig, root: Path = Path("/")
) -> Iterator[Check]:
    """Check what in this computer, and between it and the device, delays ticks or feedback.

    Args:
        device: the serial device; None for none. Its link must be open, which disables an
            adapter's latency timer.
        config: configuration of the robot.
        root: folder with sys and proc.
    """
    has_affinity = hasattr(os, "sched_getaffinity")
    cores = len(os.sched_getaffinity(0)) if has_affinity else os.cpu_count() or 1
    yield warn_if(cores < 2, "cores", f"{cores}", BUSY_HINT)
    if load := _read_text(root / "proc/loadavg").split(" ")[0]:
        busy = float(load) > BUSY_LOAD * cores
        yield warn_if(busy, "load", f"{load} of {cores}", BUSY_HINT)
    else:
        yield Check("load", "skip", "not told here")
    files = root.glob("sys/devices/system/cpu/cpu[0-9]*/cpufreq/scaling_governor")
    if governors := sorted({_read_text(file) for file in files} - {""}):
        slow = governors != ["performance"]
        advice = "sudo cpupower frequency-set -g performance"
        yield warn_if(slow, "CPU governor", ", ".join(governors), advice)
    else:
        none = "none here: the frequency is fixed, or a hypervisor's affair"
        yield Check("CPU governor", "skip", none)
    if device and "://" not in device:
        yield from _check_adapter(device, root)
    lines = 1.0 / config.line_time
    yield warn_if(
        max(config.control_rate, config.feedback_rate) > TIGHT_LINE * lines,
        "baud rate",
        f"{config.baud_rate} baud carries {int(lines)} lines/s each way, {1000.0 / lines:.1f} ms a "
        f"line; {config.control_rate:g} commands and {config.feedback_rate:g} feedback lines are "
        "wanted",
        "use a higher baud_rate, on the board too, or a lower rate",
    )


def _check_adapter(device: str, root: Path) -> Iterator[Check]:
    """Check the USB adapter of a device: latency timer, low-latency flag, and hubs on the way."""
    name = (root / device.lstrip("/")).resolve().name
    timer = f"sys/bus/usb-serial/devices/{name}/latency_timer"
    if delay := _read_text(root / timer):
        found = f"{delay} ms: feedback waits up to so long"
        yield warn_if(delay != "1", "FTDI latency timer", found, f"echo 1 | sudo tee /{timer}")
    else:
        yield Check("FTDI latency timer", "skip", "no such timer: not an FTDI adapter")
    if flags := _read_text(root / "sys/class/tty" / name / "flags"):
        off = not int(flags, 16) & LOW_LATENCY_FLAG
        advice = f"sudo setserial {device} low_latency"
        yield warn_if(off, "low-latency mode", "off" if off else "on", advice)
    else:
        yield Check("low-latency mode", "skip", "this driver has none, or doesn't tell")
    path = (root / "sys/class/tty" / name / "device").resolve()
    ports = [part for part in path.parts if USB_PORT_NAME.fullmatch(part)]
    if not ports:
        yield Check("USB hub", "skip", "not a USB device")
        return
    hubs = ports[-1].count(".")
    found = ("straight into the computer", "one hub, maybe the computer's own")[min(hubs, 1)]
    many = hubs > 1
    found = f"{hubs} hubs in a row" if many else found
    yield warn_if(many, "USB hub", found, "plug it straight into the computer")


def _read_text(file: Path) -> str:
    """Read a small file; empty if it doesn't exist."""
    try:
        return file.read_text(encoding="ascii").strip()
    except (OSError, ValueError):
        return ""
