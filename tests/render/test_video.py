"""Videos, picture by picture."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from acsar_gym.errors import ConfigError
from acsar_gym.render import renderer

pytest.importorskip("moviepy")
IMAGES = [np.full((64, 96, 3), shade, np.uint8) for shade in (0, 80, 160, 240)]


def test_a_video_has_every_picture(tmp_path: Path) -> None:
    from moviepy import VideoFileClip

    path = tmp_path / "some.mp4"
    renderer.write_video(path, iter(IMAGES), 10.0)
    with VideoFileClip(str(path)) as clip:
        assert tuple(clip.size) == (96, 64)
        shades = [int(frame.mean()) for frame in clip.iter_frames()]
        for pipe in (clip.reader.proc.stdout, clip.reader.proc.stderr):
            pipe.close()  # moviepy leaves them open where ffmpeg has ended by itself
    assert shades == pytest.approx([0, 80, 160, 240], abs=4)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_disk_is_one_line(tmp_path: Path) -> None:
    path = tmp_path / "some.mp4"
    path.symlink_to("/dev/full")
    noise = np.random.default_rng(0).integers(0, 256, (40, 64, 96, 3), np.uint8)
    with pytest.raises(ConfigError, match=r"some\.mp4: can't be written: .+") as caught:
        renderer.write_video(path, iter(noise), 10.0)
    assert "\n" not in str(caught.value)


def test_a_folder_that_is_gone_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"some\.mp4: can't be written: No such file"):
        renderer.write_video(tmp_path / "gone" / "some.mp4", iter(IMAGES), 10.0)
