"""Draws three_views.gif of the README: one policy file in one world, behind two links.

From the left: PyBullet's camera, the same episode from above, and the emulated board on a serial
device, of which odometry and LiDAR are all that is known. World, start, goal and seed are fixed;
the emulated board runs in real time, so its path differs by some millimetres from run to run.

`make pictures` draws it; --help of this script lists policy, world and speed.
"""

from __future__ import annotations

import contextlib
import math
import tempfile
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from acsar_gym.config import RobotConfig
from acsar_gym.lidar.scan import ray_spec
from acsar_gym.render.canvas import INK_COLOUR
from acsar_gym.render.top_view import (
    CHASSIS_COLOUR,
    FLOOR_COLOUR,
    GOAL_COLOUR,
    GRID_COLOUR,
    OBSTACLE_COLOUR,
    ODOM_COLOUR,
    PLAN_COLOUR,
    RAY_COLOUR,
    SEEN_COLOURS,
    TopView,
    TopViewFrame,
)
from acsar_gym.sensors.lidar import newest_scan
from acsar_gym.tools.emulation.board import run_emulator
from acsar_gym.tools.evaluation import episodes, runs
from acsar_gym.tools.policies import FilePolicy
from acsar_gym.worlds import Region, World, files
from acsar_gym.worlds.world import point_in_world, to_world

Picture = NDArray[np.uint8]
Floats = NDArray[np.float64]
TITLES = ("PyBullet", "PyBullet, from above", "serial port: what the robot knows")
SIDE, GAP, BAND = 232, 8, 24
"""Sides of a view, space between them, and height of the titles [pixels]."""
PAPER, HALF = (255, 255, 255), (160, 163, 170)
PALE = (241, 242, 243), (194, 230, 209), (150, 185, 240), (240, 198, 203)
DRAWN = np.array(
    [
        PAPER,
        FLOOR_COLOUR,
        GRID_COLOUR,
        *SEEN_COLOURS,
        INK_COLOUR,
        HALF,
        OBSTACLE_COLOUR,
        PLAN_COLOUR,
        GOAL_COLOUR,
        ODOM_COLOUR,
        RAY_COLOUR,
        *PALE,
        CHASSIS_COLOUR,
    ]
)
"""Colours of the views from above and of titles."""
MARKER = (22, 110, 62)
"""Colour of the goal in front of the camera."""
RAYS = 2
"""Every so many rays of the LiDAR are drawn."""
CELL, NEAR, CALM = 0.05, 3.0, 0.04
"""The map's resolution [m]; an echo is in it if it was nearer than this [m], and the robot turned
by less than this in the env step [rad]: a LiDAR's turn takes as long as the step."""
OUT = Path(__file__).with_name("three_views.gif")
LAST = 1500
"""How long the last picture stays [ms]."""


@dataclass(frozen=True)
class Options:
    """What is driven, and how fast it is shown."""

    out: Path = OUT
    """File to write."""
    policy: str = "obstacle_goal"
    world: int = 10
    """Number of the world in the test split, and seed of the episode."""
    every: int = 2
    """Show every so many env steps (0.1 s each)."""
    delay: int = 80
    """Time between pictures [ms]; GIF knows whole hundredths of a second."""
    colours: int = 12
    """Colours of the camera's pictures, at most 200."""


def main(options: Options) -> None:
    """Drive behind both links, and write the film."""
    policy = runs.load_policy(options.policy, trust=False)
    camera, simulated = in_pybullet(policy, options)
    wired = over_a_port(policy, simulated)
    write(film(camera, simulated, wired, options.every), options)


@dataclass(frozen=True, eq=False)
class DrawnTrack:
    """Poses and scans of an episode at every decision, in the frame of its world."""

    odometry: Floats
    """(N, 3): x, y [m], theta [rad]."""
    truth: Floats | None
    """(N, 3); None on hardware."""
    scans: Floats
    """(N, rays): ranges of the LiDAR [m]."""
    goal: tuple[float, float]
    goal_radius: float
    period: float
    """Between two decisions [s]."""
    robot: RobotConfig
    world: World


def drive(env: Any, policy: FilePolicy, seed: int, world: Any, see: Any = None) -> DrawnTrack:
    """Drive an episode, and close the env; `see` is called at every decision."""
    inner = env.unwrapped
    poses: list[Any] = []
    truths: list[Any] = []
    scans: list[Any] = []

    def noting(observation: Any) -> Any:
        scan, truth = newest_scan(inner.sensors), inner.robot.link.truth
        start = inner.episode.assignment.start
        poses.append(to_world(start, inner.robot.odometry.pose))
        truths.append(truth.pose if truth else (math.nan,) * 3)
        scans.append(None if scan is None else scan.ranges.copy())
        if see is not None:
            see()
        return policy(observation)

    with contextlib.closing(env):
        (result,) = episodes.run_episodes(env, noting, 1, seed, world=world)
        given, tolerance = inner.episode.assignment, inner.task.goal_tolerance
        config, period = inner.robot.config, inner.ticks_per_step * inner.robot.config.period
    if not result.success:
        raise SystemExit(f"the goal wasn't reached: {result}")
    (x, y, theta), goal = given.start, point_in_world(given.start, given.goal)
    place = replace(given.world, start=Region(x, y, 0.0, theta), goal=Region(*goal))
    truth = None if math.isnan(truths[0][0]) else np.array(truths)
    seen = np.array(scans, np.float64)
    return DrawnTrack(np.array(poses), truth, seen, goal, tolerance, period, config, place)


def in_pybullet(policy: FilePolicy, options: Options) -> tuple[list[Picture], DrawnTrack]:
    """Drive in PyBullet; returns what the camera saw, and the track in its world."""
    env = runs.make_env(policy, "bullet", None, {})
    inner: Any = env.unwrapped
    pictures: list[Picture] = []

    def film() -> None:
        camera = inner.robot.link.camera
        if camera is not None and inner.episode.steps % options.every == 0:
            large = Image.fromarray(camera.image(2 * SIDE, 2 * SIDE))
            pictures.append(np.asarray(large.reduce(2)))

    return pictures, drive(env, policy, options.world, options.world, film)


def over_a_port(policy: FilePolicy, simulated: DrawnTrack) -> DrawnTrack:
    """Drive from the same place in the same world, over a pseudo-terminal."""
    with tempfile.TemporaryDirectory() as folder:
        files.save_world(simulated.world, path := Path(folder) / "world.json")
        with run_emulator("--body", "bullet", "--world", str(path), "--lidar") as devices:
            options = {"lidar": f"rplidar://{devices.lidar}"}
            env = runs.make_env(policy, devices.robot, None, options)
            return drive(env, policy, 0, simulated.world)


def film(
    camera: list[Picture], simulated: DrawnTrack, wired: DrawnTrack, every: int
) -> Iterator[tuple[Picture, ...]]:
    """Yield the three views at a time; one that has ended shows its last picture."""
    views = (camera, from_above(simulated, every), from_above(wired, every, known=False))
    last: tuple[Any, ...] = (None,) * len(views)
    for row in zip_longest(*views):
        last = tuple(old if new is None else new for old, new in zip(last, row, strict=True))
        yield last


def from_above(track: DrawnTrack, every: int, *, known: bool = True) -> Iterator[Picture]:
    """Yield pictures of a track; the world is its own, or not known but for the LiDAR's echoes."""
    view, angles = TopView(track.robot, (SIDE, SIDE)), ray_spec(track.robot).angles()
    seen, poses, scans = np.zeros((0, 2)), track.odometry, track.scans
    for step in range(len(poses) - 1):
        if step == 0 or abs(poses[step, 2] - poses[step - 1, 2]) < CALM:
            seen = mapped(seen, poses[step], angles, scans[step])
        if step % every == 0:
            frame = TopViewFrame(
                world=track.world if known else map_of(seen, track),
                odom=tuple(poses[step].tolist()),
                truth=None if track.truth is None else tuple(track.truth[step].tolist()),
                goal=track.goal,
                goal_radius=track.goal_radius,
                odom_path=poses[: step + 1, :2].tolist(),
                rays=(angles[::RAYS], scans[step, ::RAYS]),
                reach=track.robot.lidar.max_range,
                caption=f"{step * track.period:.1f} s",
            )
            yield view.draw(frame)


def mapped(seen: Floats, pose: Floats, angles: Floats, ranges: Floats) -> Floats:
    """Add a scan's near echoes to the points seen so far (N, 2), in the cells of a grid [m]."""
    near = ranges < NEAR
    bearing = pose[2] + angles[near]
    echoes = pose[:2] + ranges[near, None] * np.column_stack([np.cos(bearing), np.sin(bearing)])
    return np.unique(np.round(np.concatenate([seen, echoes]) / CELL), axis=0) * CELL


def map_of(seen: Floats, track: DrawnTrack) -> World:
    """A world of the points seen, shown as large as the track's own one."""
    left, low, right, high = track.world.bounds
    middle = Region((left + right) / 2.0, (low + high) / 2.0, max(right - left, high - low) / 2.0)
    circles = np.column_stack([seen, np.full(len(seen), CELL / 2.0)])
    return World(circles=circles, start=middle, goal=Region(middle.x, middle.y))


def write(film: Iterable[tuple[Picture, ...]], options: Options) -> None:
    """Write a GIF: the camera's commonest colours, those of views from above, and no dithering."""
    rows = list(film)
    some = Image.fromarray(np.concatenate([camera for camera, *_ in rows[:: 1 + len(rows) // 8]]))
    seen = some.quantize(options.colours, Image.Quantize.MEDIANCUT).getpalette() or []
    colours = np.array([*seen[: 3 * options.colours], *MARKER]).reshape(-1, 3)
    first, *rest = (beside(row, colours) for row in rows)
    times = [options.delay] * len(rest) + [LAST]
    first.save(options.out, save_all=True, append_images=rest, duration=times, loop=0)


def beside(views: Iterable[Picture], colours: NDArray[np.int64]) -> Image.Image:
    """Views side by side with their titles above; `colours` (N, 3) are those of the first one."""
    parts: list[Picture] = []
    for view, title in zip(views, TITLES, strict=True):
        drawn = matched(headed(title), DRAWN) + len(colours)
        seen = matched(view, DRAWN) + len(colours) if parts else matched(view, colours)
        gap = np.full((BAND + SIDE, GAP), len(colours), np.uint8)
        parts += [np.concatenate([drawn, seen]), gap]
    picture = Image.fromarray(np.hstack(parts[:-1]))
    picture.putpalette([*colours.ravel().tolist(), *DRAWN.ravel().tolist()])
    return picture


def matched(picture: Picture, palette: NDArray[np.int64]) -> Picture:
    """Which colour of a palette (N, 3) is nearest to each pixel (height, width)."""
    packed = picture.reshape(-1, 3) @ np.array([1 << 16, 1 << 8, 1])
    found, where = np.unique(packed, return_inverse=True)
    colours = np.column_stack([found >> 16, found >> 8 & 255, found & 255])
    nearest = ((colours[:, None] - palette) ** 2).sum(axis=2).argmin(axis=1)
    indices: Picture = nearest[where].reshape(picture.shape[:2]).astype(np.uint8)
    return indices


def headed(title: str) -> Picture:
    """A title, as wide as a view."""
    picture = Image.new("RGB", (SIDE, BAND), PAPER)
    font = ImageFont.load_default(13.0)
    ImageDraw.Draw(picture).text((SIDE / 2, BAND / 2), title, INK_COLOUR, font, anchor="mm")
    return np.asarray(picture)


if __name__ == "__main__":
    main(tyro.cli(Options))
