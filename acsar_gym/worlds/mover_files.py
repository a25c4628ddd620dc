"""Movers in the project's own files of worlds.

A mover walks along points at a speed, is at points at some times, or has the pieces of `Mover`:

    movers:
      - {name: nurse, points: [[0.0, 2.0], [6.0, 2.0]], speed: 1.2, pauses: 1.0}
      - {radius: 0.4, times: [0.0, 3.0], points: [[1.0, 0.0], [1.0, 3.0]], smooth: true}
      - {duration: 4.0, pieces: [[0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.5, 0.0]], repeat: back}
      - {points: [[3.0, -1.0], [3.0, 1.0]], speed: 1.0, reacts: true, sees_robot: false}
"""

from __future__ import annotations

from functools import partial
from typing import Any, Literal

from pydantic import Field

from acsar_gym.config.section import Section
from acsar_gym.errors import ConfigError, WorldError
from acsar_gym.worlds.movers import Mover, Repeat, follow_keys, walk

FORMS: tuple[tuple[Any, set[str], set[str]], ...] = (
    (walk, {"points"}, {"speed", "pauses"}),
    (follow_keys, {"points", "times"}, {"smooth"}),
    (partial(Mover, repeat=Repeat.LOOP), {"pieces", "duration"}, set()),
)
"""What makes a mover, the fields that it needs, and those that it may have."""
MOTION_FIELDS = {field for _, needed, optional in FORMS for field in needed | optional}


class MoverFile(Section):
    """A mover of a file [m, s, m/s]. A field that is left out has the default of its function."""

    name: str = Field("", max_length=200)
    points: Any = None
    speed: Any = None
    pauses: Any = None
    times: Any = None
    smooth: bool | None = None
    pieces: Any = None
    duration: float | None = None
    repeat: Literal["stop", "back", "loop"] | None = None
    radius: float | None = None
    phase: float | None = None
    spread: float | None = None
    reacts: bool | None = None
    sees_robot: bool | None = None

    def make(self) -> Mover:
        """Make the mover.

        Raises:
            WorldError: The fields contradict each other, or can't be used.
        """
        # Fields that are left out have the defaults of the function that makes the mover.
        options = self.model_dump(exclude_none=True)
        if self.repeat is not None:
            options["repeat"] = Repeat[self.repeat.upper()]
        # Which form it is follows from the fields. Other combinations contradict each other.
        motion = options.keys() & MOTION_FIELDS
        for maker, needed, optional in FORMS:
            if needed <= motion <= needed | optional:
                mover: Mover = maker(**options)
                return mover
        raise WorldError(
            "needs points and a speed, points and times, or pieces and a duration; has "
            f"{', '.join(sorted(motion)) or 'none of these'}"
        )


def parse_movers(entries: list[Any]) -> tuple[Mover, ...]:
    """Make the movers of a file's list. Raises WorldError that names the one that can't be used."""
    movers = []
    for number, entry in enumerate(entries):
        try:
            movers.append(MoverFile.model_validate(entry).make())
        except ConfigError as error:
            raise WorldError(f"movers.{number}: {error}") from error
    return tuple(movers)


def format_mover(mover: Mover) -> dict[str, Any]:
    """Format a mover for a file, to the bit."""
    return {
        "name": mover.name,
        "radius": float(mover.radius),
        "repeat": mover.repeat.name.lower(),
        "phase": float(mover.phase),
        "spread": float(mover.spread),
        "reacts": bool(mover.reacts),
        "sees_robot": bool(mover.sees_robot),
        "duration": float(mover.duration),
        "pieces": mover.pieces.tolist(),
    }
