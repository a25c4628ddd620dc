"""Pictures and videos of episodes, drawn from their tracks after they were driven."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np

from acsar_gym import reading
from acsar_gym.lidar.scan import ray_spec
from acsar_gym.render import renderer
from acsar_gym.render.canvas import encode_png
from acsar_gym.render.top_view import RgbImage, TopView, TopViewFrame
from acsar_gym.tools.evaluation import report
from acsar_gym.tools.evaluation.episodes import DrawnTrack, EpisodeResult
from acsar_gym.worlds import Pose
from acsar_gym.worlds.geometry import point_clearance

PICTURE_SIZE = (480, 480)
"""Width and height [pixels]; even, as videos ask."""
END_SECONDS = 1.0
"""How long a video shows the end of an episode [s]."""
TOUCH_DISTANCE = 0.05
"""A footprint that is this near to an obstacle in a collision touches it there [m]."""


def worst_episodes(results: Sequence[EpisodeResult], count: int | None) -> list[EpisodeResult]:
    """Return the worst episodes, the worst first.

    Failed ones come before successful ones; among both, those with less SoftSPL, and in path
    following those with a larger cross-track error, come first.

    Args:
        results: all episodes.
        count: most episodes to return; None for all.
    """

    def merit(result: EpisodeResult) -> tuple[bool, float]:
        progress = result.soft_spl
        error = 0.0 if math.isnan(result.cross_track) else result.cross_track
        return result.success, -error if math.isnan(progress) else progress

    return sorted(results, key=merit)[:count]


def draw_episode(result: EpisodeResult, view: TopView | None = None) -> RgbImage:
    """Draw an episode as one picture: world, paths, the last scan, and where it collided.

    Args:
        result: with its track.
        view: to draw with; None for a new one.

    Raises:
        MissingExtraError: Pillow isn't installed.
    """
    track = require_track(result)
    world = "" if result.world is None or result.world < 0 else f", world {result.world}"
    outcome = "collision" if result.collision else "time-out"
    if result.fault or result.success:
        outcome = "fault" if result.fault else "goal reached"
    caption = f"seed {result.seed}{world}: {outcome} after {result.time:.1f} s"
    touched = collision_point(track) if result.collision else None
    frame = _make_frame(track, len(track.odometry) - 1, caption, touched)
    return (view or TopView(track.robot, PICTURE_SIZE)).draw(frame)


def draw_frames(result: EpisodeResult) -> Iterator[RgbImage]:
    """Yield the pictures of an episode, one for each env step, the last one for a second.

    Raises:
        MissingExtraError: Pillow isn't installed.
    """
    track = require_track(result)
    view = TopView(track.robot, PICTURE_SIZE)
    for step in range(len(track.odometry) - 1):
        caption = f"seed {result.seed}, {step * track.period:.1f} s"
        yield view.draw(_make_frame(track, step, caption))
    last = draw_episode(result, view)
    for _ in range(max(1, round(END_SECONDS / track.period))):
        yield last


def require_track(result: EpisodeResult) -> DrawnTrack:
    """Return the track of an episode; ValueError for one that was driven without."""
    if result.track is None:
        raise ValueError("the episode was driven without a track")
    return result.track


def _make_frame(
    track: DrawnTrack, step: int, caption: str, hit: tuple[float, float] | None = None
) -> TopViewFrame:
    """Make the picture of a step."""
    odometry = track.odometry[: step + 1].tolist()
    truth = [] if track.truth is None else track.truth[: step + 1].tolist()
    rays = None
    if track.scans is not None:
        rays = ray_spec(track.robot).angles(), track.scans[step].astype(float)
    return TopViewFrame(
        world=track.world,
        odom=tuple(odometry[-1]),
        truth=tuple(truth[-1]) if truth else None,
        goal=track.goal,
        goal_radius=track.goal_radius,
        odom_path=[(x, y) for x, y, _ in odometry],
        true_path=[(x, y) for x, y, _ in truth],
        rays=rays,
        reach=track.robot.lidar.max_range,
        caption=caption,
        hit=hit,
    )


def collision_point(track: DrawnTrack) -> tuple[float, float] | None:
    """Return the point of the footprint's border that is nearest to an obstacle at the end [m].

    None where no obstacle is near, and without ground truth.
    """
    if track.truth is None or track.world is None or not track.world.obstacles:
        return None
    corners, share = np.array(track.robot.outline), np.linspace(0.0, 1.0, 41)[:-1, None]
    sides = zip(corners, np.roll(corners, -1, axis=0), strict=True)
    border = np.concatenate([a + share * (b - a) for a, b in sides])
    pose: Pose = tuple(track.truth[-1].tolist())
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    placed = border @ np.array([[cos, sin], [-sin, cos]]) + pose[:2]
    apart = point_clearance(placed, track.world)
    nearest = int(apart.argmin())
    return tuple(placed[nearest].tolist()) if apart[nearest] < TOUCH_DISTANCE else None


def check_video_output(where: Path) -> None:
    """Check before a long run that pictures and videos can be written; makes a folder.

    Args:
        where: as for `write_videos`.

    Raises:
        ConfigError: there is no such folder, and it can't be made.
        MissingExtraError: moviepy isn't installed, which brings Pillow.
    """
    renderer.import_moviepy()
    if _is_video(where):
        report.check_writable(where)
    else:
        report.make_folder(where)


def write_videos(results: Iterable[EpisodeResult], where: Path) -> list[Path]:
    """Write episodes as a video and a picture each.

    Args:
        results: with their tracks; episodes of more than one are numbered in this order.
        where: a folder, or one video file for all, beside which the pictures are written.

    Returns:
        The files.

    Raises:
        ConfigError: a file can't be written, as on a full disk.
        MissingExtraError: moviepy or Pillow isn't installed.
    """
    every, one = list(results), _is_video(where)
    if not every:
        return []
    rate, written = 1.0 / require_track(every[0]).period, []
    if one:
        images = (image for result in every for image in draw_frames(result))
        renderer.write_video(where, images, rate)
        written.append(where)
    for number, result in enumerate(every, start=1):
        name = f"{number:02d}_seed_{result.seed}"
        base = where.with_name(f"{where.stem}_{name}") if one else where / name
        if not one:
            renderer.write_video(base.with_suffix(".mp4"), draw_frames(result), rate)
            written.append(base.with_suffix(".mp4"))
        reading.write_atomically(base.with_suffix(".png"), encode_png(draw_episode(result)))
        written.append(base.with_suffix(".png"))
    return written


def _is_video(where: Path) -> bool:
    """Whether this is the name of a video file, rather than of a folder."""
    return where.suffix.lower() in renderer.VIDEO_SUFFIXES
