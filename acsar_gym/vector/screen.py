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
from acsar_gym.worlds.world import to_world

MAX_PICTURES = 16
"""Most robots that are drawn. The pictures of the others are empty."""
TILE_SIDE = 240
"""Width and height of a robot's picture [pixels]."""
LARGEST_SIDE = 1920
"""Of all pictures as a square, which Gymnasium's recorder makes of them [pixels]."""
SMALLEST_SIDE = 64
EMPTY_COLOUR = (231, 233, 236)
FIELDS = (
    *("steps", "start_x", "start_y", "start_theta", "goal_x", "goal_y", "world", "kind"),
    *("odom_x", "odom_y", "odom_theta", "true_x", "true_y", "theta"),
)
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
        self._drawn = min(robots, MAX_PICTURES)
        columns = math.isqrt(robots - 1) + 1
        side = min(TILE_SIDE, max(SMALLEST_SIDE, LARGEST_SIDE // columns // 2 * 2))
        self._size = (side, side)
        self._views: list[Any] = []
        self._paths: list[tuple[list[Point], list[Point]]] = [([], []) for _ in range(self._drawn)]
        self._state: NDArray[np.float64] = np.zeros((len(FIELDS), self._drawn))
        self._movers: list[NDArray[np.float64] | None] = [None] * self._drawn

    def __reduce__(self) -> tuple[Any, ...]:
        """Copy the settings only: a copy has no recorded paths."""
        return BatchScreen, (self._fleet, self._robots, self._tolerance)

    def show(self, batch: Batch) -> None:
        """Record the robots' new states."""
        self._state = batch.read(*FIELDS)[:, : self._drawn]
        for robot, (odom_path, true_path) in enumerate(self._paths):
            state = dict(zip(FIELDS, self._state[:, robot].tolist(), strict=True))
            if state["steps"] == 0.0:
                odom_path.clear()
                true_path.clear()
            start = state["start_x"], state["start_y"], state["start_theta"]
            odom_path.append(to_world(start, (state["odom_x"], state["odom_y"], 0.0))[:2])
            true_path.append(to_world(start, (state["true_x"], state["true_y"], 0.0))[:2])
            self._movers[robot] = batch.copy_movers(robot, int(state["world"]))

    def pictures(self, batch: Batch) -> tuple[Image, ...]:
        """Draw the newest states, a picture (height, width, 3) for each robot of the batch."""
        from acsar_gym.render.top_view import TopView  # noqa: PLC0415 - needs Pillow

        if not self._views:
            kinds = [self._fleet[robot % len(self._fleet)] for robot in range(self._drawn)]
            self._views = [TopView(config, self._size) for config in kinds]
        drawn = [self._draw(batch, robot) for robot in range(self._drawn)]
        empty = np.full((*self._size, 3), EMPTY_COLOUR, np.uint8)
        return (*drawn, *[empty] * (self._robots - self._drawn))

    def _draw(self, batch: Batch, robot: int) -> Image:
        """Draw one robot."""
        from acsar_gym.render.top_view import TopViewFrame  # noqa: PLC0415 - needs Pillow

        state = dict(zip(FIELDS, self._state[:, robot].tolist(), strict=True))
        config = self._fleet[robot % len(self._fleet)]
        start = state["start_x"], state["start_y"], state["start_theta"]
        ranges = batch.tables.ranges[robot]
        spec = ray_spec(config)
        frame = TopViewFrame(
            world=batch.worlds[int(state["world"])] if batch.worlds else None,
            odom=to_world(start, (state["odom_x"], state["odom_y"], state["odom_theta"])),
            truth=to_world(start, (state["true_x"], state["true_y"], state["theta"])),
            goal=to_world(start, (state["goal_x"], state["goal_y"], 0.0))[:2],
            goal_radius=self._tolerance,
            odom_path=self._paths[robot][0],
            true_path=self._paths[robot][1],
            rays=(spec.angles(), ranges[: len(spec.angles())]) if len(ranges) else None,
            reach=config.lidar.max_range,
            movers=self._movers[robot],
            caption=f"{robot}: step {state['steps']:.0f}",
        )
        image: Image = np.array(self._views[robot].draw(frame), np.uint8)
        image[-1, :] = image[:, -1] = EMPTY_COLOUR  # between tiles
        return image
