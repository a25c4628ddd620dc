"""Tracks: true poses from an emulator's log."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rollout_tools import driven, random_steps, recording

from acsar_gym import RobotConfig
from acsar_gym.errors import ConfigError
from acsar_gym.recording.types import Episode, Recording
from acsar_gym.tools.sysid.tracks import add_truth, make_recorded_track

ACSAR = RobotConfig.preset("acsar")


@pytest.fixture(scope="module")
def known() -> Episode:
    return driven(ACSAR, random_steps(0, 2.0, ACSAR))


def blind(known: Episode) -> Recording:
    return recording(ACSAR, replace(known, truth=np.full_like(known.truth, np.nan)))


def emulators_log(path: Path, known: Episode, shift: float = 0.0) -> Path:
    """The log of an emulator whose robot had already moved, and that still writes."""
    start = known.stamps[0] - ACSAR.period
    events = [{"t": start + shift, "pose": [1.0, 2.0, 0.0]}]
    for stamp, (x, y, theta) in zip(known.stamps.tolist(), known.truth.tolist(), strict=True):
        events += [{"t": stamp + shift, "pose": [x + 1.0, y + 2.0, theta]}, {"t": stamp, "rx": ""}]
    path.write_text("".join(f"{json.dumps(event)}\n" for event in events) + '{"t": 9', "ascii")
    return path


def test_the_logs_poses_become_the_truth(known: Episode, tmp_path: Path) -> None:
    found = add_truth(blind(known), emulators_log(tmp_path / "log.jsonl", known))
    track = make_recorded_track(found.episodes[0], ACSAR)
    assert track.known
    assert track.truth == pytest.approx(make_recorded_track(known, ACSAR).truth, abs=1e-3)


def test_a_log_of_another_time_or_kind_is_refused(known: Episode, tmp_path: Path) -> None:
    other = emulators_log(tmp_path / "log.jsonl", known, shift=0.5)
    with pytest.raises(ConfigError, match=r"log\.jsonl: is of another time"):
        add_truth(blind(known), other)
    for text in ("no json\n", '{"pose": 3, "t": 1}\n', "[]\n"):
        other.write_text(text, encoding="ascii")
        with pytest.raises(ConfigError, match=r"isn't a log of|holds no true poses"):
            add_truth(blind(known), other)
