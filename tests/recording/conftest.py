"""A recording that several files of tests read."""

from __future__ import annotations

from pathlib import Path

import pytest
from recording_tools import record_env
from scenes import HALL


@pytest.fixture(scope="session")
def tape(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two episodes of an env with a LiDAR, among people."""
    path = tmp_path_factory.mktemp("tape") / "my tape.mcap"
    return record_env(path, "obstacle_goal", 2, worlds=HALL)
