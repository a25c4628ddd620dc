"""Shows an environment: top view or PyBullet's camera, as pictures, in a window, or as a video."""

from __future__ import annotations

import contextlib
import warnings
import weakref
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from acsar_gym import reading
from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError, MissingExtraError, OffScreenWarning, RenderError
from acsar_gym.links import Link
from acsar_gym.links.base import camera_of
from acsar_gym.physics.body import GroundTruth, Image
from acsar_gym.render.top_view import RgbImage
from acsar_gym.sensors.lidar import Scan, ray_spec
from acsar_gym.tasks import Assignment, State
from acsar_gym.worlds import Pose
from acsar_gym.worlds.world import point_in_world, to_world

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
        from acsar_gym.render.top_view import TopView, TopViewFrame  # noqa: PLC0415 - optional

        if self._top is None:
            self._top = TopView(self._config, TOP_SIZE)
        state, assignment = self._state, self._assignment
        if state is None or assignment is None:
            raise RenderError("there is nothing to see before reset(): call it first")
        frame = TopViewFrame(
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


VIDEO_SUFFIXES = (".mp4",)
"""Kinds of video files."""


def import_moviepy() -> Any:
    """Return moviepy's writer; MissingExtraError where it isn't installed."""
    try:
        with warnings.catch_warnings():  # of its dependencies' own old calls
            warnings.simplefilter("ignore")
            from moviepy.video.io.ffmpeg_writer import FFMPEG_VideoWriter  # noqa: PLC0415
    except ImportError:
        raise MissingExtraError("a video", "video") from None
    return FFMPEG_VideoWriter


def write_video(path: Path, images: Iterable[RgbImage], rate: float) -> None:
    """Write pictures as an H.264 video that browsers play.

    Args:
        path: .mp4 file to write.
        images: at least one; all of the same even width and height.
        rate: pictures per second.

    Raises:
        ConfigError: the file can't be written, as on a full disk; what was there before stays.
        MissingExtraError: moviepy isn't installed.
    """
    writer_of, pictures = import_moviepy(), iter(images)
    first = next(pictures)
    try:
        with reading.replace_file(path) as new:
            _encode(writer_of, new, first, pictures, rate)
    except OSError as error:
        raise _failed(path, error.strerror or str(error)) from None


def _encode(
    writer_of: Any, path: Path, first: RgbImage, pictures: Iterator[RgbImage], rate: float
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


if TYPE_CHECKING:
    import tkinter as tk

NO_DISPLAY = "render_mode='human' needs a display; use render_mode='rgb_array'"
NO_TKINTER = (
    "render_mode='human' needs tkinter, which this Python lacks: install python3-tk, or use "
    "render_mode='rgb_array'"
)


class Window:
    """Displays pictures; it opens with the first one, and must be used from one thread.

    Once it is closed, by `close()` or by the user, further pictures are ignored.

    Args:
        title: title of the window.
        size: width and height [pixels] until a picture has another size.
    """

    def __init__(self, title: str, size: tuple[int, int]) -> None:
        """`size` is the width and height [pixels] until a picture has another."""
        self._title, self._size = title, size
        self._closed = False
        self._open: _Open | None = None

    @property
    def closed(self) -> bool:
        """Whether the window was closed."""
        return self._closed or (self._open is not None and not self._open.destroy.alive)

    def show(self, image: NDArray[np.uint8]) -> None:
        """Display a picture and handle the window's events.

        Args:
            image: shape (height, width, 3), RGB.

        Raises:
            RenderError: there is no display or no tkinter.
            ValueError: the picture has another shape.
        """
        data = _ppm(image)
        if not self.closed:
            self._open = self._open or _Open(self._title, self._size)
            height, width = image.shape[:2]
            self._open.show(data, width, height)
        if self.closed:
            self.close()

    def close(self) -> None:
        """Close the window. Idempotent."""
        self._closed = True
        if self._open is not None:
            self._open.destroy()
            self._open = None


class _Open:
    """The Tk objects of an open window; destroyed with their owner, or when the user closes it."""

    def __init__(self, title: str, size: tuple[int, int]) -> None:
        try:
            import tkinter as tk  # noqa: PLC0415 - not every Python has it
        except ImportError:
            raise RenderError(NO_TKINTER) from None
        try:
            root = tk.Tk(className="acsar_gym")
        except tk.TclError:
            raise RenderError(NO_DISPLAY) from None
        # A callback that is a method would keep this object alive; a finalizer doesn't.
        self.destroy = weakref.finalize(self, root.destroy)
        self._root: tk.Tk = root
        root.protocol("WM_DELETE_WINDOW", self.destroy)
        root.title(title)
        root.resizable(width=False, height=False)
        self._photo = tk.PhotoImage(master=root, width=size[0], height=size[1])
        tk.Label(root, image=self._photo, borderwidth=0).pack()

    def show(self, data: bytes, width: int, height: int) -> None:
        self._photo.configure(width=width, height=height, data=data, format="PPM")
        self._root.update()


def _ppm(image: NDArray[np.uint8]) -> bytes:
    """Encode a picture as PPM, which Tk reads."""
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
        raise ValueError(f"pictures are height x width x 3 of uint8, not {image.shape}")
    height, width = image.shape[:2]
    return b"P6 %d %d 255\n" % (width, height) + image.tobytes()
