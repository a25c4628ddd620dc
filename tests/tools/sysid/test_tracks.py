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
from acsar_gym.tools.sysid.tracks import add_truth, make_recorded_track

ACSAR = RobotConfig.preset("acsar")


def test_add_truth_takes_the_poses_of_an_emulators_log(tmp_path: Path) -> None:
    """Of an emulator whose robot had already moved, and that still writes."""
    episode = driven(ACSAR, random_steps(0, 2.0, ACSAR))
    blind = recording(ACSAR, replace(episode, truth=np.full_like(episode.truth, np.nan)))
    path = tmp_path / "log.jsonl"

    def write_log(shift: float) -> None:
        events = [{"t": episode.stamps[0] - ACSAR.period + shift, "pose": [1.0, 2.0, 0.0]}]
        for stamp, pose in zip(episode.stamps.tolist(), episode.truth.tolist(), strict=True):
            moved = [pose[0] + 1.0, pose[1] + 2.0, pose[2]]
            events += [{"t": stamp + shift, "pose": moved}, {"t": stamp, "rx": ""}]
        path.write_text("".join(f"{json.dumps(event)}\n" for event in events) + '{"t": 9', "ascii")

    write_log(0.0)
    track = make_recorded_track(add_truth(blind, path).episodes[0], ACSAR)
    assert track.known
    assert track.truth == pytest.approx(make_recorded_track(episode, ACSAR).truth, abs=1e-3)
    write_log(0.5)
    with pytest.raises(ConfigError, match=r"log\.jsonl: is of another time"):
        add_truth(blind, path)
    path.write_text("no json\n", encoding="ascii")
    with pytest.raises(ConfigError, match="isn't a log of"):
        add_truth(blind, path)
