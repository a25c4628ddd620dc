"""Shows an environment: top view or simulator's camera, as pictures, or in a window."""

from __future__ import annotations

import warnings
import weakref
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.errors import AcsarWarning, ConfigError
from acsar_gym.lidar.scan import Scan, ray_spec
from acsar_gym.links import Link
from acsar_gym.physics.bodies import LINKS_WITH_CAMERA
from acsar_gym.physics.body import Image
from acsar_gym.tasks import Assignment, State
from acsar_gym.truth import GroundTruth
from acsar_gym.worlds import Pose
from acsar_gym.worlds.world import point_in_world, to_world

if TYPE_CHECKING:
    import tkinter as tk

TOP_SIZE = (480, 480)
"""Width and height of the top view [pixels]."""
CAMERA_SIZE = (640, 480)
"""Width and height of the camera's pictures [pixels]."""


class Screen:
    """Records the paths driven and draws pictures on request; does nothing without a mode."""

    def __init__(self, config: RobotConfig, mode: str | None, view: str) -> None:
        self._config, self._mode, self._view = config, mode, view
        self._angles = ray_spec(config).angles()
        self._top: Any = None
        self._window: Window | None = None
        self._assignment: Assignment | None = None
        self._tolerance = 0.0
        self._odom_path: list[tuple[float, float]] = []
        self._true_path: list[tuple[float, float]] = []
        self._state: State | None = None
        self._truth: GroundTruth | None = None
        self._movers: NDArray[np.float64] | None = None
        self._scan: Scan | None = None

    def __reduce__(self) -> tuple[Any, ...]:
        """Copy the settings only: a copy has no window and no recorded paths."""
        return Screen, (self._config, self._mode, self._view)

    def begin(self, assignment: Assignment, tolerance: float) -> None:
        """Start a new episode; `tolerance` is the radius of the goal [m]."""
        self._assignment, self._tolerance = assignment, tolerance
        self._odom_path, self._true_path = [], []

    def show(self, state: State, truth: GroundTruth | None, scan: Scan | None) -> None:
        """Record the robot's new state; a window displays it at once.

        If no window can be opened, warns once and continues without one.
        """
        if self._mode is None:
            return
        self._state, self._truth, self._scan = state, truth, scan
        self._odom_path.append(self._pose_in_world(state)[:2])
        self._movers = None
        if truth is not None:
            self._true_path.append(truth.pose[:2])
            self._movers = truth.crowd.copy_states() if truth.crowd is not None else None
        if self._mode == "human":
            image = self._draw_top()
            if self._window is None:
                self._window = Window("acsar_gym")
            try:
                self._window.show(image)
            except ConfigError as error:
                self._window.close()
                told = f"{error}; pictures are drawn off-screen"
                warnings.warn(told, AcsarWarning, stacklevel=5)

    def _pose_in_world(self, state: State) -> Pose:
        """Convert the pose from the odometry frame to the frame of the world."""
        return to_world(self._assignment.start, state.pose) if self._assignment else state.pose

    def picture(self, link: Link) -> Image:
        """Draw the newest state."""
        if self._view == "top":
            return self._draw_top()
        camera = link.camera
        if camera is None:
            raise ConfigError(f"this link has no camera; view='camera' needs {LINKS_WITH_CAMERA}")
        return camera.image(*CAMERA_SIZE)

    def _draw_top(self) -> Image:
        """Draw the top view of the newest state."""
        from acsar_gym.render.top_view import TopView, TopViewFrame  # noqa: PLC0415 - optional

        if self._top is None:
            self._top = TopView(self._config, TOP_SIZE)
        state, assignment = self._state, self._assignment
        if state is None or assignment is None:
            raise ConfigError("there is nothing to see before reset(): call it first")
        frame = TopViewFrame(
            world=assignment.world,
            odom=self._pose_in_world(state),
            truth=None if self._truth is None else self._truth.pose,
            goal=point_in_world(assignment.start, assignment.goal),
            goal_radius=self._tolerance,
            odom_path=self._odom_path,
            true_path=self._true_path,
            rays=None if self._scan is None else (self._angles, self._scan.ranges),
            reach=self._config.lidar.max_range,
            movers=self._movers,
            caption=f"step {len(self._odom_path) - 1}",
        )
        image: Image = np.asarray(self._top.draw(frame), np.uint8)
        return image

    def close(self) -> None:
        """Close the window. Idempotent."""
        if self._window is not None:
            self._window.close()
            self._window = None


class Window:
    """Displays pictures with tkinter; it opens with the first one; to be used from one thread.

    Once it is closed, by `close()` or by the user, further pictures are ignored.
    """

    def __init__(self, title: str) -> None:
        self._title = title
        self._closed = False
        self._root: tk.Tk | None = None
        self._photo: tk.PhotoImage | None = None
        self._destroy: weakref.finalize[..., Window] | None = None

    @property
    def closed(self) -> bool:
        """Whether the window was closed."""
        return self._closed or (self._destroy is not None and not self._destroy.alive)

    def show(self, image: NDArray[np.uint8]) -> None:
        """Display a picture and handle the window's events."""
        if not self.closed:
            if self._root is None or self._photo is None:
                self._root, self._photo = self._open()
            height, width = image.shape[:2]
            data = b"P6 %d %d 255\n" % (width, height) + image.tobytes()  # PPM, which Tk reads
            self._photo.configure(width=width, height=height, data=data, format="PPM")
            self._root.update()
        if self.closed:
            self.close()

    def _open(self) -> tuple[tk.Tk, tk.PhotoImage]:
        instead = "use render_mode='rgb_array'"
        try:
            import tkinter as tk  # noqa: PLC0415 - not every Python has it
        except ImportError as error:
            raise ConfigError(
                "render_mode='human' needs tkinter, which this Python lacks: install python3-tk, "
                f"or {instead}"
            ) from error
        try:
            root = tk.Tk(className="acsar_gym")
        except tk.TclError as error:
            raise ConfigError(f"render_mode='human' needs a display; {instead}") from error
        # A callback that is a method would keep this object alive; a finalizer doesn't.
        self._destroy = weakref.finalize(self, root.destroy)
        root.protocol("WM_DELETE_WINDOW", self._destroy)
        root.title(self._title)
        root.resizable(width=False, height=False)
        photo = tk.PhotoImage(master=root)
        tk.Label(root, image=photo, borderwidth=0).pack()
        return root, photo

    def close(self) -> None:
        """Close the window. Idempotent."""
        self._closed = True
        if self._destroy is not None:
            self._destroy()
            self._root = self._photo = self._destroy = None
