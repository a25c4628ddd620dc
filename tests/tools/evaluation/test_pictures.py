"""Pictures and videos of episodes, drawn from their tracks."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

from acsar_gym.errors import ConfigError, MissingExtraError
from acsar_gym.render.top_view import HIT_COLOUR
from acsar_gym.tools.evaluation import pictures
from acsar_gym.tools.evaluation.episodes import EpisodeResult, TrackedEnv, run_episodes
from acsar_gym.tools.evaluation.metrics import describe_episodes
from acsar_gym.worlds import Region, World

pytest.importorskip("PIL")
AHEAD = World(
    circles=np.array([[0.6, 0.05, 0.2]]), start=Region(0.0, 0.0, 0.0, 0.0), goal=Region(4.0, 0.0)
)


def made(**options: Any) -> gymnasium.Env[Any, Any]:
    env = gymnasium.make("acsar_gym/ObstacleGoal-v1", link="planar", worlds=AHEAD, **options)
    return TrackedEnv(env)


@pytest.fixture(scope="module")
def crash() -> EpisodeResult:
    """An episode straight into the circle."""
    env = made()
    found = next(run_episodes(env, lambda _: np.array([1.0, 0.0], np.float32), 1, 3))
    env.close()
    return found


def test_a_track_has_a_row_for_the_reset_and_for_every_step(crash: EpisodeResult) -> None:
    track = pictures.require_track(crash)
    assert crash.collision
    assert track.truth is not None
    assert track.scans is not None
    assert len(track.odometry) == len(track.truth) == len(track.scans) == crash.length + 1
    assert track.truth[0] == pytest.approx((0.0, 0.0, 0.0))
    assert track.odometry[-1] == pytest.approx(crash.pose, abs=1e-6)
    assert track.goal == pytest.approx((4.0, 0.0))


def test_episodes_are_only_tracked_where_asked_and_json_leaves_tracks_out(
    crash: EpisodeResult,
) -> None:
    env = made().unwrapped
    plain = next(run_episodes(env, lambda _: np.array([1.0, 0.0], np.float32), 1, 3))
    env.close()
    # As mappings: since Python 3.13 results with a NaN aren't equal to themselves.
    assert dataclasses.asdict(plain) == dataclasses.asdict(dataclasses.replace(crash, track=None))
    assert "track" not in describe_episodes([crash])[0]
    with pytest.raises(ValueError, match="track"):
        pictures.draw_episode(plain)


def test_the_point_of_a_collision_lies_on_the_obstacle_and_is_marked(crash: EpisodeResult) -> None:
    point = pictures.collision_point(pictures.require_track(crash))
    assert point is not None
    assert np.hypot(point[0] - 0.6, point[1] - 0.05) == pytest.approx(0.2, abs=0.06)
    red = (pictures.draw_episode(crash) == np.array(HIT_COLOUR)).all(axis=2).sum()
    won = dataclasses.replace(crash, collision=False)
    assert red > (pictures.draw_episode(won) == np.array(HIT_COLOUR)).all(axis=2).sum() == 0


def test_the_worst_are_failures_with_the_least_progress_then_the_longest_ways() -> None:
    ends = [(True, 0.0, 1.0), (True, 0.0, 2.0), (False, 0.1, 1.0), (False, 0.9, 1.0)]
    some = [
        EpisodeResult(won, False, 0, 1, 1, (0, 0, 0), 0, 1, 0, 1.0, left, driven, seed=seed)
        for seed, (won, left, driven) in enumerate(ends)
    ]
    assert [each.seed for each in pictures.worst_episodes(some, 3)] == [3, 2, 1]
    assert [each.seed for each in pictures.worst_episodes(some, None)] == [3, 2, 1, 0]


def test_a_folder_gets_a_video_and_a_picture_of_each_episode(
    crash: EpisodeResult, tmp_path: Path
) -> None:
    pytest.importorskip("moviepy")
    whole = pictures.require_track(crash)
    assert whole.truth is not None
    ends: dict[str, Any] = {
        "odometry": whole.odometry[-2:],
        "truth": whole.truth[-2:],
        "scans": None,
    }
    short = dataclasses.replace(whole, period=0.5, **ends)
    result = dataclasses.replace(crash, track=short)
    files = pictures.write_videos([result], tmp_path)
    assert [file.name for file in files] == ["01_seed_3.mp4", "01_seed_3.png"]
    assert b"ftyp" in files[0].read_bytes()[:12]
    together = pictures.write_videos([result, result], tmp_path / "all.mp4")
    assert [file.name for file in together[1:]] == ["all_01_seed_3.png", "all_02_seed_3.png"]


def test_a_video_needs_an_extra(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "moviepy.video.io.ffmpeg_writer", None)
    with pytest.raises(MissingExtraError, match="video"):
        pictures.check_video_output(tmp_path / "videos")
    assert not (tmp_path / "videos").exists()


def test_where_a_video_cannot_be_written_nothing_is_driven(tmp_path: Path) -> None:
    pytest.importorskip("moviepy")
    with pytest.raises(ConfigError, match="nowhere"):
        pictures.check_video_output(tmp_path / "nowhere" / "all.mp4")
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="file"):
        pictures.check_video_output(tmp_path / "file")
