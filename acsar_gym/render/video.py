"""Writes videos with moviepy's bundled ffmpeg, picture by picture."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from acsar_gym.errors import ConfigError, MissingExtraError
from acsar_gym.reading import bounded
from acsar_gym.render.top_view import Image

SUFFIXES = (".mp4",)
"""Kinds of video files."""


def library() -> Any:
    """Return moviepy's writer; MissingExtraError where it isn't installed."""
    try:
        with warnings.catch_warnings():  # of its dependencies' own old calls
            warnings.simplefilter("ignore")
            from moviepy.video.io.ffmpeg_writer import FFMPEG_VideoWriter  # noqa: PLC0415
    except ImportError:
        raise MissingExtraError("a video", "video") from None
    return FFMPEG_VideoWriter


def write(path: Path, images: Iterable[Image], rate: float) -> None:
    """Write pictures as an H.264 video that browsers play.

    Args:
        path: .mp4 file to write.
        images: at least one; all of the same even width and height.
        rate: pictures per second.

    Raises:
        ConfigError: the file can't be written, as on a full disk; nothing is left of it then.
        MissingExtraError: moviepy isn't installed.
    """
    writer_of, pictures = library(), iter(images)
    first = next(pictures)
    bounded.write(path, b"")  # ffmpeg's own message would be longer
    height, width = first.shape[:2]
    options = {"preset": "veryfast", "ffmpeg_params": ["-movflags", "+faststart"], "threads": 1}
    try:
        writer = writer_of(str(path), (width, height), rate, **options)
        process = writer.proc
        with contextlib.closing(writer):
            writer.write_frame(first)
            for image in pictures:
                writer.write_frame(np.ascontiguousarray(image))
    except OSError as error:
        path.unlink(missing_ok=True)
        raise _failed(path, str(error)) from None
    if process.returncode:
        path.unlink(missing_ok=True)
        raise _failed(path, "ffmpeg couldn't finish it")


def _failed(path: Path, why: str) -> ConfigError:
    """Return the error of a video, with the reason in one line."""
    said = " ".join(why.split())
    full = "No space left on device" if "No space left" in said else said[-160:]
    return ConfigError(f"{path}: can't be written: {full}")
