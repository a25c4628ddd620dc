"""The whole demo on a tiny budget, its emulator in another process on a real tty."""

from __future__ import annotations

from pathlib import Path

import pytest

from acsar_gym import demo, report
from acsar_gym.errors import AcsarError, LinkError
from acsar_gym.resources import AGENTS


def test_the_demo_fills_both_rows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Everything but the training is real; the policy that comes along takes its place."""
    policy = AGENTS / "policies" / "point_goal.onnx"
    monkeypatch.setattr(demo, "train", lambda *_: policy)
    done = demo.run(steps=0, episodes=3, serial_episodes=1, out=tmp_path)
    assert done[0][1].header["link"] == "bullet"
    rows = [(name, run.summary) for name, run in done]
    for _, summary in rows:
        assert summary.success_rate == 1.0
        assert 0.0 <= summary.odometry_error < 0.1
        assert summary.ticks > 0
    assert [summary.episodes for _, summary in rows] == [3, 1]
    assert report.summary_table("demo", rows).row_count == 2


def test_training_that_fails_is_reported(tmp_path: Path) -> None:
    with pytest.raises(AcsarError, match="training failed"):
        demo.train(-1, tmp_path)


def test_an_emulator_that_does_not_start_is_reported() -> None:
    with pytest.raises(LinkError, match="didn't start"), demo.emulator("--body", "balloon"):
        pass
