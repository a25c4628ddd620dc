"""What the control loop hands over, and the NumPy tables that are made of it.

The fields of a table are those of its event, in the same order, so that `np.array` makes a table of
a list of events. Bytes of the wire are two tables: when each piece passed and how long it is, and
all bytes in a row.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from acsar_gym.protocol import Speeds
from acsar_gym.truth import GroundTruth

Tables = Mapping[str, NDArray[Any]]
Pair = tuple[float, float]
Pieces = tuple[tuple[float, bytes], ...]  # with the times at which they were sent or arrived [s]

UNKNOWN_TRUTH = ((math.nan,) * 3, (math.nan,) * 2, math.nan)
NO_ACTION = np.full(2, np.nan, np.float32)


class Began(NamedTuple):
    """A reset: an episode begins."""

    stamp: float
    wall: int
    """Wall clock at the same moment [ns since 1970]."""
    info: Mapping[str, Any]


class Exchange(NamedTuple):
    """One control period of the wire."""

    number: int
    stamp: float
    sent: Pieces
    received: Pieces
    lateness: float | None
    truth: GroundTruth | None


class Written(NamedTuple):
    """Bytes that were sent after the last control period of a link, such as the stop at its end."""

    sent: Pieces


class Tick(NamedTuple):
    """One tick of the robot, after the exchange of the same number."""

    exchange: int
    stamp: float
    pose: tuple[float, float, float]
    twist: Pair
    speeds: Speeds
    angles: Speeds
    asked: Pair
    sent: Pair
    reason: int
    """A `safety.rules.Reason`, or a number."""
    lateness: float | None
    feedback_age: float
    refused: int


class Scanned(NamedTuple):
    """A scan was read."""

    exchange: int
    stamp: float
    """When it was read. Its ranges are measured from where the robot was at that time [s]."""
    ranges: Any
    """(rays,) [m]."""
    revolution: Any
    """The `Revolution` of which it was made."""


class Moved(NamedTuple):
    """What moved around a simulated robot, at the end of an exchange."""

    exchange: int
    stamp: float
    hit: float
    intrusions: float
    movers: NDArray[np.float64]
    """(movers, 5), see `Crowd.copy_states`."""


class Stepped(NamedTuple):
    """A step of the env, or its reset, which has no action."""

    step: int
    stamp: float
    observation: Any
    action: Any
    reward: float
    terminated: bool
    truncated: bool
    success: bool = False


class Fault(NamedTuple):
    """Something that stopped the robot."""

    stamp: float
    text: str


class Clock(NamedTuple):
    """Wall clock and link's clock at the same moment."""

    stamp: float
    wall: int


Event = Began | Exchange | Written | Tick | Scanned | Moved | Stepped | Fault | Clock
"""What the control loop hands over; making one takes less than a microsecond."""


def make_dtype(**formats: str) -> np.dtype[np.void]:
    """Make the type of a row of these columns; "3f8" is a column of three numbers."""
    return np.dtype(list(formats.items()))


TICKS = make_dtype(
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
)
EXCHANGES = make_dtype(
    number="i8",
    stamp="f8",
    writes="i8",
    pieces="i8",
    lateness="f8",
    pose="3f8",
    twist="2f8",
    contact="f8",
)
PIECES = make_dtype(stamp="f8", size="i8")
CLOCKS = make_dtype(stamp="f8", wall="i8")
STEPS = make_dtype(step="i8", stamp="f8", reward="f8", terminated="?", truncated="?", success="?")
SCANS = make_dtype(exchange="i8", stamp="f8")
REVOLUTIONS = make_dtype(exchange="i8", stamp="f8", size="i8")
MOVERS = make_dtype(exchange="i8", stamp="f8", hit="f8", intrusions="f8")
OCTETS, SINGLES, DOUBLES = map(np.dtype, ("u1", "f4", "f8"))
TABLES = {
    "ticks": TICKS,
    "exchanges": EXCHANGES,
    "sent": PIECES,
    "sent_bytes": OCTETS,
    "received": PIECES,
    "received_bytes": OCTETS,
    "steps": STEPS,
    "observations": SINGLES,
    "actions": SINGLES,
    "scans": SCANS,
    "ranges": DOUBLES,
    "revolutions": REVOLUTIONS,
    "measurements": DOUBLES,
    "movers": MOVERS,
    "mover_states": DOUBLES,
    "faults": PIECES,
    "faults_bytes": OCTETS,
    "clocks": CLOCKS,
}
"""All tables of a recording by name. Those of plain numbers have one row for each row of the table
before them: `observations` and `actions` of each step (NaN for the reset), `ranges` of each scan,
`mover_states` of each control period. `measurements` (n, 3) are bearings [rad], distances [m] and
times [s] of all revolutions."""


class Tabulator:
    """Makes tables of the events of an episode, some events at a time."""

    def __init__(self) -> None:
        self._revolution: Any = None

    def make_tables(self, events: Iterable[Event]) -> dict[str, NDArray[Any]]:
        """Make the tables of some events; those without a row are left out."""
        groups: defaultdict[type, list[Any]] = defaultdict(list)
        sent: list[tuple[float, bytes]] = []
        for event in events:
            groups[type(event)].append(event)
            if isinstance(event, Exchange | Written):
                sent += event.sent

        exchanges = groups[Exchange]
        faults = [(fault.stamp, fault.text.encode()) for fault in groups[Fault]]
        steps = groups[Stepped]
        actions = [NO_ACTION if step.action is None else step.action for step in steps]
        tables = {
            "ticks": np.array(groups[Tick], TICKS),
            "exchanges": np.array([_make_row(exchange) for exchange in exchanges], EXCHANGES),
            **_make_pieces("sent", sent),
            **_make_pieces("received", [p for exchange in exchanges for p in exchange.received]),
            "steps": np.array([(step.step, step.stamp, *step[4:]) for step in steps], STEPS),
            "observations": np.array([step.observation for step in steps], SINGLES),
            "actions": np.array(actions, SINGLES),
            **self._make_scans(groups[Scanned]),
            "movers": np.array([moved[:4] for moved in groups[Moved]], MOVERS),
            "mover_states": np.array([moved.movers for moved in groups[Moved]], DOUBLES),
            **_make_pieces("faults", faults),
            "clocks": np.array(groups[Clock], CLOCKS),
        }
        return {name: table for name, table in tables.items() if len(table)}

    def _make_scans(self, scans: list[Scanned]) -> dict[str, NDArray[Any]]:
        """Scans, and each new revolution of which they are made."""
        revolutions: list[tuple[int, float, int]] = []
        measured: list[NDArray[np.float64]] = []
        for scan in scans:
            if scan.revolution is not self._revolution:
                self._revolution = scan.revolution
                *columns, ended = scan.revolution
                measured.append(np.column_stack(columns))
                revolutions.append((scan.exchange, ended, len(measured[-1])))
        return {
            "scans": np.array([scan[:2] for scan in scans], SCANS),
            "ranges": np.array([scan.ranges for scan in scans], DOUBLES),
            "revolutions": np.array(revolutions, REVOLUTIONS),
            "measurements": np.concatenate([np.zeros((0, 3)), *measured]),
        }


def _make_row(exchange: Exchange) -> tuple[Any, ...]:
    truth = exchange.truth
    columns = UNKNOWN_TRUTH if truth is None else (truth.pose, truth.twist, truth.contact)
    counts = (len(exchange.sent), len(exchange.received))
    return (exchange.number, exchange.stamp, *counts, exchange.lateness, *columns)


def _make_pieces(name: str, pieces: list[tuple[float, bytes]]) -> dict[str, NDArray[Any]]:
    """The two tables of pieces of bytes."""
    rows = [(stamp, len(data)) for stamp, data in pieces]
    data = b"".join([data for _, data in pieces])
    return {name: np.array(rows, PIECES), f"{name}_bytes": np.frombuffer(data, OCTETS)}
