"""The decoder under a flood of random bytes and mutated lines."""

from __future__ import annotations

import gc
import tracemalloc
from collections.abc import Iterator

import numpy as np
from samples import samples

from acsar_gym.protocol import Decoder, Reading, encode

CHUNK = 4096


def lines(rng: np.random.Generator, count: int) -> list[bytes]:
    return [encode(row) for row in rng.uniform(-99.0, 99.0, (count, 4)).tolist()]


def again(reading: Reading) -> bytes:
    """The line that says the same; empty where a motor is missing."""
    speeds = [speed for speed in reading.speeds if speed is not None]
    return encode(speeds) if len(speeds) == 4 else b""


def chunks(data: bytes) -> Iterator[bytes]:
    return (data[start : start + CHUNK] for start in range(0, len(data), CHUNK))


@samples(1_000_000, 10_000_000)
def test_random_bytes_and_every_good_line_among_them(count: int) -> None:
    rng = np.random.default_rng(0)
    good = lines(rng, 200)
    decoder, read, fed = Decoder(), 0, 0
    tracemalloc.start()
    for number in range(len(good)):
        garbage = rng.integers(0, 256, count // len(good), np.uint8).tobytes()
        fed += len(garbage)
        for chunk in chunks(garbage):
            decoder.feed(chunk)
        readings = decoder.feed(b"\r\n" + good[number])
        read += any(again(reading) == good[number] for reading in readings)
    gc.collect()
    grown, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert fed == count
    assert read == len(good)
    assert grown < 1_000_000
    assert sum(decoder.refused.values()) > 1000
    assert len(decoder.refused) < 20


@samples(50_000, 1_000_000)
def test_mutated_lines_lose_no_good_one(count: int) -> None:
    """Every third line has a byte replaced, dropped or doubled; the others must all be read."""
    rng = np.random.default_rng(1)
    pool = lines(rng, 5000)
    kinds = rng.integers(0, 9, count).tolist()
    places, values = (rng.integers(0, high, count).tolist() for high in (31, 256))
    decoder, good, whole = Decoder(), 0, 0
    for start in range(0, count, 1000):
        block = bytearray()
        for k in range(start, start + 1000):
            line, kind, place = pool[k % len(pool)], kinds[k], places[k]
            if kind == 0:
                line = line[:place] + bytes([values[k]]) + line[place + 1 :]
            elif kind == 1:
                line = line[:place] + line[place + 1 :]
            elif kind == 2:
                line = line[:place] + line[place : place + 1] + line[place:]
            else:
                good += 1
            block += line
        whole += sum(None not in reading.speeds for reading in decoder.feed(bytes(block)))
    assert good > count // 2
    assert whole >= good
