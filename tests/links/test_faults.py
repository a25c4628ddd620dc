"""What faults may be asked for, what broken wheels do to lines, and which lines suffer."""

from __future__ import annotations

import itertools
import math
from collections import Counter
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from acsar_gym.errors import ConfigError
from acsar_gym.links.faults import (
    FAULT_KINDS,
    Faults,
    LineSplitter,
    WheelEditor,
    WheelFaults,
    line_hash,
)
from acsar_gym.protocol import MAX_LINE, Decoder, Speeds, encode

LINE = encode((1.0, -2.0, 3.0, 0.0))
chunks = st.lists(st.binary(max_size=40) | st.sampled_from([LINE, b"\r", b"\n", LINE[:13]]))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("dropped_lines", 0.1),
        ("late_lines", 1),
        ("garbage_rate", 2.0),
        ("stuck_encoders", "a"),
        ("dead_wheels", 1),
        ("board_reset_rate", 0.1),
        ("brown_out_at", 0.0),
        ("unplug_at", 1.5),
    ],
)
def test_each_fault_is_possible_by_itself(name: str, value: Any) -> None:
    assert not Faults.of(None).possible
    assert Faults.of({name: value}).possible
    assert not Faults.of({name: value, "episodes": 0.0}).possible


@pytest.mark.parametrize(
    ("faults", "said"),
    [
        ({"droped_lines": 0.1}, r"droped_lines'.*'dropped_lines'"),
        ({3: 0.1}, "3"),
        ("dropped_lines", "mapping"),
        (["dropped_lines"], "mapping"),
    ],
)
def test_what_is_no_mapping_of_faults_is_refused(faults: Any, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        Faults.of(faults)


BAD_FOR_ALL: tuple[Any, ...] = (-1.0, math.nan, True, "e", "aa", [1], -math.inf, {})
OUT_OF_RANGE: dict[str, tuple[Any, ...]] = {
    "dropped_lines": (1.01,),
    "episodes": (2,),
    "garbage_rate": (1e6,),
    "garbage_bytes": (0, 8.0, 10**9),
    "dead_wheels": (5, 1.0),
    "stuck_encoders": (None,),
    "lateness": (math.inf, None),
    "unplug_at": (math.inf,),
    "wheel_faults_at": (None,),
    "direction": ("up",),
}


@pytest.mark.parametrize("name", list(Faults.model_fields))
def test_bad_values_name_the_field(name: str) -> None:
    for value in (*BAD_FOR_ALL, *OUT_OF_RANGE.get(name, ())):
        with pytest.raises(ConfigError, match=rf"faults\.{name} = "):
            Faults.of({name: value})


def test_values_at_the_edge() -> None:
    Faults(dropped_lines=1, episodes=np.float32(0.5), garbage_bytes=1, dead_wheels=4)
    Faults(replug_time=math.inf, unplug_at=0, stuck_encoders="", reversed_encoders="dcba")


def test_named_wheels_are_those_and_numbers_are_drawn() -> None:
    rng = np.random.default_rng(1)
    faults = Faults(stuck_encoders="db", reversed_encoders=0, dead_wheels=2)
    drawn = [WheelFaults.draw(faults, rng) for _ in range(2000)]
    assert {(wheels.stuck, wheels.reversed) for wheels in drawn} == {("db", "")}
    pairs = Counter(wheels.dead for wheels in drawn)
    assert set(pairs) == {"ab", "ac", "ad", "bc", "bd", "cd"}
    assert min(pairs.values()) > 250


@given(chunks)
def test_lines_lose_nothing_and_hold_back_half_a_line_at_most(pieces: list[bytes]) -> None:
    lines, given_, got = LineSplitter(), b"", b""
    for piece in pieces:
        given_ += piece
        complete = lines.feed(piece)
        got += b"".join(complete)
        assert got + lines.partial == given_
        assert len(lines.partial) <= MAX_LINE
        assert b"\r" not in lines.partial
        assert b"\n" not in lines.partial
        assert all(len(line.splitlines()) == 1 for line in complete)


def edited(pieces: list[bytes], **wheels: str) -> bytes:
    editor = WheelEditor(WheelFaults(**wheels), at=0.0)
    return b"".join(editor.edit_commands(editor.edit_feedback(piece, 0.0), 0.0) for piece in pieces)


@pytest.mark.parametrize(
    ("faults", "line"),
    [
        ({}, (1.0, -2.0, 3.0, 0.0)),
        ({"reversed": "abcd"}, (-1.0, 2.0, -3.0, 0.0)),
        ({"stuck": "ac"}, (0.0, -2.0, 0.0, 0.0)),
        ({"dead": "b"}, (1.0, 0.0, 3.0, 0.0)),
    ],
)
def test_broken_wheels_in_a_line(faults: dict[str, str], line: Speeds) -> None:
    assert edited([LINE], **faults) == encode(line)


def test_wheels_break_when_it_is_time() -> None:
    editor = WheelEditor(WheelFaults(stuck="a", reversed="b", dead="c"), at=1.0)
    assert editor.edit_feedback(LINE, 0.99) == editor.edit_commands(LINE, 0.99) == LINE
    later = encode((5.0, 5.0, 5.0, 5.0))
    assert editor.edit_feedback(later, 1.0) == encode((1.0, -5.0, 5.0, 5.0))
    assert editor.edit_commands(later, 1.0) == encode((5.0, 5.0, 0.0, 5.0))


@given(chunks, st.data())
def test_a_dead_wheel_is_dead_whatever_the_line_looks_like(
    pieces: list[bytes], data: st.DataObject
) -> None:
    stream = b"".join(pieces) + b"\r\n"
    at = data.draw(st.integers(0, len(stream)))
    for whole_or_torn in ([stream], [stream[:at], stream[at:]]):
        for reading in Decoder().feed(edited(whole_or_torn, dead="bd")):
            assert {reading.speeds[1], reading.speeds[3]} <= {None, 0.0}


WORD = (1 << 64) - 1


def split_mix(word: int) -> int:
    """SplitMix64's output function, in whole numbers."""
    word = ((word ^ (word >> 30)) * 0xBF58476D1CE4E5B9) & WORD
    word = ((word ^ (word >> 27)) * 0x94D049BB133111EB) & WORD
    return word ^ (word >> 31)


@pytest.mark.parametrize("key", [0.0, 0.5, 0.1234567890123, 1.0 - 2.0**-53])
def test_lots_are_split_mix_64(key: float) -> None:
    for whose, number, kind in itertools.product((0, 1, 2), (0, 1, 7, 100_000), (0, 4)):
        count = (number * 3 + whose) * FAULT_KINDS + kind + 1
        word = split_mix(((int(key * 2**53) << 11) + count * 0x9E3779B97F4A7C15) & WORD)
        assert line_hash(key, whose, float(number), kind) == (word >> 11) / 2**53
