"""Draws a robot among people, from above, with its rays: a film for the README, a picture for docs.

`make pictures` draws them; --help of this script lists policy, world and speed.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from numpy.typing import NDArray
from PIL import Image

from acsar_gym.lidar.scan import ray_spec
from acsar_gym.render.top_view import TopView, TopViewFrame
from acsar_gym.sensors.lidar import newest_scan
from acsar_gym.tools.evaluation import episodes, runs
from acsar_gym.worlds.world import point_in_world

Picture = NDArray[np.uint8]
HERE = Path(__file__).parent
LAST = 1500
"""How long the last picture of the film stays [ms]."""


@dataclass(frozen=True)
class Options:
    """What is driven, and how it is shown."""

    film: Path = HERE / "crowd.gif"
    """File of the film."""
    picture: Path = HERE.parents[1] / "docs" / "pictures" / "crowd.png"
    """File of the picture."""
    policy: str = "dwa_movers"
    env: str = "crowd"
    worlds: str = "crowd_reacting:test"
    world: int = 32
    """Number of the world, and seed of the episode."""
    every: int = 4
    """The film shows every so many env steps (0.1 s each)."""
    delay: int = 130
    """Time between pictures of the film [ms]; GIF knows whole hundredths of a second."""
    size: tuple[int, int] = (600, 350)
    """Width and height of the film [pixels]; the picture is twice as large."""
    moment: float = 0.45
    """When the picture is, as a share of the episode."""
    colours: int = 64
    """Colours of the film, at most 256."""


def main(options: Options) -> None:
    """Drive an episode, and draw it."""
    policy = runs.load_policy(options.policy, trust=False, env=options.env)
    env = runs.make_env(policy, "planar", None, {"worlds": options.worlds})
    config = env.unwrapped.robot.config  # type: ignore[attr-defined]
    frames = drive(env, policy, options.world)
    view = TopView(config, options.size)
    write_film([view.draw(frame) for frame in frames[:: options.every]], options)
    width, height = options.size
    moment = frames[int(options.moment * len(frames))]
    picture = TopView(config, (2 * width, 2 * height)).draw(moment)
    Image.fromarray(picture).quantize(64).save(options.picture, optimize=True)


def drive(env: Any, policy: Any, world: int) -> list[TopViewFrame]:
    """Drive an episode; returns what there is to see at every decision."""
    frames: list[TopViewFrame] = []
    inner = env.unwrapped

    def noting(observation: Any) -> Any:
        frames.append(look(inner, frames))
        return policy(observation)

    policy.reset()
    with contextlib.closing(env):
        (result,) = episodes.run_episodes(env, noting, 1, world, world=world)
        frames.append(look(inner, frames))
    if not result.success:
        raise SystemExit(f"the goal wasn't reached: {result}")
    return frames


def look(env: Any, before: list[TopViewFrame]) -> TopViewFrame:
    """Return what there is to see now, with the path up to here."""
    scan: Any = newest_scan(env.sensors)
    truth, given = env.robot.link.truth, env.episode.assignment
    seconds = env.episode.steps * env.ticks_per_step * env.robot.config.period
    return TopViewFrame(
        world=given.world,
        odom=truth.pose,
        goal=point_in_world(given.start, given.goal),
        goal_radius=env.task.goal_tolerance,
        odom_path=[*(frame.odom[:2] for frame in before), truth.pose[:2]],
        rays=(ray_spec(env.robot.config).angles(), scan.ranges.copy()),
        reach=env.robot.config.lidar.max_range,
        movers=truth.crowd.copy_states(),
        caption=f"{seconds:.1f} s",
    )


def write_film(pictures: list[Picture], options: Options) -> None:
    """Write a GIF with the colours of some of the pictures, without dithering."""
    some = np.concatenate(pictures[:: 1 + len(pictures) // 8])
    colours = Image.fromarray(some).quantize(options.colours, Image.Quantize.MEDIANCUT)
    first, *rest = (
        Image.fromarray(picture).quantize(palette=colours, dither=Image.Dither.NONE)
        for picture in pictures
    )
    times = [options.delay] * len(rest) + [LAST]
    first.save(options.film, save_all=True, append_images=rest, duration=times, loop=0)


if __name__ == "__main__":
    main(tyro.cli(Options))
