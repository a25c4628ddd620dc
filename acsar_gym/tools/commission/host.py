"""Real-time priority and processor cores of this process."""

from __future__ import annotations

import os
from collections.abc import Sequence

from acsar_gym.errors import ConfigError

LIMITS_FILE = "/etc/security/limits.d/99-realtime.conf"


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
        # The watchdog needs one priority more, so try whether it would be allowed.
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

    # The kernel may ignore some of the cores without an error.
    allowed = os.sched_getaffinity(0)
    try:
        os.sched_setaffinity(0, cores)
        missing = set(cores) - os.sched_getaffinity(0)
    except (OSError, OverflowError, ValueError):  # ValueError: a negative number
        missing = set(cores)
    if missing or not cores:
        os.sched_setaffinity(0, allowed)
        raise ConfigError(
            f"cores = {_list_cores(cores)}: this process may use {_list_cores(sorted(allowed))}; "
            "name some of those, or run without --cores"
        )


def _list_cores(cores: Sequence[int]) -> str:
    return ", ".join(map(str, cores)) or "none"
