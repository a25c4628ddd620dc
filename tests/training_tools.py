"""Trainings of few steps."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from acsar_gym.tools.training.options import TrainingOptions


def tiny(out: Path, **options: Any) -> TrainingOptions:
    """Options of a training of one thread and few robots."""
    defaults = {"robots": 8, "progress": False, "threads": 1, "seed": 3, "out": out}
    return TrainingOptions(**defaults | options)
