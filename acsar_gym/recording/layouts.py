"""ROS 2 messages of fixed size in CDR, packed by the column instead of one by one.

A message whose strings and lists have a fixed length has each of its numbers at a fixed place. So
many messages are one numpy array with one row each, which costs about as much as one message.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

LITTLE_ENDIAN = b"\x00\x01\x00\x00"
"""What a CDR message begins with; alignment counts from behind it."""
SIZES = {"i1": 1, "u1": 1, "i4": 4, "u4": 4, "f4": 4, "f8": 8}
NANOSECONDS = 1_000_000_000


class Layout:
    """The fields of one kind of message, in the order of its definition.

    Each method adds the next field and returns the layout. `packed` then makes messages.
    """

    def __init__(self) -> None:
        self._names: list[str] = []
        self._formats: list[Any] = []
        self._offsets: list[int] = []
        self._fixed: dict[str, Any] = {}
        self._size = 0

    def number(self, kind: str, name: str, fixed: float | None = None) -> Layout:
        """Add a number of `kind` (a key of SIZES), with the same value in all messages if given."""
        self._place(name, f"<{kind}", SIZES[kind], SIZES[kind])
        if fixed is not None:
            self._fixed[name] = fixed
        return self

    def numbers(self, kind: str, name: str, count: int) -> Layout:
        """Add an array of `count` numbers; in a row it is of shape (count,)."""
        if count:
            self._place(name, (f"<{kind}", (count,)), SIZES[kind], SIZES[kind] * count)
        return self

    def sequence(self, kind: str, name: str, count: int) -> Layout:
        """Add a list of `count` numbers, which begins with its length."""
        self.number("u4", f"{name}.length", count)
        return self.numbers(kind, name, count)

    def text(self, name: str, text: str) -> Layout:
        """Add a string that is the same in all messages."""
        data = text.encode() + b"\0"
        self.number("u4", f"{name}.length", len(data))
        self._place(name, f"S{len(data)}", 1, len(data))
        self._fixed[name] = data
        return self

    def texts(self, name: str, texts: tuple[str, ...]) -> Layout:
        """Add a list of strings that are the same in all messages."""
        self.number("u4", f"{name}.length", len(texts))
        for number, text in enumerate(texts):
            self.text(f"{name}.{number}", text)
        return self

    def header(self, frame: str) -> Layout:
        """Add a std_msgs/Header with fields `sec` and `nanosec`."""
        return self.number("i4", "sec").number("u4", "nanosec").text("frame", frame)

    def _place(self, name: str, form: Any, alignment: int, size: int) -> None:
        """Put a field at the next multiple of its alignment."""
        self._size += -self._size % alignment
        self._names.append(name)
        self._formats.append(form)
        self._offsets.append(self._size + len(LITTLE_ENDIAN))
        self._size += size

    def done(self) -> Packer:
        """Finish the layout."""
        size = self._size + len(LITTLE_ENDIAN)
        kind = np.dtype(
            {
                "names": self._names,
                "formats": self._formats,
                "offsets": self._offsets,
                "itemsize": size,
            }
        )
        blank = np.frombuffer(bytearray(LITTLE_ENDIAN.ljust(size, b"\0")), kind)
        for name, value in self._fixed.items():
            blank[name] = value
        return Packer(blank)


class Packer:
    """Packs messages of one layout.

    Args:
        blank: (1,), a message with all fixed fields.
    """

    def __init__(self, blank: NDArray[np.void]) -> None:
        self._blank = blank
        self.size = blank.dtype.itemsize

    def packed(self, count: int, fields: Mapping[str, Any]) -> list[bytes]:
        """Make messages.

        Args:
            count: how many.
            fields: by name, (count,) or (count, length) each.
        """
        rows = np.repeat(self._blank, count)
        for name, values in fields.items():
            rows[name] = values
        data, size = rows.tobytes(), self.size
        return [data[first : first + size] for first in range(0, count * size, size)]


def times(nanoseconds: NDArray[np.int64]) -> dict[str, NDArray[np.int64]]:
    """The fields `sec` and `nanosec` of headers."""
    return {"sec": nanoseconds // NANOSECONDS, "nanosec": nanoseconds % NANOSECONDS}
