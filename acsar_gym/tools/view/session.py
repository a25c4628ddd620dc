"""One run that is shown: its recording, where it stands, and how to stop it."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from acsar_gym.errors import ConfigError, LinkError
from acsar_gym.safety import estop
from acsar_gym.tools.view import drawing
from acsar_gym.tools.view.tail import WRITING_TIMEOUT, GrowingEpisode, RecordingTail
from acsar_gym.worlds import World

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
    came of the last stop, None before; `revision`, how often there was something new.

    Args:
        path: of the recording.

    Raises:
        ConfigError: it can't be read, or is over and holds no episode.
    """

    def __init__(self, path: Path) -> None:
        self.tail = RecordingTail(path)
        self.problem = ""
        self.stopped: StopAnswer | None = None
        self.revision = 1
        self._lock, self._stopping = threading.Lock(), threading.Lock()
        self._worlds: dict[int, World | None] = {}
        self._stopped_in = 0
        self._was_live = self._is_written()
        if not self.tail.episodes and not self._was_live:
            raise ConfigError(f"{path}: holds no episode")

    def poll(self) -> int:
        """Read what was added; returns `revision`: each page knows which one it shows."""
        with self._lock:
            known = self.tail.header
            try:
                self.revision += self.tail.poll()
                self.problem = ""
            except ConfigError as error:
                self.problem = str(error)
            if self.tail.header is not known:
                self._worlds, self.stopped, self._was_live = {}, None, False
            elif len(self.tail.episodes) > self._stopped_in:
                self.stopped = None  # somebody has started again
            self._was_live = self._was_live or self._is_written()
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

    def draw(self, number: int, at: float) -> tuple[dict[str, Any], dict[str, str]]:
        """Draw an episode at a time since its reset [s].

        Returns:
            Figures of plotly: top, wheels, lateness; and texts, see `drawing.read_values`. Both
            are empty where there is no episode.
        """
        with self._lock:
            episode, config = self.episode(number), self.tail.config
            if episode is None:
                return {}, {}
            if number not in self._worlds and len(episode.truth):
                self._worlds[number] = drawing.find_world(self.tail.header, config, episode)
            world, revision = self._worlds.get(number), str(number)
            figures = {
                "top": drawing.draw_episode_from_above(episode, config, world, at, revision),
                "wheels": drawing.draw_wheels(episode, at, revision),
                "lateness": drawing.draw_lateness(episode, at, revision),
            }
            return figures, drawing.read_values(episode, at)
