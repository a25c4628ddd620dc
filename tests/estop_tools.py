"""Processes that an emergency stop is for."""

from __future__ import annotations

import sys
import threading
import time

import pytest

from acsar_gym.__main__ import main
from acsar_gym.safety import estop

DRIVING = """
import sys
from acsar_gym.tools.cli import main
sys.argv = ["acsar-gym", *sys.argv[1:]]
main()
"""


def answering(listener: estop.StopListener) -> threading.Thread:
    """A control loop that heeds one stop."""

    def loop() -> None:
        while not listener.is_requested():
            time.sleep(0.001)
        listener.confirm()

    thread = threading.Thread(target=loop, daemon=True)
    thread.start()
    return thread


def estop_command(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, *arguments: str
) -> tuple[object, str, str]:
    """`acsar-gym estop ARGUMENTS`: exit code, output, errors."""
    monkeypatch.setattr(sys, "argv", ["acsar-gym", "estop", *arguments])
    with pytest.raises(SystemExit) as ended:
        main()
    return ended.value.code, *capsys.readouterr()
