"""Makes blocks of events: tables of about half a second, with what is known of their episode."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from acsar_gym.recording.events import (
    OCTETS,
    PIECE_TABLES,
    PIECES,
    TABLES,
    Began,
    Event,
    Rows,
    Tables,
)
from acsar_gym.recording.messages import to_plain_json

EPISODE_GAP = 1_000_000  # time between two episodes whose clocks both begin at zero [ns]


class Sink:
    """Gets the blocks of a recorder, in its own thread. An error ends what this sink gets."""

    def write(self, head: Mapping[str, Any], tables: Tables) -> None:
        """Take a block.

        Args:
            head: Fields of a `blocks.Head`. Those of an episode begin with the clock at its reset.
            tables: Its tables, of whole control periods.
        """

    def flush(self) -> None:
        """Make what was written safe. Called about twice a second."""

    def close(self, dropped: int) -> None:
        """Finish. `dropped` is the number of events that never became blocks."""

    def abandon(self) -> None:
        """Give up after an error."""


class Tabulator:
    """Makes blocks of the events of a drive, and hands them to sinks.

    Args:
        sinks: What gets the blocks.
    """

    def __init__(self, sinks: Sequence[Sink]) -> None:
        self._sinks = sinks
        self._waiting: list[Rows] = []
        self._opening: dict[str, Any] = {}
        self._newest = -1

    def add(self, events: Iterable[Event], *, is_last: bool = False) -> None:
        """Take events, and hand on the blocks that are complete.

        The newest control period waits for more events, unless these are the last events.
        """
        for event in events:
            if not isinstance(event, Began):
                self._waiting.append(event)
                continue
            self._write_block(len(self._waiting))
            self._begin_episode(event)
            self._waiting = [{"clocks": (event.stamp, event.wall)}]
            self._write_block(1)

        count = len(self._waiting)
        periods = [n for n, rows in enumerate(self._waiting) if "exchanges" in rows]
        is_waiting = periods and periods[-1] > 0 and not is_last
        self._write_block(periods[-1] if is_waiting else count)

    def _begin_episode(self, began: Began) -> None:
        """Note the opening of an episode. Its clock may have started again at zero."""
        start = round(began.stamp * 1e9)
        offset = self._opening.get("offset", began.wall - start)
        if start + offset <= self._newest:
            offset = self._newest + EPISODE_GAP - start
        self._opening = {
            "episode": self._opening.get("episode", -1) + 1,
            "start": began.stamp,
            "offset": offset,
            "info": to_plain_json(dict(began.info)),
        }

    def _write_block(self, count: int) -> None:
        """Make a block of the oldest events, if there are any."""
        tables = stack_rows(self._waiting[:count])
        self._waiting = self._waiting[count:]
        if not tables or not self._opening:
            return

        head = dict(self._opening)
        if "exchanges" in tables:
            numbers = tables["exchanges"]["number"]
            head["periods"] = (int(numbers[0]), int(numbers[-1]))
        if "steps" in tables:
            head["outcome"] = tables["steps"][-1].tolist()[3:]
        newest = max(table["stamp"].max() for table in tables.values() if table.dtype.names)
        self._newest = max(self._newest, round(newest * 1e9) + head["offset"])
        for sink in self._sinks:
            sink.write(head, tables)


def stack_rows(events: Iterable[Rows]) -> Tables:
    """Make tables of the rows of events. A table without a row is left out."""
    rows: defaultdict[str, list[Any]] = defaultdict(list)
    for event in events:
        for name, row in event.items():
            if name in PIECE_TABLES:
                rows[name] += row
            else:
                rows[name].append(row)

    tables = Tables()
    for name in (name for name in TABLES if rows[name]):
        if name in PIECE_TABLES:
            tables[name] = np.array([(stamp, len(data)) for stamp, data in rows[name]], PIECES)
            data = b"".join([data for _, data in rows[name]])
            tables[f"{name}_bytes"] = np.frombuffer(data, OCTETS)
        elif name == "measurements":
            tables[name] = np.concatenate([np.column_stack(columns) for columns in rows[name]])
        else:
            tables[name] = np.array(rows[name], TABLES[name])
    return tables
