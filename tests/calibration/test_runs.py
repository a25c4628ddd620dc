"""Files of calibration runs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calibration_tools import ACSAR, SCALES, line

from acsar_gym.errors import ConfigError
from acsar_gym.tools.sysid import calibration_runs
from acsar_gym.tools.sysid.calibration_runs import CalibrationRun, configured_geometry

RUN = CalibrationRun(
    "straight 1",
    "straight",
    line(configured_geometry(ACSAR), 2.0),
    (SCALES.metres("distance", 2.0),),
)


def test_runs_are_read_back_as_they_were_written(tmp_path: Path) -> None:
    path = tmp_path / "cal.json"
    calibration_runs.write_runs(path, [RUN, RUN.read([])], ACSAR)
    one, two = calibration_runs.read_runs(path, ACSAR)
    assert (one.name, one.manoeuvre, one.readings) == (RUN.name, RUN.manoeuvre, RUN.readings)
    assert np.abs(one.wheels - RUN.wheels).max() < 1e-6
    assert two.readings == ()
    assert calibration_runs.hash_runs([one], ACSAR) == calibration_runs.hash_runs([RUN], ACSAR)


def test_runs_of_another_robot_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "cal.json"
    calibration_runs.write_runs(path, [RUN], ACSAR)
    with pytest.raises(
        ConfigError, match=r"another robot: wheel_separation is 0\.3 there and 0\.4"
    ):
        calibration_runs.read_runs(path, ACSAR.with_(wheel_separation=0.4))


def broken(**changes: Any) -> bytes:
    data = json.loads(json.dumps(calibration_runs.format_runs([RUN], ACSAR)))
    data["runs"][0] |= changes
    return json.dumps(data).encode()


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "not valid JSON"),
        (broken()[:200], "not valid JSON"),
        (b"[1, 2]", "isn't a file of calibration runs"),
        (b'{"success_rate": 1.0}', "isn't a file of calibration runs"),
        (broken(wheels=[[0.0, 0.0]]), "not \\(n, 2\\)"),
        (broken(wheels=[[0.0, 1e9], [0.0, 1.0]]), "too large"),
        (broken(wheels=[[0.0], [1.0, 2.0]]), "broken calibration runs"),
        (broken(manoeuvre="dance"), "unknown manoeuvre 'dance'"),
        (broken(readings=[{"kind": "x"}]), "broken calibration runs"),
        (
            broken(readings=[{"kind": "x", "value": 1.0, "sigma": 0.0, "source": "tape"}]),
            "bad reading",
        ),
    ],
)
def test_cut_and_foreign_files_are_one_error(tmp_path: Path, content: bytes, said: str) -> None:
    path = tmp_path / "cal.json"
    path.write_bytes(content)
    with pytest.raises(ConfigError, match=said) as told:
        calibration_runs.read_runs(path, ACSAR)
    assert str(path) in str(told.value)
    assert "\n" not in str(told.value)
