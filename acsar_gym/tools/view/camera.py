"""Pictures of PyBullet's camera for moments of a recording, drawn in a process of their own.

PyBullet holds Python's global lock while it draws, most of a second for a picture: in the
dashboard's own process, a stop that somebody asks for would wait for it.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import threading
from collections import OrderedDict
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any

from acsar_gym.config import RobotConfig
from acsar_gym.errors import AcsarError, RenderError, escape_unprintable
from acsar_gym.physics.bodies import make_body
from acsar_gym.render.canvas import encode_png
from acsar_gym.worlds import Scene

PICTURE_SIZE = (480, 360)
"""Width and height [pixels]."""
PICTURE_TIMEOUT = 60.0
"""A process that draws for longer hangs [s]."""
KEPT_PICTURES = 100
"""Newest pictures that are kept."""
PICTURE_NICENESS = 10
"""How far everything else goes before pictures."""


@dataclass(frozen=True)
class Shot:
    """What there is to see.

    Attributes: `stage`, the same for pictures of the same robot and world; `config`, of the robot;
    `scene`, with the robot where it is to be seen.
    """

    stage: tuple[int, int]
    config: RobotConfig
    scene: Scene


class Camera:
    """Draws pictures, one at a time; the process that draws them starts with the first one."""

    def __init__(self) -> None:
        self._drawing = threading.Lock()
        self._process: Any = None
        self._connection: Connection | None = None
        self._kept = OrderedDict[tuple[Any, ...], bytes]()

    def draw(self, shot: Shot) -> bytes:
        """Return a picture as PNG.

        Raises:
            RenderError: it can't be drawn, as without PyBullet.
        """
        key = shot.stage, shot.scene.start
        with self._drawing:
            if key in self._kept:
                return self._kept[key]
            connection = self._connection or self._start()
            try:
                connection.send(shot)
                found = connection.recv() if connection.poll(PICTURE_TIMEOUT) else None
            except (EOFError, OSError):
                found = None
            if found is None:
                self.close()
                raise RenderError("no picture: the process that draws it has ended, or hangs")
            if isinstance(found, str):
                raise RenderError(found)
            if len(self._kept) == KEPT_PICTURES:
                self._kept.popitem(last=False)
            self._kept[key] = found
            return self._kept[key]

    def _start(self) -> Connection:
        context = multiprocessing.get_context("spawn")
        connection, theirs = context.Pipe()
        process = context.Process(target=draw_pictures, args=(theirs,), daemon=True)
        process.start()
        theirs.close()
        self._process, self._connection = process, connection
        return connection

    def close(self) -> None:
        """End the process; idempotent. The next picture starts another one."""
        process, self._process, self._connection = self._process, None, None
        if process is not None:
            process.kill()
            process.join()


def draw_pictures(connection: Connection) -> None:
    """Draw what is asked for until the pipe is closed: the body of a process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the first process, too
    os.nice(PICTURE_NICENESS)
    body: Any = None
    stage, scene = None, Scene()
    with contextlib.suppress(EOFError, OSError):
        while True:
            shot: Shot = connection.recv()
            try:
                if shot.stage != stage:
                    if body is not None:
                        body.close()
                    body, stage, scene = make_body("bullet", shot.config), shot.stage, shot.scene
                world = scene.world  # the same object each time: the simulation isn't built again
                body.reset(Scene(start=shot.scene.start, goal=shot.scene.goal, world=world))
                connection.send(encode_png(body.image(*PICTURE_SIZE)))
            except AcsarError as error:
                connection.send(f"no picture: {error}")
            except Exception as error:  # noqa: BLE001 - of PyBullet, for odd robots
                connection.send(f"no picture: {escape_unprintable(str(error))}")
