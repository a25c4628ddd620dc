"""What the control loop hands over, and the NumPy tables that are made of it.

An event holds rows of one or several tables, by the table's name. All rows of a control period of
the wire are one event, so that they are recorded together or dropped together. A table of pieces
of bytes gets a list of (stamp, bytes), of which two tables are made: when each piece passed and how
long it is, and all bytes in a row.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from acsar_gym.worlds.crowd import SEEN_NUMBERS

Table = NDArray[Any]
Rows = Mapping[str, Any]
"""A row of each of some tables, or a list of rows for `PIECE_TABLES`. It has few containers: the
garbage collector walks what waits in a queue, also in the control loop."""
NO_ACTION = np.full(2, np.nan, np.float32)
UNKNOWN_TRUTH = ((math.nan,) * 3, (math.nan,) * 2, math.nan)  # pose, twist and contact


class Began(NamedTuple):
    """A reset: an episode begins."""

    stamp: float
    wall: int
    """Wall clock at the same moment [ns since 1970]."""
    info: Mapping[str, Any]


Event = Began | Rows


def make_dtype(**formats: str) -> np.dtype[np.void]:
    """Make the type of a row of these columns. "3f8" is a column of three numbers."""
    return np.dtype(list(formats.items()))


# Structured types have the order of the fields of an event: `np.array(rows, kind)` encodes.
PIECES = make_dtype(stamp="f8", size="i8")
OCTETS, SINGLES, DOUBLES = map(np.dtype, ("u1", "f4", "f8"))
TABLES = {
    "ticks": make_dtype(
        exchange="i8",
        stamp="f8",
        pose="3f8",
        twist="2f8",
        speeds="4f8",
        angles="4f8",
        asked="2f8",
        sent="2f8",
        reason="i8",
        lateness="f8",
        feedback_age="f8",
        refused="i8",
    ),
    "exchanges": make_dtype(
        number="i8",
        stamp="f8",
        writes="i8",
        pieces="i8",
        lateness="f8",
        pose="3f8",
        twist="2f8",
        contact="f8",
    ),
    "sent": PIECES,
    "sent_bytes": OCTETS,
    "received": PIECES,
    "received_bytes": OCTETS,
    "steps": make_dtype(
        step="i8", stamp="f8", reward="f8", terminated="?", truncated="?", success="?"
    ),
    "observations": SINGLES,
    "actions": SINGLES,
    "scans": make_dtype(exchange="i8", stamp="f8"),
    "ranges": DOUBLES,
    "revolutions": make_dtype(exchange="i8", stamp="f8", size="i8"),
    "measurements": DOUBLES,
    "movers": make_dtype(exchange="i8", stamp="f8", hit="f8", intrusions="f8"),
    "mover_states": DOUBLES,
    "faults": PIECES,
    "faults_bytes": OCTETS,
    "clocks": make_dtype(stamp="f8", wall="i8"),
}
"""All tables of a recording by name. `exchanges` are the control periods of the wire, with the
ground truth at their ends. `ticks` are the robot's ticks after its reset. Their `reason` is a
`safety.rules.Reason`. Tables of plain numbers have one row for each row of the table before them:
`observations` and `actions` of each step (NaN for the reset), `ranges` of each scan, `mover_states`
of each control period. `measurements` (n, 3) are bearings [rad], distances [m] and times [s] of all
revolutions."""
PIECE_TABLES = ("sent", "received", "faults")
EMPTY_SHAPES = {
    "measurements": (0, 3),
    "mover_states": (0, 0, SEEN_NUMBERS),
    "actions": (0, 2),
    "observations": (0, 0),
    "ranges": (0, 0),
}
PARTS = {
    "pose": ("x", "y", "theta"),
    "twist": ("linear", "angular"),
    "speeds": ("speed_a", "speed_b", "speed_c", "speed_d"),
    "angles": ("angle_a", "angle_b", "angle_c", "angle_d"),
    "asked": ("asked_linear", "asked_angular"),
    "sent": ("sent_linear", "sent_angular"),
}
"""Names of the numbers of a column that has several."""


class Tables(dict[str, Table]):
    """Tables of an episode, or of a part of it, by name. A table that isn't there has no row."""

    def __missing__(self, name: str) -> Table:
        # Readers needn't ask whether a robot has a LiDAR or people around it.
        return np.zeros(EMPTY_SHAPES.get(name, 0), TABLES[name])

    def count(self, name: str) -> int:
        """Return the number of rows of a table."""
        return len(self[name])

    def split(self) -> Iterator[Tables]:
        """Yield the tables in parts of moderate size."""
        yield self

    @classmethod
    def of(cls, events: Iterable[Rows]) -> Tables:
        """Make tables of the rows of events. A table without a row is left out."""
        # One call of NumPy for each table, not for each row.
        rows: defaultdict[str, list[Any]] = defaultdict(list)
        for event in events:
            for name, row in event.items():
                rows[name] += row if name in PIECE_TABLES else [row]

        tables = cls()
        for name in (name for name in TABLES if rows[name]):
            if name in PIECE_TABLES:
                tables[name] = np.array([(stamp, len(data)) for stamp, data in rows[name]], PIECES)
                # All bytes in a row compress best, and their lengths are in the other table.
                data = b"".join([data for _, data in rows[name]])
                tables[f"{name}_bytes"] = np.frombuffer(data, OCTETS)
            # Each revolution has its own number of measurements.
            elif name == "measurements":
                tables[name] = np.concatenate([np.column_stack(columns) for columns in rows[name]])
            else:
                tables[name] = np.array(rows[name], TABLES[name])
        return tables


def split_columns(table: Table) -> dict[str, Table]:
    """Return the columns of a table by name. Those of several numbers are split as in `PARTS`."""
    columns: dict[str, Table] = {}
    for name in table.dtype.names or ():
        names = PARTS.get(name, (name,))
        # Columns that aren't contiguous would be copied again by each library.
        values = table[name].reshape(len(table), len(names)).T
        columns |= dict(zip(names, np.ascontiguousarray(values), strict=True))
    return columns
