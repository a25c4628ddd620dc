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
Point = tuple[float, float]


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
    """Records the paths of a batch's first robots and draws them on request."""

    def __init__(self, fleet: Sequence[RobotConfig], robots: int, tolerance: float) -> None:
        self._fleet = fleet
        self._robots = robots
        self._tolerance = tolerance

        # All pictures together fit into a video, whose sides have to be even.
        columns = math.isqrt(robots - 1) + 1
        side = min(TILE_SIDE, max(SMALLEST_SIDE, LARGEST_SIDE // columns // 2 * 2))
        self._size = (side, side)
        self._views: list[Any] = []
        self._odom_paths: list[list[Point]] = [[] for _ in range(min(robots, MAX_PICTURES))]
        self._true_paths: list[list[Point]] = [[] for _ in self._odom_paths]

    def __reduce__(self) -> tuple[Any, ...]:
        """Copy the settings only: a copy has no recorded paths."""
        return BatchScreen, (self._fleet, self._robots, self._tolerance)

    def show(self, batch: Batch) -> None:
        """Record where the robots are now."""
        for robot in range(len(self._odom_paths)):
            odom_path = self._odom_paths[robot]
            true_path = self._true_paths[robot]
            if batch.tables.blocks[0]["steps"][robot] == 0.0:
                odom_path.clear()
                true_path.clear()
            odom_path.append(_pose_in_world(batch, robot, "odom_x", "odom_y")[:2])
            true_path.append(_pose_in_world(batch, robot, "true_x", "true_y")[:2])

    def pictures(self, batch: Batch) -> tuple[Image, ...]:
        """Draw the newest states, a picture (height, width, 3) for each robot of the batch."""
        from acsar_gym.render.top_view import TopView  # noqa: PLC0415 - needs Pillow

        drawn = range(len(self._odom_paths))
        if not self._views:
            kinds = [self._fleet[robot % len(self._fleet)] for robot in drawn]
            self._views = [TopView(config, self._size) for config in kinds]
        empty = np.full((*self._size, 3), EMPTY_COLOUR, np.uint8)
        pictures = [self._draw(batch, robot) for robot in drawn]
        return (*pictures, *[empty] * (self._robots - len(drawn)))

    def _draw(self, batch: Batch, robot: int) -> Image:
        """Draw one robot."""
        from acsar_gym.render.top_view import TopViewFrame  # noqa: PLC0415 - needs Pillow

        config = self._fleet[robot % len(self._fleet)]
        world = int(batch.tables.blocks[0]["world"][robot])
        steps = batch.tables.blocks[0]["steps"][robot]
        ranges = batch.tables.ranges[robot]
        angles = ray_spec(config).angles()
        frame = TopViewFrame(
            world=batch.worlds[world] if batch.worlds else None,
            odom=_pose_in_world(batch, robot, "odom_x", "odom_y", "odom_theta"),
            truth=_pose_in_world(batch, robot, "true_x", "true_y", "theta"),
            goal=_pose_in_world(batch, robot, "goal_x", "goal_y")[:2],
            goal_radius=self._tolerance,
            odom_path=self._odom_paths[robot],
            true_path=self._true_paths[robot],
            rays=(angles, ranges[: len(angles)]) if len(ranges) else None,
            reach=config.lidar.max_range,
            movers=batch.copy_movers(robot, world),
            caption=f"{robot}: step {steps:.0f}",
        )
        image: Image = np.array(self._views[robot].draw(frame), np.uint8)
        image[-1, :] = image[:, -1] = EMPTY_COLOUR  # between tiles
        return image


def _pose_in_world(batch: Batch, robot: int, *names: str) -> Pose:
    """A pose in the frame of a robot's world, from the fields of its place, and of its heading."""
    robots = batch.tables.blocks[0]
    fields = ("start_x", "start_y", "start_theta", *names)
    x, y, theta, *pose = [float(robots[name][robot]) for name in fields]
    return to_world((x, y, theta), (pose[0], pose[1], pose[2] if len(pose) > 2 else 0.0))
