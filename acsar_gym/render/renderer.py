"""Shows an environment: top view or simulator's camera, as pictures, or in a window."""

from __future__ import annotations

import warnings
import weakref
from typing import TYPE_CHECKING, Any

from acsar_gym.config import RobotConfig
from acsar_gym.errors import AcsarWarning, ConfigError
from acsar_gym.lidar.scan import Scan, ray_spec
from acsar_gym.links import Link
from acsar_gym.physics.bodies import LINKS_WITH_CAMERA
from acsar_gym.physics.body import Image
from acsar_gym.render.top_view import TopView, TopViewFrame
from acsar_gym.tasks import Assignment, State
from acsar_gym.truth import GroundTruth
from acsar_gym.worlds.world import point_in_world, to_world

if TYPE_CHECKING:
    import tkinter as tk

CAMERA_SIZE = (640, 480)
"""Width and height of the camera's pictures [pixels]."""


class Screen:
    """Records the paths driven, and draws pictures on request. Does nothing without a mode.

    Args:
        config: Robot configuration.
        mode: Render mode of the env.
        view: "top" or "camera".
    """

    def __init__(self, config: RobotConfig, mode: str | None, view: str) -> None:
        self._settings = (config, mode, view)
        self._top: TopView | None = None
        self._window: Window | None = None
        self._frame: TopViewFrame | None = None

    def __reduce__(self) -> tuple[Any, ...]:
        """Copy the settings only: a copy has no window and no recorded paths."""
        return Screen, self._settings

    def begin(self, assignment: Assignment, tolerance: float) -> None:
        """Start a new episode. `tolerance` is the radius of the goal [m]."""
        self._assignment = assignment
        self._tolerance = tolerance
        self._odom_path: list[tuple[float, float]] = []
        self._true_path: list[tuple[float, float]] = []

    def show(self, state: State, truth: GroundTruth | None, scan: Scan | None) -> None:
        """Record the robot's new state. A window displays it at once.

        If no window can be opened, warns once and draws off-screen.
        """
        config, mode, _ = self._settings
        if mode is None:
            return

        # Odometry begins at the start, truth is in the frame of the world.
        assignment = self._assignment
        odom = to_world(assignment.start, state.pose)
        self._odom_path.append(odom[:2])
        # A real robot has no ground truth: then only the path by odometry is drawn.
        if truth is not None:
            self._true_path.append(truth.pose[:2])
        self._frame = TopViewFrame(
            world=assignment.world,
            odom=odom,
            truth=truth.pose if truth else None,
            goal=point_in_world(assignment.start, assignment.goal),
            goal_radius=self._tolerance,
            odom_path=self._odom_path,
            true_path=self._true_path,
            rays=(ray_spec(config).angles(), scan.ranges) if scan is not None else None,
            reach=config.lidar.max_range,
            movers=truth.crowd.copy_states() if truth and truth.crowd is not None else None,
            caption=f"step {len(self._odom_path) - 1}",
        )
        if mode == "human":
            self._show_window()

    def _show_window(self) -> None:
        image = self._draw_top()
        if self._window is None:
            self._window = Window("acsar_gym")
        try:
            self._window.show(image)
        except ConfigError as error:
            # An episode must not fail for lack of a display. A closed window ignores pictures.
            self._window.close()
            warnings.warn(f"{error}; pictures are drawn off-screen", AcsarWarning, stacklevel=6)

    def picture(self, link: Link) -> Image:
        """Draw the newest state."""
        if self._settings[2] == "top":
            return self._draw_top()
        camera = link.camera
        if camera is None:
            raise ConfigError(f"this link has no camera; view='camera' needs {LINKS_WITH_CAMERA}")
        return camera.image(*CAMERA_SIZE)

    def _draw_top(self) -> Image:
        """Draw the top view of the newest state."""
        self._top = self._top or TopView(self._settings[0])
        if self._frame is None:
            raise ConfigError("there is nothing to see before reset(): call it first")
        return self._top.draw(self._frame)

    def close(self) -> None:
        """Close the window. Idempotent."""
        if self._window is not None:
            self._window.close()
            self._window = None


class Window:
    """Displays pictures with tkinter. The window opens with the first picture.

    Once it is closed, by `close()` or by the user, further pictures are ignored. A window must be
    used by one thread only.
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

    def show(self, image: Image) -> None:
        """Display a picture and handle the window's events."""
        if not self.closed:
            if self._root is None or self._photo is None:
                self._root, self._photo = self._open()
            height, width = image.shape[:2]
            data = b"P6 %d %d 255\n" % (width, height) + image.tobytes()  # PPM, which Tk reads
            self._photo.configure(width=width, height=height, data=data, format="PPM")
            # Tk has no main loop here: without this call the window would neither draw nor close.
            self._root.update()
        if self.closed:
            self.close()

    def _open(self) -> tuple[tk.Tk, tk.PhotoImage]:
        hint = "use render_mode='rgb_array'"
        try:
            import tkinter as tk  # noqa: PLC0415 - not every Python has it
        except ImportError as error:
            raise ConfigError(
                "render_mode='human' needs tkinter, which this Python lacks: install python3-tk, "
                f"or {hint}"
            ) from error
        try:
            root = tk.Tk(className="acsar_gym")
        except tk.TclError as error:
            raise ConfigError(f"render_mode='human' needs a display; {hint}") from error

        # A callback that is a method would keep this object alive. A finalizer doesn't.
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
