"""Runs of recordings."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from calibration_tools import ACSAR

from acsar_gym.errors import ConfigError
from acsar_gym.recording import Recorder
from acsar_gym.tools.sysid import calibration_drive
from acsar_gym.tools.sysid.calibrate import DrivenRobot, drive_runs
from acsar_gym.tools.sysid.calibration_runs import read_recorded_runs

PLANS = calibration_drive.plan_turns(0.5, (1.2,), (0.0,), 2)


def test_a_recording_holds_the_same_runs(tmp_path: Path) -> None:
    path = tmp_path / "turns.mcap"
    wire = replace(DrivenRobot("planar", ACSAR, ACSAR), recorder=Recorder(path))
    driven = drive_runs(wire, PLANS, None, lambda _: None, lambda run: run, truth=False)
    found = read_recorded_runs(path, "turn", ACSAR)
    assert [run.name for run in found] == ["turn 1 of turns.mcap", "turn 2 of turns.mcap"]
    for one, other in zip(driven, found, strict=True):
        assert np.abs(one.wheels[-1] - other.wheels[-1]).max() < 1e-6
    with pytest.raises(ConfigError, match=r"another robot: wheelbase is 0\.22 there and 0\.3 here"):
        read_recorded_runs(path, "turn", ACSAR.with_(wheelbase=0.3))
    with pytest.raises(ConfigError, match="say what was recorded: straight, turn or square"):
        read_recorded_runs(path, "all", ACSAR)


def test_foreign_recordings_are_one_error(tmp_path: Path) -> None:
    path = tmp_path / "other.mcap"
    path.write_bytes(b"no recording")
    with pytest.raises(ConfigError) as told:
        read_recorded_runs(path, "turn", ACSAR)
    assert "\n" not in str(told.value)
