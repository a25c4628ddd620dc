"""One episode of a run, as far as it is known; grows while it is being recorded."""

from __future__ import annotations

from typing import Any

import numpy as np

from acsar_gym.config import RobotConfig
from acsar_gym.dashboard.columns import Columns, Floats
from acsar_gym.errors import ConfigError
from acsar_gym.recording import topics
from acsar_gym.recording.parts import Part
from acsar_gym.recording.wire_log import WireLog

TICK = {name: place for place, name in enumerate(topics.TICK_COLUMNS)}
"""Columns of `Episode.ticks` by name; times are since the reset."""
MOST = 1e6
"""Largest coordinate of goal and start, either sign [m]."""


class Episode:
    """What was recorded from a reset to the next one. Times are since the reset [s].

    Attributes: `ticks`, the columns of `topics.TICK_COLUMNS`; `truth`, (m, 4) time, x [m], y [m],
    theta [rad] in the frame of the world, NaN on hardware; `sent`, (k, 5) time and the wheel
    speeds of each command on the wire [rad/s]; `scans`, (s, 1) times; `ranges`, (s, rays) [m],
    None without a LiDAR; `faults`, (time, text).

    Args:
        part: what was read of it; it is emptied here.
        config: of the robot.
    """

    def __init__(self, part: Part, config: RobotConfig) -> None:
        self.info: dict[str, Any] = part.told["info"]
        self.ticks = Columns(len(topics.TICK_COLUMNS))
        self.truth = Columns(4)
        self.sent = Columns(5)
        self.scans = Columns(1)
        self.ranges: Columns | None = None
        self.faults: list[tuple[float, str]] = []
        self._part = part
        self._config = config
        self._start = part.start

    def drain(self) -> bool:
        """Take what was read since the last call; returns whether there was anything.

        Raises:
            ConfigError: the recording is damaged.
        """
        sizes = self._sizes()
        self._ticked()
        self._sent()
        self._scanned()
        return self._sizes() != sizes

    def fault(self, time: int, text: str) -> None:
        """Take an error that ended the episode, at a time of the file [ns]."""
        self.faults.append(((time - self._part.offset) / 1e9 - self._start, text))

    @property
    def end(self) -> float:
        """Time of the newest tick or command [s]."""
        newest = [rows.rows[-1, place] for rows, place in self._clocks() if len(rows)]
        return max(0.0, *map(float, newest)) if newest else 0.0

    @property
    def is_simulated(self) -> bool:
        """Whether the truth is known."""
        return bool(len(self.truth)) and bool(np.isfinite(self.truth.rows[-1]).all())

    @property
    def goal(self) -> tuple[float, float] | None:
        """Goal in the odometry frame [m]; None where none is known."""
        found = _numbers(self.info.get("goal"), 2)
        return None if found is None else (found[0], found[1])

    @property
    def start(self) -> tuple[float, float, float]:
        """Start in the frame of the world [m, m, rad]."""
        x, y, theta = _numbers(self.info.get("start"), 3) or (0.0, 0.0, 0.0)
        return x, y, theta

    def column(self, name: str) -> Floats:
        """A column of the ticks, (n,)."""
        found: Floats = self.ticks.rows[:, TICK[name]]
        return found

    def place(self, time: float) -> int:
        """Number of the newest tick at a time [s]; -1 before the first one."""
        return int(np.searchsorted(self.column("stamp"), time + 1e-9, "right")) - 1

    def asked(self, ticks: slice) -> Floats:
        """Wheel speeds that were asked for in some ticks, (n, 4) [rad/s]; NaN where none were."""
        rows = self.ticks.rows[ticks]
        linear, angular = rows[:, TICK["asked_linear"]], rows[:, TICK["asked_angular"]]
        left_radius, right_radius = self._config.wheel_radii
        turn = angular * self._config.effective_separation / 2.0
        right, left = (linear + turn) / right_radius, (linear - turn) / left_radius
        return np.stack([right, left, left, right], axis=1)

    def _clocks(self) -> tuple[tuple[Columns, int], ...]:
        return (self.ticks, TICK["stamp"]), (self.sent, 0)

    def _sizes(self) -> tuple[int, ...]:
        return len(self.ticks), len(self.truth), len(self.sent), len(self.scans), len(self.faults)

    def _ticked(self) -> None:
        """Take the tables."""
        ticks = self._table(topics.TICKS, "stamp")
        _check(self.ticks, ticks[:, TICK["stamp"]], TICK["stamp"])
        self.ticks.add(ticks)
        exchanges = self._table(topics.EXCHANGES, "stamp")
        truth = exchanges[:, [1, 5, 6, 7]]
        _check(self.truth, truth[:, 0], 0)
        self.truth.add(truth)

    def _table(self, topic: topics.Topic, clock: str) -> Floats:
        """The rows of a table since the last call."""
        data = self._part.tables[topic.name]
        rows = np.frombuffer(bytes(data), "<f8").reshape(-1, len(topic.columns)).copy()
        data.clear()
        rows[:, topic.columns.index(clock)] -= self._start
        return rows

    def _sent(self) -> None:
        """Take the commands on the wire."""
        part = self._part
        when = np.array([each - part.offset for each in part.sent_times]) / 1e9 - self._start
        log = WireLog(when, tuple(part.sent), np.zeros(0), ())
        part.sent_times, part.sent = [], []
        stamps, speeds = log.commands(self._config)
        stamps = np.maximum.accumulate(stamps) if len(stamps) else stamps
        self.sent.add(np.column_stack([stamps, speeds]))

    def _scanned(self) -> None:
        """Take the scans: exchange, stamp and ranges."""
        scans, self._part.scans = self._part.scans, []
        for row in (np.frombuffer(data, "<f8") for data in scans):
            rays = len(row) - 2
            if self.ranges is None and rays > 0:
                self.ranges = Columns(rays, np.float32)
            if self.ranges is None or self.ranges.rows.shape[1] != rays:
                raise ConfigError("is damaged: scans of several lengths")
            stamp = np.array([row[1] - self._start])
            _check(self.scans, stamp, 0)
            self.scans.add(stamp[:, None])
            self.ranges.add(row[None, 2:].astype(np.float32))


def _numbers(told: Any, count: int) -> tuple[float, ...] | None:
    """So many numbers of moderate size; None for anything else that a file may say."""
    try:
        found = tuple(map(float, told))
    except (TypeError, ValueError, OverflowError):
        return None
    return found if len(found) == count and all(abs(one) < MOST for one in found) else None


def _check(known: Columns, stamps: Floats, place: int) -> None:
    """Raise ConfigError for times that are no numbers, or go backwards."""
    before = known.rows[-1:, place]
    if not (np.isfinite(stamps).all() and (np.diff(np.r_[before, stamps]) >= 0.0).all()):
        raise ConfigError("is damaged: its times go backwards")
