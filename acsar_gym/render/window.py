"""A window that displays pictures, with tkinter of the standard library."""

from __future__ import annotations

import weakref
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from acsar_gym.errors import RenderError

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
