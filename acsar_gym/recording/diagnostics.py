"""What /diagnostics tells once a second: lateness, safety, refused input, dropped ticks; faults."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from acsar_gym.config import RobotConfig
from acsar_gym.recording.events import Tick
from acsar_gym.recording.typesystem import header, make, packed

EVERY = 1.0
"""Time between two messages [s]."""
LATE = 0.001
"""A tick that ends more than this after its deadline is late [s]."""
OK, WARN, ERROR = 0, 1, 2
CALM = ("NONE", "LIMITS")
"""Reasons of the safety layer that are part of normal driving."""


class Diagnostics:
    """Sums up the ticks of a second.

    Attributes: `dropped`, what the recorder has dropped so far.

    Args:
        config: of the robot.
    """

    def __init__(self, config: RobotConfig) -> None:
        self.dropped = 0
        self._hardware = config.base_frame
        self.reset(0.0)

    def reset(self, stamp: float) -> None:
        """Begin an episode at this time of the link's clock [s]."""
        self._due = stamp + EVERY
        self._late: list[float] = []
        self._reasons: Counter[str] = Counter()

    def ticked(
        self, ticks: Sequence[Tick], time: Callable[[float], int]
    ) -> Iterator[tuple[float, bytes]]:
        """Add ticks; yields stamp [s] and message wherever a second is over."""
        for tick in ticks:
            self._late.append(math.nan if tick.lateness is None else tick.lateness)
            self._reasons[_name(tick.reason)] += 1
            if tick.stamp >= self._due - 1e-9:
                yield tick.stamp, self._message(time(tick.stamp), self._told(tick))
                self.reset(tick.stamp)

    def fault(self, text: str, time: int) -> bytes:
        """Pack an error that stopped the robot."""
        return self._message(time, [self._status("fault", ERROR, text, {})])

    def _told(self, newest: Tick) -> list[Any]:
        """The states of loop, safety, wire and recorder."""
        late = np.array(self._late)
        timed = late[~np.isnan(late)]
        over = int((timed > LATE).sum())
        loop: dict[str, float] = {"ticks": len(late), "late": over}
        if len(timed):
            p50, p99 = np.percentile(timed, (50, 99)) * 1e3
            loop |= {"p50_ms": round(p50, 3), "p99_ms": round(p99, 3)}
            loop["worst_ms"] = round(float(timed.max()) * 1e3, 3)
        stops = [name for name in self._reasons if name not in CALM]
        reason = _name(newest.reason)
        wire = {"feedback_age_ms": round(newest.feedback_age * 1e3, 3), "refused": newest.refused}
        lost = {"dropped": self.dropped}
        return [
            self._status("control loop", WARN if over else OK, f"{over} late ticks", loop),
            self._status("safety", WARN if stops else OK, reason, dict(self._reasons)),
            self._status("wire", OK, f"{newest.refused} parts refused", wire),
            self._status("recorder", WARN if self.dropped else OK, f"{self.dropped} dropped", lost),
        ]

    def _status(self, name: str, level: int, text: str, values: Mapping[str, Any]) -> Any:
        """A diagnostic_msgs/DiagnosticStatus."""
        pairs = [
            make("diagnostic_msgs/msg/KeyValue", key=key, value=str(value))
            for key, value in values.items()
        ]
        return make(
            "diagnostic_msgs/msg/DiagnosticStatus",
            level=level,
            name=f"acsar: {name}",
            message=text,
            hardware_id=self._hardware,
            values=pairs,
        )

    def _message(self, time: int, states: list[Any]) -> bytes:
        """Pack diagnostic_msgs/DiagnosticArray."""
        return packed(
            make("diagnostic_msgs/msg/DiagnosticArray", header=header(time), status=states)
        )


def _name(reason: int) -> str:
    """The name of a reason; numbers without one stay numbers."""
    return str(getattr(reason, "name", reason))
