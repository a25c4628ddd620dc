"""Commands that turn real wheels are refused if 'acsar-gym estop' couldn't stop them."""

from __future__ import annotations

from typing import Any

import pytest

from acsar_gym.tools.cli import COMMANDS

pytestmark = pytest.mark.usefixtures("deadline")

MISSING = "/dev/acsar-missing"
DRIVES = {
    "doctor": f"doctor {MISSING} --spin --yes",
    "drive": f"drive --link {MISSING} --linear 0.1",
    "run": f"run 1 0 --link {MISSING} --yes",
    "evaluate": f"evaluate --link {MISSING} --episodes 1",
    "identify": f"identify {MISSING} --yes",
    "calibrate": f"calibrate {MISSING} straight --yes --space 3 1 --measured 1",
}
"""A drive of a real robot by each command that drives."""


@pytest.fixture(autouse=True)
def _no_sockets(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ACSAR_GYM_RUNTIME_DIR", "/dev/null/in-the-way")


def test_drives_has_every_command_that_drives() -> None:
    """The commands of ROS are tested in tests/ros."""
    driving = {name for name, command in COMMANDS.items() if command.drives}
    assert set(DRIVES) == driving - {"ros driver", "ros policy"}


@pytest.mark.parametrize("command", DRIVES.values(), ids=DRIVES)
def test_a_drive_that_estop_cannot_stop_is_refused(command: str, call: Any) -> None:
    call.refuse(f"{MISSING}: 'acsar-gym estop' couldn't stop this robot: ", command, code=3)


def test_commands_that_turn_no_real_wheels_need_no_estop(call: Any) -> None:
    assert call("drive --link planar --linear 0.1 --duration 0.1")[0] == 0
    code, out, _ = call(f"doctor {MISSING}")
    assert code == 1
    assert "won't be heard" in " ".join(out.split())
