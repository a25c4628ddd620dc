"""One run that is shown: its recording, where it stands, and how to stop it."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from acsar_gym.dashboard import charts, stopping, top_view
from acsar_gym.dashboard.episodes import Episode
from acsar_gym.dashboard.readings import readings
from acsar_gym.dashboard.stopping import Stop
from acsar_gym.dashboard.surroundings import world_of
from acsar_gym.dashboard.tail import QUIET, Tail
from acsar_gym.errors import ConfigError
from acsar_gym.worlds import World

LIVE, STOPPED, ENDED, RECORDED, BROKEN = "live", "stopped", "ended", "recorded", "broken"


@dataclass(frozen=True)
class Frame:
    """What the page shows at one time.

    Attributes: `figures`, of plotly: top, wheels, lateness; `readings`, see `readings.readings`.
    """

    figures: dict[str, Any]
    readings: dict[str, str]


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
        self.tail = Tail(path)
        self.problem = ""
        self.stopped: Stop | None = None
        self.revision = 1
        self._lock, self._stopping = threading.Lock(), threading.Lock()
        self._worlds: dict[int, World | None] = {}
        self._stopped_in = 0
        self._was_live = self._has_grown()
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
            self._was_live = self._was_live or self._has_grown()
            return self.revision

    def _has_grown(self) -> bool:
        """Whether a process on this computer is writing it."""
        return self.tail.is_open and self.tail.age < QUIET

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
        return self.is_live and stopping.can_stop(self.tail.process)

    def stop(self) -> Stop:
        """Stop the robot, and wait until its program says so; several at once have to queue."""
        with self._stopping:
            before, newest = self.stopped, len(self.tail.episodes)
            found = stopping.stop(self.tail.process)
            if found.state == "nobody" and before is not None and before.state == "stopped":
                return before  # a second click, while the program that was stopped ends
            self._stopped_in, self.stopped = newest, found
            return found

    def episode(self, number: int) -> Episode | None:
        """Return an episode; the newest one for a number that there isn't."""
        found = self.tail.episodes
        if not found:
            return None
        return found[number] if 0 <= number < len(found) else found[-1]

    def frame(self, number: int, time: float) -> Frame:
        """Draw an episode at a time since its reset [s]."""
        with self._lock:
            episode = self.episode(number)
            if episode is None:
                return Frame({}, {})
            revision = str(number)
            config = self.tail.config
            figures = {
                "top": top_view.figure(
                    episode, config, self._world(number, episode), time, revision
                ),
                "wheels": charts.wheels(episode, time, revision),
                "lateness": charts.lateness(episode, time, revision),
            }
            return Frame(figures, readings(episode, time))

    def _world(self, number: int, episode: Episode) -> World | None:
        """The world of an episode, made once; None where it isn't known."""
        if number not in self._worlds:
            if not len(episode.truth):
                return None
            self._worlds[number] = world_of(self.tail.header, self.tail.config, episode)
        return self._worlds[number]
