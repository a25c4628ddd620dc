"""A small recording that all tests of the dashboard read."""

from __future__ import annotations

from pathlib import Path

import pytest
from recording_tools import drive

from acsar_gym import RobotConfig


@pytest.fixture(scope="session")
def tape(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """1.2 s of the planar robot, with a LiDAR."""
    return drive(tmp_path_factory.mktemp("dashboard") / "tape.mcap", RobotConfig.of(None))
