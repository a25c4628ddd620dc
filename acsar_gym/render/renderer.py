"""Renders an environment: top view or PyBullet's camera, as pictures or in a window."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np

from acsar_gym.bodies.base import GroundTruth, Image
from acsar_gym.config import RobotConfig
from acsar_gym.errors import OffScreenWarning, RenderError
from acsar_gym.lidars.base import Scan, ray_spec
from acsar_gym.links import Link
from acsar_gym.links.base import camera_of
from acsar_gym.tasks import Assignment, State
from acsar_gym.worlds import Pose
from acsar_gym.worlds.scene import point_in_world, to_world

TOP_SIZE = (480, 480)
"""Width and height of the top view [pixels]."""
CAMERA_SIZE = (640, 480)
"""Width and height of the camera's pictures [pixels]."""


class Screen:
    """Records the paths driven and draws pictures on request; does nothing without a mode.

    Args:
        config: configuration of the robot.
        mode: render mode of the env; None for no rendering.
        view: "top", or "camera" for PyBullet's camera behind the robot.
    """

    def __init__(self, config: RobotConfig, mode: str | None, view: str) -> None:
        self._config, self._mode, self._view = config, mode, view
        self._angles = ray_spec(config).angles()
        self._top: Any = None
        self._window: Any = None
        self._assignment: Assignment | None = None
        self._tolerance = 0.0
        self._odom_path: list[tuple[float, float]] = []
        self._true_path: list[tuple[float, float]] = []
        self._state: State | None = None
        self._truth: GroundTruth | None = None
        self._scan: Scan | None = None

    def __reduce__(self) -> tuple[Any, ...]:
        """Copy the settings only: a copy has no window and no recorded paths."""
        return Screen, (self._config, self._mode, self._view)

    def begin(self, assignment: Assignment, tolerance: float) -> None:
        """Start a new episode; `tolerance` is the radius of the goal [m]."""
        self._assignment, self._tolerance = assignment, tolerance
        self._odom_path, self._true_path = [], []

    def show(self, state: State, truth: GroundTruth | None, scan: Scan | None) -> None:
        """Record the robot's new state; a window displays it at once."""
        if self._mode is None:
            return
        self._state, self._truth, self._scan = state, truth, scan
        self._odom_path.append(self._placed(state.pose)[:2])
        if truth is not None:
            self._true_path.append(truth.pose[:2])
        if self._mode == "human":
            self._on_window(self._drawn())

    def _placed(self, pose: Pose) -> Pose:
        """Convert a pose from the odometry frame to the frame of the world."""
        return to_world(self._assignment.start, pose) if self._assignment else pose

    def picture(self, link: Link) -> Image:
        """Draw the newest state.

        Args:
            link: link of the robot, for the camera.

        Returns:
            The picture, (height, width, 3).

        Raises:
            RenderError: this link has no camera.
        """
        if self._view == "top":
            return self._drawn()
        camera = camera_of(link)
        if camera is None:
            raise RenderError("this link has no camera; view='camera' needs link='bullet'")
        return camera.image(*CAMERA_SIZE)

    def _drawn(self) -> Image:
        """Draw the top view of the newest state."""
        from acsar_gym.render.top_view import Frame, TopView  # noqa: PLC0415 - optional

        if self._top is None:
            self._top = TopView(self._config, TOP_SIZE)
        state, assignment = self._state, self._assignment
        if state is None or assignment is None:
            raise RenderError("there is nothing to see before reset(): call it first")
        frame = Frame(
            world=assignment.world,
            odom=self._placed(state.pose),
            truth=None if self._truth is None else self._truth.pose,
            goal=point_in_world(assignment.start, assignment.goal),
            goal_radius=self._tolerance,
            odom_path=self._odom_path,
            true_path=self._true_path,
            rays=None if self._scan is None else (self._angles, self._scan.ranges),
            reach=self._config.lidar.max_range,
            caption=f"step {len(self._odom_path) - 1}",
        )
        image: Image = np.asarray(self._top.draw(frame), np.uint8)
        return image

    def _on_window(self, image: Image) -> None:
        """Display a picture; if no window can be opened, warn once and continue without one."""
        from acsar_gym.render.window import Window  # noqa: PLC0415 - needs tkinter

        if self._window is None:
            self._window = Window("acsar_gym", TOP_SIZE)
        try:
            self._window.show(image)
        except RenderError as error:
            self._window.close()
            warnings.warn(f"{error}; pictures are drawn off-screen", OffScreenWarning, stacklevel=6)

    def close(self) -> None:
        """Close the window. Idempotent."""
        if self._window is not None:
            self._window.close()
            self._window = None
