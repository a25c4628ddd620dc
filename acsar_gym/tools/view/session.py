"""One run that is shown: its recording, where it stands, and how to stop it."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from acsar_gym.errors import ConfigError, LinkError, RenderError
from acsar_gym.guard import estop
from acsar_gym.tools.view import drawing, log
from acsar_gym.tools.view.camera import Camera, Shot
from acsar_gym.tools.view.log import LogLine
from acsar_gym.tools.view.overlay import Overlay, Partner
from acsar_gym.tools.view.tail import (
    MAX_COORDINATE,
    WRITING_TIMEOUT,
    GrowingEpisode,
    RecordingTail,
)
from acsar_gym.worlds import Scene, World
from acsar_gym.worlds.world import point_in_world

LIVE, STOPPED, ENDED, RECORDED, BROKEN = "live", "stopped", "ended", "recorded", "broken"


@dataclass(frozen=True)
class StopAnswer:
    """What came of a stop.

    Attributes: `state`, "stopped", "unanswered" or "nobody"; `said`, in words.
    """

    state: str
    said: str


def can_stop_process(process: int) -> bool:
    """Whether a process listens for a stop: programs that drive a real robot do."""
    try:
        return process > 0 and estop.is_listening(process)
    except LinkError:
        return False


def stop_process(process: int) -> StopAnswer:
    """Ask the process that drives to stop the robot, and wait until it says that it has.

    This is the same emergency stop as `acsar-gym estop`, for one process. Its control loop answers
    once zero was written to the wire, and goes on commanding zero until somebody releases it,
    whatever the program resets. Where it doesn't answer, its watchdog process commands zero on its
    own. Nobody else is asked, so that nobody else's silence counts.

    Args:
        process: its id.
    """
    began = time.monotonic()
    try:
        found = estop.stop_all(process=process) if process else []
    except LinkError as error:
        return StopAnswer("unanswered", str(error))
    took = (time.monotonic() - began) * 1e3
    answered = bool(found) and all(each.answered for each in found)
    if not (answered or can_stop_process(process)):
        said = "nothing to stop: the program has ended, and it or its watchdog stops the wheels"
        return StopAnswer("nobody", said)
    if not answered:
        said = "the program doesn't answer: its watchdog stops the wheels"
        return StopAnswer("unanswered", said)
    if not all(each.connected for each in found):
        said = "the program isn't connected to the robot, and won't drive it"
        return StopAnswer("stopped", said)
    clock = time.strftime("%H:%M:%S")
    said = f"zero is on the wire, says the control loop (after {took:.0f} ms, at {clock})"
    return StopAnswer("stopped", f"{said}, until acsar-gym estop --release")


class Session:
    """A recording, whether it is live, and the stop button.

    Attributes: `problem`, why it can't be read any further, empty where it can; `stopped`, what
    came of the last stop, None before; `revision`, how often there was something new; `run`, how
    often another recording, or a live run, has begun.

    Args:
        path: of the recording.
        over: another recording, which is drawn over it.

    Raises:
        ConfigError: one can't be read, is over and holds no episode, or they have none in common.
    """

    def __init__(self, path: Path, over: Path | None = None) -> None:
        self.tail = RecordingTail(path)
        self.overlay = None if over is None else Overlay(over)
        self.problem = ""
        self.stopped: StopAnswer | None = None
        self.revision, self.run = 1, 0
        self._lock, self._stopping = threading.Lock(), threading.Lock()
        self._worlds: dict[int, World | None] = {}
        self._lines: tuple[tuple[int, int], list[LogLine]] | None = None
        self._stopped_in = 0
        self._camera = Camera()
        self._was_live = self._is_written()
        if not self.tail.episodes and not self._was_live:
            raise ConfigError(f"{path}: holds no episode")
        if self.tail.episodes and all(map(self.explain_alone, range(len(self.tail.episodes)))):
            raise ConfigError(self.explain_alone(0))

    def poll(self) -> int:
        """Read what was added; returns `revision`: each page knows which one it shows."""
        with self._lock:
            known, was_live = self.tail.header, self._was_live
            try:
                self.revision += self.tail.poll()
                self.problem = ""
            except ConfigError as error:
                self.problem = str(error)
            if self.tail.header is not known:
                self._worlds, self.stopped, self._was_live = {}, None, False
                self.run += 1
            elif len(self.tail.episodes) > self._stopped_in:
                self.stopped = None  # somebody has started again
            self._was_live = self._was_live or self._is_written()
            self.run += self._was_live and not was_live
            return self.revision

    def _is_written(self) -> bool:
        """Whether a process on this computer is writing it."""
        return self.tail.is_open and self.tail.age < WRITING_TIMEOUT

    @property
    def state(self) -> str:
        """LIVE, STOPPED, ENDED, RECORDED or BROKEN."""
        if self.problem:
            return BROKEN
        if self.stopped is not None and self.stopped.state == "stopped":
            return STOPPED
        if self.is_live:
            return LIVE
        return ENDED if self._was_live else RECORDED

    @property
    def is_live(self) -> bool:
        """Whether the run goes on, stopped or not, and whether or not its recording does."""
        return self._was_live and self.tail.is_open

    @property
    def can_stop(self) -> bool:
        """Whether the stop button does anything."""
        return self.is_live and can_stop_process(self.tail.process)

    def stop(self) -> StopAnswer:
        """Stop the robot, and wait until its program says so; several at once have to queue."""
        with self._stopping:
            before, newest = self.stopped, len(self.tail.episodes)
            found = stop_process(self.tail.process)
            if found.state == "nobody" and before is not None and before.state == "stopped":
                return before  # a second click, while the program that was stopped ends
            self._stopped_in, self.stopped = newest, found
            return found

    def episode(self, number: int) -> GrowingEpisode | None:
        """Return an episode; the newest one for a number that there isn't."""
        found = self.tail.episodes
        if not found:
            return None
        return found[number] if 0 <= number < len(found) else found[-1]

    def close(self) -> None:
        """End the process that draws pictures; idempotent."""
        self._camera.close()

    def find_partner(self, number: int) -> Partner | None:
        """Return what is drawn over an episode; None where nothing is to be.

        Raises:
            ConfigError: the overlay has no episode of the same seed and goal.
        """
        episodes = self.tail.episodes
        if self.overlay is None or not 0 <= number < len(episodes):
            return None
        return self.overlay.find_partner(episodes, number)

    def explain_alone(self, number: int) -> str:
        """Say why nothing is drawn over an episode; empty where something is, or shouldn't be."""
        try:
            self.find_partner(number)
        except ConfigError as error:
            return str(error)
        return ""

    def draw(self, number: int, at: float) -> tuple[dict[str, Any], dict[str, str]]:
        """Draw an episode at a time since its reset [s].

        Returns:
            Figures of plotly: top, wheels, lateness; and texts, see `drawing.read_values`, with
            `gap`, and `camera`, the numbers that `draw_picture` takes, "/" between them. Both are
            empty where there is no episode.
        """
        with self._lock:
            episode, config = self.episode(number), self.tail.config
            if episode is None:
                return {}, {}
            world, revision = self._find_world(number, episode), str(number)
            other = None if self.explain_alone(number) else self.find_partner(number)
            top = drawing.draw_episode_from_above(episode, config, world, at, revision, other)
            figures = {
                "top": top,
                "wheels": drawing.draw_wheels(episode, at, revision, other),
                "lateness": drawing.draw_lateness(episode, config.late_tick, at, revision),
            }
            row = max(episode.count_truth(at) - 1, 0) if episode.is_simulated else 0
            texts = {
                "camera": f"{self.run}/{max(number, 0)}/{row}",
                "gap": drawing.describe_gap(episode, other, at),
            }
            return figures, drawing.read_values(episode, at) | texts

    def _find_world(self, number: int, episode: GrowingEpisode) -> World | None:
        """Return the world of an episode; made once, and None where it isn't known."""
        if number not in self._worlds and len(episode.truth):
            self._worlds[number] = drawing.find_world(self.tail.header, self.tail.config, episode)
        return self._worlds.get(number)

    def draw_picture(self, run: int, number: int, row: int) -> bytes:
        """Draw what PyBullet's camera behind the robot sees, as PNG.

        Others, such as the stop, don't wait for it; newest pictures are kept.

        Args:
            run: as `run` was when the picture was asked for.
            number: of the episode.
            row: of its true poses.

        Raises:
            RenderError: there is no such picture.
        """
        with self._lock:
            episodes, config = self.tail.episodes, self.tail.config
            if run != self.run or not 0 <= number < len(episodes):
                raise RenderError("no picture: another recording has begun")
            episode = episodes[number]
            if not episode.is_simulated:
                raise RenderError("no picture: only simulated robots have this camera")
            poses, goal = episode.truth.rows[:, 1:4], episode.goal
            if not (0 <= row < len(poses) and (np.abs(poses[row]) < MAX_COORDINATE).all()):
                raise RenderError("no picture: the true pose isn't known then")
            x, y, theta = poses[row].tolist()
            target = None if goal is None else point_in_world(episode.start, goal)
            scene = Scene((x, y, theta), target, self._find_world(number, episode))
        return self._camera.draw(Shot((run, number), config, scene))

    def list_lines(self, number: int) -> list[LogLine]:
        """Return what happened in an episode, see `log.list_lines`, and how the recording ended."""
        with self._lock:
            episode, key = self.episode(number), (self.revision, number)
            if episode is None:
                return []
            if self._lines is None or self._lines[0] != key:
                self._lines = key, log.list_lines(episode, self.tail.config.late_tick)
            lines = list(self._lines[1])
            if episode is self.tail.episodes[-1] and not self.is_live:
                lines.append(log.describe_end(self.tail, max(episode.end, lines[-1].time)))
            return lines
