"""The planar robot and PyBullet's do the same, through the wire."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from acsar_gym.bench import comparison
from acsar_gym.bench.comparison import DRIVES, difference, trace
from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError

CONFIG = RobotConfig.preset("acsar")


@pytest.mark.parametrize("name", DRIVES)
def test_planar_and_bullet_do_the_same_for_ten_seconds(name: str) -> None:
    apart = difference(*(trace(link, DRIVES[name], CONFIG) for link in ("bullet", "planar")))
    assert apart.position < 0.03
    assert apart.heading < max(math.radians(2.0), 0.01 * apart.turned)
    assert apart.wheels < 0.05


def test_a_different_robot_would_be_noticed() -> None:
    other = CONFIG.with_(wheelbase=0.24)
    apart = difference(
        trace("bullet", DRIVES["arc"], CONFIG), trace("planar", DRIVES["arc"], other)
    )
    assert apart.position > 0.03


def test_hardware_cannot_be_compared() -> None:
    with pytest.raises(ConfigError, match="only simulated"):
        trace("/dev/ttyUSB0", DRIVES["arc"], CONFIG)


def test_plots_are_drawn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("matplotlib").use("agg")
    monkeypatch.setattr(comparison, "SECONDS", 0.5)
    files = comparison.plot(tmp_path / "plots", CONFIG)
    assert len(files) == len(DRIVES)
    assert all(file.stat().st_size > 10_000 for file in files)
