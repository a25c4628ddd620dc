"""Rows of numbers that grow at the end, and fewer points for long lines."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
FIRST = 16
"""Rows for which there is room at first."""


class Columns:
    """A table that grows; adding rows takes the same time however many there are.

    Args:
        width: numbers in a row.
        kind: of the numbers.
    """

    def __init__(self, width: int, kind: Any = np.float64) -> None:
        self._data = np.zeros((FIRST, width), kind)
        self._size = 0

    def __len__(self) -> int:
        return self._size

    @property
    def rows(self) -> NDArray[Any]:
        """All rows, (n, width); they stay as they are while others are added."""
        return self._data[: self._size]

    def add(self, rows: NDArray[Any]) -> None:
        """Add rows, (k, width)."""
        size = self._size + len(rows)
        if size > len(self._data):
            grown = np.zeros(
                (max(size, 2 * len(self._data)), self._data.shape[1]), self._data.dtype
            )
            grown[: self._size] = self.rows
            self._data = grown
        self._data[self._size : size] = rows
        self._size = size


def outline(values: Floats, most: int) -> NDArray[np.intp]:
    """Choose points of a line that is drawn, so that no peak is lost.

    Args:
        values: (n,) of the line; NaN is a gap.
        most: points at most.

    Returns:
        Their numbers, ascending: the least and the largest one of each of `most` / 2 stretches.
    """
    if len(values) <= most:
        return np.arange(len(values))
    edges = np.linspace(0, len(values), most // 2 + 1).astype(np.intp)[:-1]
    size = int(np.diff(edges).max()) + 1
    places = np.minimum(
        edges[:, None] + np.arange(size), np.r_[edges[1:], len(values)][:, None] - 1
    )
    found = values[places]
    known = ~np.isnan(found)
    low = np.where(known, found, np.inf).argmin(axis=1)
    high = np.where(known, found, -np.inf).argmax(axis=1)
    rows = np.arange(len(edges))
    return np.unique(np.concatenate([places[rows, low], places[rows, high]]))


def evenly(count: int, most: int) -> NDArray[np.intp]:
    """Choose at most `most` of `count` points, the first and the last one among them."""
    if count <= most:
        return np.arange(count)
    return np.unique(np.linspace(0, count - 1, most).astype(np.intp))
