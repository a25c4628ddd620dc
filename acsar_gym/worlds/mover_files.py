"""Movers in the project's own files of worlds.

A mover walks along points at a speed, is at points at some times, or has the pieces of `Mover`:

    movers:
      - {name: nurse, points: [[0.0, 2.0], [6.0, 2.0]], speed: 1.2, pauses: 1.0}
      - {radius: 0.4, times: [0.0, 3.0], points: [[1.0, 0.0], [1.0, 3.0]], smooth: true}
      - {duration: 4.0, pieces: [[0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.5, 0.0]], repeat: back}
      - {points: [[3.0, -1.0], [3.0, 1.0]], speed: 1.0, reacts: true, sees_robot: false}
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field

from acsar_gym.config.section import Section
from acsar_gym.errors import ConfigError, WorldError
from acsar_gym.worlds.movers import (
    MAX_PIECES,
    PERSON_RADIUS,
    PIECE_NUMBERS,
    WALKING_SPEED,
    Mover,
    Repeat,
    follow_keys,
    walk,
)
from acsar_gym.worlds.world import MAX_COORDINATE

Number = Annotated[float, Field(strict=True)]
Coordinate = Annotated[float, Field(strict=True, ge=-MAX_COORDINATE, le=MAX_COORDINATE)]
Row = Annotated[list[Number], Field(min_length=PIECE_NUMBERS, max_length=PIECE_NUMBERS)]
FORMS = "needs points and a speed, points and times, or pieces and a duration"


class MoverFile(Section):
    """A mover of a file [m, s, m/s]."""

    name: str = Field("", max_length=200)
    points: list[tuple[Coordinate, Coordinate]] | None = Field(None, max_length=MAX_PIECES)
    speed: Number | list[Number] | None = None
    """Of all lines between points, or of each."""
    pauses: Number | list[Number] = 0.0
    """At all points, or at each."""
    times: list[Number] | None = Field(None, max_length=MAX_PIECES)
    smooth: bool = False
    """Whether the points at these times lie on a spline, as those of Gazebo."""
    tension: Number = 0.0
    """Of that spline, 0 to 1."""
    pieces: list[Row] | None = Field(None, max_length=MAX_PIECES)
    duration: Number | None = None
    repeat: Literal["stop", "back", "loop"] | None = None
    """At the end: where points are walked along, it is "back" if nothing is said, else "loop"."""
    radius: Number = PERSON_RADIUS
    phase: Number = 0.0
    spread: Number = 0.0
    reacts: bool = False
    sees_robot: bool = True

    def make(self) -> Mover:
        """Make the mover; WorldError for what can't be used."""
        walks = self.points is not None and self.times is None and self.pieces is None
        default = Repeat.BACK if walks else Repeat.LOOP
        common: dict[str, Any] = {
            "name": self.name,
            "radius": self.radius,
            "repeat": default if self.repeat is None else Repeat[self.repeat.upper()],
            "phase": self.phase,
            "spread": self.spread,
            "reacts": self.reacts,
            "sees_robot": self.sees_robot,
        }
        given = {field for field in self.model_fields_set if getattr(self, field) is not None}
        given &= {"points", "speed", "pauses", "times", "smooth", "tension", "pieces", "duration"}
        if walks and given <= {"points", "speed", "pauses"}:
            speed = WALKING_SPEED if self.speed is None else self.speed
            return walk(self.points or [], speed, pauses=self.pauses, **common)
        if {"points", "times"} <= given <= {"points", "times", "smooth", "tension"}:
            common |= {"smooth": self.smooth, "tension": self.tension}
            return follow_keys(self.times or [], self.points or [], **common)
        if given == {"pieces", "duration"}:
            return Mover(self.pieces, self.duration, **common)  # type: ignore[arg-type]
        raise WorldError(f"{FORMS}; has {', '.join(sorted(given)) or 'none of these'}")


def parse_movers(entries: list[Any]) -> tuple[Mover, ...]:
    """Make the movers of a file's list; WorldError that names the one that can't be used."""
    movers = []
    for number, entry in enumerate(entries):
        try:
            movers.append(MoverFile.model_validate(entry).make())
        except (ConfigError, WorldError) as error:
            raise WorldError(f"movers.{number}: {error}") from error
    return tuple(movers)


def format_mover(mover: Mover) -> dict[str, Any]:
    """Format a mover for a file, to the bit."""
    fields: dict[str, Any] = {
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
    return fields
