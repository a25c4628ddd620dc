"""Pictures of a batch: its first robots from above, each in its own world."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError, check_extra, show_value
from acsar_gym.lidar.scan import ray_spec
from acsar_gym.vector.batch import Batch
from acsar_gym.worlds import Pose
from acsar_gym.worlds.world import to_world

MAX_PICTURES = 16
"""Most robots that are drawn, all of the first block. The pictures of other robots are empty."""
TILE_SIDE = 240
"""Width and height of a robot's picture [pixels]."""
LARGEST_SIDE = 1920
"""Of all pictures as a square, which Gymnasium's recorder makes of them [pixels]."""
SMALLEST_SIDE = 64
EMPTY_COLOUR = (231, 233, 236)
Image = NDArray[np.uint8]  # (height, width, 3), RGB


def check_render_mode(mode: Any) -> str | None:
    """Return a batch's render mode."""
    if mode not in (None, "rgb_array"):
        raise ConfigError(
            f"render_mode = {show_value(mode)}: a batch draws pictures for 'rgb_array'; a window "
            "is a single env's"
        )
    if mode is not None:
        check_extra("pictures", "pictures", "PIL")
    return mode  # type: ignore[no-any-return]


class BatchScreen:
    """Draws the first robots of a batch.

    Args:
        fleet: Configurations. Robot i of the batch has number i % len(fleet).
        robots: Number of robots.
        tolerance: Radius of goals [m].
    """

    def __init__(self, fleet: Sequence[RobotConfig], robots: int, tolerance: float) -> None:
        from acsar_gym.render.top_view import TopView  # noqa: PLC0415 - needs Pillow

        self._arguments = (fleet, robots, tolerance)

        # All pictures together fit into a video, whose sides have to be even.
        columns = math.isqrt(robots - 1) + 1
        side = min(TILE_SIDE, max(SMALLEST_SIDE, LARGEST_SIDE // columns // 2 * 2))
        self._configs = [fleet[robot % len(fleet)] for robot in range(min(robots, MAX_PICTURES))]
        self._views = [TopView(config, (side, side)) for config in self._configs]
        empty = np.full((side, side, 3), EMPTY_COLOUR, np.uint8)
        self._rest = [empty] * (robots - len(self._views))
        self._tolerance = tolerance

    def __reduce__(self) -> tuple[Any, ...]:
        """Copies have views of their own, because pictures of Pillow can't be copied."""
        return BatchScreen, self._arguments

    def pictures(self, batch: Batch) -> tuple[Image, ...]:
        """Draw the newest states, a picture (height, width, 3) for each robot of the batch."""
        return (*(self._draw(batch, robot) for robot in range(len(self._views))), *self._rest)

    def _draw(self, batch: Batch, robot: int) -> Image:
        from acsar_gym.render.top_view import TopViewFrame  # noqa: PLC0415 - needs Pillow

        config = self._configs[robot]
        # The first block has more robots than are drawn.
        robots = batch.tables.blocks[0]
        world = int(robots["world"][robot])
        angles = ray_spec(config).angles()
        ranges = batch.tables.ranges[robot]
        frame = TopViewFrame(
            world=batch.worlds[world] if batch.worlds else None,
            odom=_pose_in_world(robots, robot, "odom_x", "odom_y", "odom_theta"),
            truth=_pose_in_world(robots, robot, "true_x", "true_y", "theta"),
            goal=_pose_in_world(robots, robot, "goal_x", "goal_y", "theta")[:2],
            goal_radius=self._tolerance,
            rays=(angles, ranges[: len(angles)]) if len(ranges) else None,
            reach=config.lidar.max_range,
            movers=batch.copy_movers(robot, world),
            caption=f"{robot}: step {robots['steps'][robot]:.0f}",
        )
        image: Image = np.array(self._views[robot].draw(frame), np.uint8)
        image[-1, :] = image[:, -1] = EMPTY_COLOUR  # between tiles
        return image


def _pose_in_world(robots: NDArray[Any], robot: int, *names: str) -> Pose:
    """A pose in the frame of a robot's world, from these fields in its odometry frame."""
    fields = ("start_x", "start_y", "start_theta", *names)
    x, y, theta, *pose = [float(robots[name][robot]) for name in fields]
    return to_world((x, y, theta), (pose[0], pose[1], pose[2]))
