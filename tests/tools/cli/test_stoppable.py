"""Commands that turn real wheels want somebody to be able to stop them."""

from __future__ import annotations

import pytest
from cli_tools import Call, assert_one_line

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


def test_every_command_that_drives_is_here() -> None:
    """Those of ROS, which needs to be there, are in tests/ros."""
    driving = {name for name, command in COMMANDS.items() if command.drives}
    assert set(DRIVES) == driving - {"ros driver", "ros policy"}


@pytest.mark.filterwarnings("ignore:'acsar-gym estop' can't stop:acsar_gym.errors.SafetyWarning")
@pytest.mark.parametrize("command", DRIVES.values(), ids=DRIVES)
def test_a_drive_that_nobody_can_stop_is_refused_unless_it_is_meant(
    command: str, call: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ACSAR_GYM_RUNTIME_DIR", "/dev/null/in-the-way")
    code, _, error = call(*command.split())
    assert code == 3
    assert_one_line(error, f"{MISSING}: 'acsar-gym estop' couldn't stop this robot: ")
    if command.startswith("evaluate"):
        return
    assert error.endswith("; or drive without an emergency stop: --without-estop\n")
    code, out, error = call(*command.split(), "--without-estop")
    assert code in (1, 3)
    assert "no such device" in out + error
    assert "couldn't stop" not in error


def test_what_turns_no_real_wheels_needs_no_stop(
    call: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ACSAR_GYM_RUNTIME_DIR", "/dev/null/in-the-way")
    assert call("drive", "--link", "planar", "--linear", "0.1", "--duration", "0.1")[0] == 0
    code, out, _ = call("doctor", MISSING)
    assert code == 1
    assert "won't be heard" in " ".join(out.split())
