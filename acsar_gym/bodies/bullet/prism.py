"""A footprint that is a polygon, as a mesh of upright convex prisms that PyBullet reads."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Iterator
from pathlib import Path

from acsar_gym.config.footprint import Outline, convex_pieces


@contextlib.contextmanager
def mesh(outline: Outline, low: float, high: float) -> Iterator[str]:
    """The name of a Wavefront file with a prism from `low` to `high` [m] for each convex piece.

    PyBullet takes shapes of many corners from files alone, and each object of a file for its own
    convex hull, so that notches stay open. Its hulls are 1 mm larger on every side. The file is
    gone after the block.
    """
    with tempfile.TemporaryDirectory(prefix="acsar_gym_") as folder:
        file = Path(folder) / "footprint.obj"
        file.write_text("\n".join(_lines(convex_pieces(outline), low, high)), encoding="ascii")
        yield str(file)


def _lines(pieces: list[Outline], low: float, high: float) -> Iterator[str]:
    """Wavefront lines: corners of both ends, then the faces, whose corners count from 1."""
    first = 1
    for number, piece in enumerate(pieces):
        count = len(piece)
        yield f"o piece{number}"
        for z in (low, high):
            yield from (f"v {x!r} {y!r} {z!r}" for x, y in piece)
        yield _face(range(first + count, first + 2 * count))
        yield _face(reversed(range(first, first + count)))
        for n in range(count):
            one, other = first + n, first + (n + 1) % count
            yield _face((one, other, other + count, one + count))
        first += 2 * count


def _face(corners: range | Iterator[int] | tuple[int, ...]) -> str:
    return "f " + " ".join(map(str, corners))
