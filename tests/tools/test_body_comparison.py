"""The planar robot and PyBullet's do the same, through the wire."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError
from acsar_gym.tools import body_comparison
from acsar_gym.tools.body_comparison import COMPARED_DRIVES, DriveTrace, record_trace

CONFIG = RobotConfig.preset("acsar")


def heading_change(before: float, after: float) -> float:
    return abs(math.remainder(after - before, 2.0 * math.pi))


def distance(one: DriveTrace, other: DriveTrace) -> float:
    """The largest distance between two robots [m]."""
    pairs = zip(one.poses, other.poses, strict=True)
    return max(math.dist(p[:2], q[:2]) for p, q in pairs)


@pytest.mark.parametrize("name", COMPARED_DRIVES)
def test_planar_and_bullet_do_the_same_for_ten_seconds(name: str) -> None:
    one, other = (
        record_trace(link, COMPARED_DRIVES[name], CONFIG) for link in ("bullet", "planar")
    )
    assert distance(one, other) < 0.03
    headings, others = ([pose[2] for pose in trace.poses] for trace in (one, other))
    turned = sum(map(heading_change, headings[:-1], headings[1:]))
    assert max(map(heading_change, headings, others)) < max(math.radians(2.0), 0.01 * turned)
    assert np.abs(np.subtract(one.wheels, other.wheels)).max() < 0.05


def test_a_different_robot_would_be_noticed() -> None:
    other = CONFIG.with_(wheelbase=0.24)
    drive = COMPARED_DRIVES["arc"]
    same, longer = record_trace("bullet", drive, CONFIG), record_trace("planar", drive, other)
    assert distance(same, longer) > 0.03


def test_hardware_cannot_be_compared() -> None:
    with pytest.raises(ConfigError, match="only simulated"):
        record_trace("/dev/ttyUSB0", COMPARED_DRIVES["arc"], CONFIG)


def test_plots_are_drawn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("matplotlib").use("agg")
    monkeypatch.setattr(body_comparison, "DRIVE_SECONDS", 0.5)
    files = body_comparison.plot_drives(tmp_path / "plots", CONFIG)
    assert len(files) == len(COMPARED_DRIVES)
    assert all(file.stat().st_size > 10_000 for file in files)
