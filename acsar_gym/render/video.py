"""Writes videos with moviepy's bundled ffmpeg, picture by picture."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Iterable, Iterator
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
        ConfigError: the file can't be written, as on a full disk; what was there before stays.
        MissingExtraError: moviepy isn't installed.
    """
    writer_of, pictures = library(), iter(images)
    first = next(pictures)
    try:
        with bounded.replacing(path) as new:
            _encode(writer_of, new, first, pictures, rate)
    except OSError as error:
        raise _failed(path, error.strerror or str(error)) from None


def _encode(
    writer_of: Any, path: Path, first: Image, pictures: Iterator[Image], rate: float
) -> None:
    """Encode pictures; OSError where ffmpeg can't."""
    height, width = first.shape[:2]
    options = {"preset": "veryfast", "ffmpeg_params": ["-movflags", "+faststart"], "threads": 1}
    writer = writer_of(str(path), (width, height), rate, **options)
    process = writer.proc
    with contextlib.closing(writer):
        writer.write_frame(first)
        for image in pictures:
            writer.write_frame(np.ascontiguousarray(image))
    if process.returncode:
        raise OSError(0, "ffmpeg couldn't finish it")


def _failed(path: Path, why: str) -> ConfigError:
    """Return the error of a video, with the reason in one line."""
    said = " ".join(why.split())
    full = "No space left on device" if "No space left" in said else said[-160:]
    return ConfigError(f"{path}: can't be written: {full}")
