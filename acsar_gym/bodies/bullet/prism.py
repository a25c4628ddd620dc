"""Write a polygonal footprint as a mesh of upright convex prisms that PyBullet can read."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Iterator
from pathlib import Path

from acsar_gym.config.footprint import Outline, convex_pieces


@contextlib.contextmanager
def mesh(outline: Outline, low: float, high: float) -> Iterator[str]:
    """Write a temporary Wavefront file with a prism for each convex piece of an outline.

    PyBullet reads shapes of many corners from files only. It uses the convex hull of each object
    in a file, so each piece is an object, and notches stay open. Its hulls are 1 mm larger on
    every side. The file is deleted after the block.

    Args:
        outline: corners in the base frame [m].
        low: least height [m].
        high: largest height [m].

    Yields:
        Name of the file.
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
    """Wavefront line of a face."""
    return "f " + " ".join(map(str, corners))
