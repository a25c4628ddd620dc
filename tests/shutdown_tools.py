"""Programs that drive until something ends them."""

from __future__ import annotations

from serial_tools import Emulated, wait_until

IN_BLOCK = """
with robot:
    drive({ticks})
    {end}
"""

FOREVER = 10**9


def drives(emulator: Emulated) -> None:
    wait_until(emulator.is_driven, "a command that turns the wheels")


def assert_stopped(emulator: Emulated) -> None:
    """Wheels turned, then a zero command came; the process is gone, so nothing follows it."""
    wait_until(emulator.is_stopped, "zero as the last command")
