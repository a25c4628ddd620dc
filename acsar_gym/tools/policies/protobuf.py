"""A parser for protobuf messages, the format of ONNX files, that is safe for untrusted input.

https://protobuf.dev/programming-guides/encoding. It copies no data and limits the number of fields,
so time and memory are bounded for malicious files too.
"""

from __future__ import annotations

from collections.abc import Iterator

Value = int | memoryview
MAX_FIELDS = 50_000
"""Largest number of fields in a file; one tensor of weights is one field."""
_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5


class ProtobufError(ValueError):
    """The bytes aren't a valid protobuf message, or have too many fields."""


class Message:
    """One message: its fields by field number, in the order of the file.

    Raises:
        ProtobufError: when the bytes, or later a requested field, are malformed.
    """

    def __init__(self, data: bytes | memoryview, budget: list[int] | None = None) -> None:
        self._budget = [MAX_FIELDS] if budget is None else budget
        self._fields: dict[int, list[Value]] = {}
        for number, value in _fields(memoryview(data)):
            self._budget[0] -= 1
            if self._budget[0] < 0:
                raise ProtobufError(f"more than {MAX_FIELDS:,} fields")
            self._fields.setdefault(number, []).append(value)

    def __contains__(self, number: int) -> bool:
        return number in self._fields

    def integers(self, number: int) -> list[int]:
        """Return a repeated integer field, packed or not."""
        found: list[int] = []
        for value in self._fields.get(number, ()):
            numbers = [value] if isinstance(value, int) else _varints(value)
            self._budget[0] -= len(numbers)
            found += [n - (1 << 64) if n >> 63 else n for n in numbers]
        return found

    def integer(self, number: int) -> int:
        """Return an integer field; 0 if it is missing."""
        return (self.integers(number) or [0])[-1]

    def text(self, number: int) -> str:
        """Return a string field; empty if it is missing."""
        return (self.texts(number) or [""])[-1]

    def texts(self, number: int) -> list[str]:
        """Return a repeated string field."""
        return [str(part, "utf-8", "replace") for part in self._parts(number)]

    def messages(self, number: int) -> list[Message]:
        """Return a repeated message field."""
        return [Message(part, self._budget) for part in self._parts(number)]

    def message(self, number: int) -> Message:
        """Return a message field; several occurrences are merged, as protobuf specifies."""
        parts = self._parts(number)
        return Message(parts[0] if len(parts) == 1 else b"".join(parts), self._budget)

    def data(self, number: int) -> bytes:
        """Return a field of bytes; empty if it is missing."""
        return b"".join(self._parts(number))

    def size(self, number: int) -> int:
        """Return the total size of all fields with this number [bytes]."""
        return sum(len(part) for part in self._parts(number))

    def _parts(self, number: int) -> list[memoryview]:
        """Return the bytes of all length-delimited fields with this number."""
        parts: list[memoryview] = []
        for value in self._fields.get(number, ()):
            if isinstance(value, int):
                raise ProtobufError(f"field {number} is a number")
            parts.append(value)
        return parts


def _fields(data: memoryview) -> Iterator[tuple[int, Value]]:
    """Yield field number and value of every field."""
    at = 0
    while at < len(data):
        tag, at = _varint(data, at)
        number, kind = tag >> 3, tag & 7
        if not 0 < number < 1 << 29:
            raise ProtobufError(f"field number {number}")
        if kind == _VARINT:
            value, at = _varint(data, at)
            yield number, value
            continue
        if kind == _BYTES:
            length, at = _varint(data, at)
        elif kind in (_FIXED64, _FIXED32):
            length = 8 if kind == _FIXED64 else 4
        else:
            raise ProtobufError(f"wire type {kind}")
        if length > len(data) - at:
            raise ProtobufError("ends in the middle of a field")
        yield number, data[at : at + length]
        at += length


def _varint(data: memoryview, at: int) -> tuple[int, int]:
    """Decode an unsigned integer of up to 64 bits; returns it and the index of the next byte."""
    value = 0
    for shift in range(0, 70, 7):
        if at >= len(data):
            raise ProtobufError("ends in the middle of a number")
        byte = data[at]
        at += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value & (1 << 64) - 1, at
    raise ProtobufError("a number of over 64 bits")


def _varints(data: memoryview) -> list[int]:
    """Decode packed integers."""
    if len(data) > MAX_FIELDS:
        raise ProtobufError("too many numbers")
    found, at = [], 0
    while at < len(data):
        value, at = _varint(data, at)
        found.append(value)
    return found
