"""The planar robot and PyBullet's do the same, through the wire."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError
from acsar_gym.tools import body_comparison
from acsar_gym.tools.body_comparison import COMPARED_DRIVES, compare_traces, record_trace

CONFIG = RobotConfig.preset("acsar")


@pytest.mark.parametrize("name", COMPARED_DRIVES)
def test_planar_and_bullet_do_the_same_for_ten_seconds(name: str) -> None:
    apart = compare_traces(
        *(record_trace(link, COMPARED_DRIVES[name], CONFIG) for link in ("bullet", "planar"))
    )
    assert apart.position < 0.03
    assert apart.heading < max(math.radians(2.0), 0.01 * apart.turned)
    assert apart.wheels < 0.05


def test_a_different_robot_would_be_noticed() -> None:
    other = CONFIG.with_(wheelbase=0.24)
    apart = compare_traces(
        record_trace("bullet", COMPARED_DRIVES["arc"], CONFIG),
        record_trace("planar", COMPARED_DRIVES["arc"], other),
    )
    assert apart.position > 0.03


def test_hardware_cannot_be_compared() -> None:
    with pytest.raises(ConfigError, match="only simulated"):
        record_trace("/dev/ttyUSB0", COMPARED_DRIVES["arc"], CONFIG)


def test_plots_are_drawn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("matplotlib").use("agg")
    monkeypatch.setattr(body_comparison, "DRIVE_SECONDS", 0.5)
    files = body_comparison.plot_drives(tmp_path / "plots", CONFIG)
    assert len(files) == len(COMPARED_DRIVES)
    assert all(file.stat().st_size > 10_000 for file in files)
