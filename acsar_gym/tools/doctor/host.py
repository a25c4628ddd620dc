"""Real-time priority of this process, and checks of what delays ticks on this computer."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

from acsar_gym.config import BITS_PER_BYTE, LINE_BYTES, RobotConfig
from acsar_gym.errors import BUSY_HINT, ConfigError
from acsar_gym.tools.doctor.checks import Check

WITHOUT_REALTIME = "or run without --realtime"
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

    Args:
        priority: SCHED_FIFO priority, 1 to 98; None to leave it.
        cores: numbers of the cores to run on; None to leave them.

    Raises:
        ConfigError: it isn't allowed or possible.
    """
    if cores is not None:
        _pin(cores)
    if priority is not None:
        _raise_priority(priority)


def _pin(cores: Sequence[int]) -> None:
    """Set the CPU affinity."""
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
        raise ConfigError(
            f"cores = {_listed(cores)}: this process may use {_listed(sorted(before))}; "
            "name some of those, or run without --cores"
        )


def _listed(cores: Sequence[int]) -> str:
    return ", ".join(map(str, cores)) or "none"


def _raise_priority(priority: int) -> None:
    """Set the SCHED_FIFO priority."""
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
    except OSError:
        raise ConfigError(_not_allowed(priority)) from None


def _not_allowed(priority: int) -> str:
    """Return the error message for a priority that isn't allowed."""
    if os.geteuid() == 0:
        return (
            f"real-time priority {priority}: refused even to root, as in a container: start it "
            f"with 'docker run --cap-add SYS_NICE', {WITHOUT_REALTIME}"
        )
    return (
        f"real-time priority {priority}: not allowed for this user: put the line '@realtime - "
        f"rtprio {max(90, priority + 1)}' into {LIMITS_FILE}, then 'sudo groupadd -f "
        "realtime; sudo "
        f"usermod -aG realtime $USER' and log in again, {WITHOUT_REALTIME}"
    )


def check_computer(device: str | None, config: RobotConfig, root: Path = Path("/")) -> list[Check]:
    """Check what in this computer, and between it and the device, delays ticks or feedback.

    Args:
        device: the serial device; None for none. Its link must be open, which disables an
            adapter's latency timer.
        config: configuration of the robot.
        root: folder with sys and proc.

    Returns:
        The results.
    """
    return [
        *_processor(root),
        *(_way_to(device, root) if device and "://" not in device else ()),
        _wire(config),
    ]


def _processor(root: Path) -> Iterator[Check]:
    """Check kernel, frequency scaling and load."""
    cores = _cores()
    yield Check(
        "cores",
        "ok" if cores > 1 else "warn",
        f"{cores}",
        "" if cores > 1 else BUSY_HINT,
    )
    load = _read(root / "proc/loadavg").split(" ")[0]
    busy = bool(load) and float(load) > BUSY_LOAD * cores
    yield Check(
        "load",
        "warn" if busy else "ok" if load else "skip",
        f"{load} of {cores}" if load else "not told here",
        BUSY_HINT if busy else "",
    )
    files = sorted(root.glob("sys/devices/system/cpu/cpu[0-9]*/cpufreq/scaling_governor"))
    governors = sorted({_read(file) for file in files} - {""})
    slow = any(governor != "performance" for governor in governors)
    yield Check(
        "CPU governor",
        "warn" if slow else "ok" if governors else "skip",
        ", ".join(governors) or "none here: the frequency is fixed, or a hypervisor's affair",
        "sudo cpupower frequency-set -g performance" if slow else "",
    )


def _cores() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _way_to(device: str, root: Path) -> Iterator[Check]:
    """Check the USB adapter of a device."""
    name = (root / device.lstrip("/")).resolve().name
    yield _latency_timer(name, root)
    yield _low_latency(device, root / "sys/class/tty" / name / "flags")
    yield _hubs(root / "sys/class/tty" / name / "device")


def _latency_timer(name: str, root: Path) -> Check:
    """Check the latency timer of an FTDI adapter."""
    file = f"sys/bus/usb-serial/devices/{name}/latency_timer"
    delay = _read(root / file)
    if not delay:
        return Check("FTDI latency timer", "skip", "no such timer: not an FTDI adapter")
    slow = delay != "1"
    return Check(
        "FTDI latency timer",
        "warn" if slow else "ok",
        f"{delay} ms: feedback waits up to so long",
        f"echo 1 | sudo tee /{file}" if slow else "",
    )


def _low_latency(device: str, file: Path) -> Check:
    """Check the low-latency flag of a serial driver."""
    flags = _read(file)
    if not flags:
        return Check("low-latency mode", "skip", "this driver has none, or doesn't tell")
    on = bool(int(flags, 16) & LOW_LATENCY_FLAG)
    fix = "" if on else f"sudo setserial {device} low_latency"
    return Check("low-latency mode", "ok" if on else "warn", "on" if on else "off", fix)


def _hubs(link: Path) -> Check:
    """Check for USB hubs between computer and adapter."""
    ports = [part for part in link.resolve().parts if USB_PORT_NAME.fullmatch(part)]
    if not ports:
        return Check("USB hub", "skip", "not a USB device")
    hubs = ports[-1].count(".")
    return Check(
        "USB hub",
        "warn" if hubs > 1 else "ok",
        ("straight into the computer", "one hub, maybe the computer's own")[hubs]
        if hubs < 2
        else f"{hubs} hubs in a row",
        "plug it straight into the computer" if hubs > 1 else "",
    )


def _wire(config: RobotConfig) -> Check:
    """Check the utilization of the serial line."""
    line = LINE_BYTES + config.trailing_comma
    lines = config.baud_rate / (BITS_PER_BYTE * line)
    rates = f"{config.control_rate:g} commands and {config.feedback_rate:g} feedback lines"
    tight = max(config.control_rate, config.feedback_rate) > TIGHT_LINE * lines
    return Check(
        "baud rate",
        "warn" if tight else "ok",
        f"{config.baud_rate} baud carries {int(lines)} lines/s each way, {1000.0 / lines:.1f} ms a "
        f"line; {rates} are wanted",
        "use a higher baud_rate, on the board too, or a lower rate" if tight else "",
    )


def _read(file: Path) -> str:
    """Read a small file; empty if it doesn't exist."""
    try:
        return file.read_text(encoding="ascii").strip()
    except (OSError, ValueError):
        return ""
