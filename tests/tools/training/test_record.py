"""What is recorded of the command of a training."""

from __future__ import annotations

from pathlib import Path

import pytest

from acsar_gym.tools.training import record
from acsar_gym.tools.training.plan import TrainingOptions


@pytest.mark.parametrize(
    ("given", "kept"),
    [
        ({"env": "barn", "seed": 3, "net": (64, 64)}, "--env barn --seed 3 --net 64 64"),
        ({"resume": Path("/home/me/cut"), "trust": True}, "--resume cut --trust"),
        (
            {"robot": "/home/me/my.yaml", "worlds": ("clutter", "/home/me/hall.world")},
            "--worlds clutter --worlds hall.world --robot my.yaml",
        ),
        (
            {"randomize": False, "seeds": "0-3", "address": "ray://10.0.0.3"},
            "--seeds 0-3 --no-randomize",
        ),
    ],
)
def test_the_command_names_no_folder_and_no_address(given: dict[str, object], kept: str) -> None:
    options = TrainingOptions(out=Path("/home/me/run"), **given)
    assert record.training_command(options) == ["acsar-gym", "train", *kept.split()]
