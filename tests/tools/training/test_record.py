"""What is recorded of the command that began a training."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from acsar_gym.tools.training import record


@pytest.mark.parametrize(
    ("given", "kept"),
    [
        ("--env barn --out {folder}/run --seed 3", "--env barn --seed 3"),
        ("--env barn --out={folder}/run --seed=3", "--env barn --seed=3"),
        ("--out runs/one", ""),
        ("--resume {folder}/cut --trust", "--resume cut --trust"),
        ("--robot={folder}/my.yaml --worlds clutter", "--robot=my.yaml --worlds clutter"),
    ],
)
def test_the_command_names_no_folder_of_this_machine(
    given: str, kept: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = given.format(folder=tmp_path).split()
    for program in ("bin/acsar-gym train", "acsar_gym/__main__.py train"):
        monkeypatch.setattr(sys, "argv", [*program.split(), *words])
        assert record.training_command() == ["acsar-gym", "train", *kept.split()]


def test_of_another_program_only_the_name_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """A worker of Ray is given its cluster's address and password."""
    flags = ["--node-ip-address=10.0.0.3", "--redis-password=secret"]
    monkeypatch.setattr(sys, "argv", ["/opt/ray/default_worker.py", *flags])
    assert record.training_command() == ["default_worker.py"]
    monkeypatch.setattr(sys, "argv", ["bin/acsar-gym", "demo", "--steps", "9"])
    assert record.training_command() == ["acsar-gym", "demo", "--steps", "9"]
