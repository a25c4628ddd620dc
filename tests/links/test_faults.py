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
from pydantic import ValidationError

from acsar_gym.errors import ConfigError
from acsar_gym.links.faults import (
    COMMAND_LINE,
    FAULT_KINDS,
    FEEDBACK_LINE,
    WHOLE_EPISODE,
    Faults,
    LineSplitter,
    WheelEditor,
    WheelFaults,
    line_hash,
)
from acsar_gym.protocol import MAX_LINE, Decoder, encode

LINE = encode((1.0, -2.0, 3.0, 0.0))
chunks = st.lists(st.binary(max_size=40) | st.sampled_from([LINE, b"\r", b"\n", LINE[:13]]))


def test_by_default_nothing_goes_wrong() -> None:
    assert not Faults().possible
    assert Faults.of(None) == Faults.of({}) == Faults()


@pytest.mark.parametrize(
    "change",
    [
        {"dropped_lines": 0.1},
        {"late_lines": 1},
        {"garbage_rate": 2.0},
        {"stuck_encoders": "a"},
        {"dead_wheels": 1},
        {"board_reset_rate": 0.1},
        {"brown_out_at": 0.0},
        {"unplug_at": 1.5},
    ],
)
def test_each_fault_is_possible_by_itself(change: dict[str, Any]) -> None:
    assert Faults.of(change).possible
    assert not Faults.of({**change, "episodes": 0.0}).possible


def test_faults_are_passed_on_as_they_are_and_frozen() -> None:
    faults = Faults(dropped_lines=0.25, dead_wheels="ac")
    assert Faults.of(faults) is faults
    with pytest.raises(ValidationError, match="frozen"):
        faults.cut_lines = 0.5  # type: ignore[misc]


def test_a_typo_is_found() -> None:
    with pytest.raises(ConfigError, match=r"droped_lines'.*'dropped_lines'"):
        Faults.of({"droped_lines": 0.1})
    with pytest.raises(ConfigError, match="3"):
        Faults.of({3: 0.1})  # type: ignore[dict-item]


@pytest.mark.parametrize("faults", ["dropped_lines", 3, ["dropped_lines"]])
def test_what_is_no_mapping_says_so(faults: Any) -> None:
    with pytest.raises(ConfigError, match="must be a mapping"):
        Faults.of(faults)


@pytest.mark.parametrize("name", list(Faults.model_fields))
@pytest.mark.parametrize("value", [-1.0, math.nan, True, "e", "aa", [1], -math.inf, {}])
def test_bad_values_name_the_field(name: str, value: object) -> None:
    with pytest.raises(ConfigError, match=rf"faults\.{name} = "):
        Faults.of({name: value})


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("dropped_lines", 1.01),
        ("episodes", 2),
        ("garbage_rate", 1e6),
        ("garbage_bytes", 0),
        ("garbage_bytes", 8.0),
        ("garbage_bytes", 10**9),
        ("dead_wheels", 5),
        ("dead_wheels", 1.0),
        ("stuck_encoders", None),
        ("lateness", math.inf),
        ("lateness", None),
        ("unplug_at", math.inf),
        ("wheel_faults_at", None),
        ("direction", "up"),
    ],
)
def test_values_out_of_range(name: str, value: object) -> None:
    with pytest.raises(ConfigError, match=name):
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


def test_a_line_without_an_end_does_not_fill_the_memory() -> None:
    lines = LineSplitter()
    passed = b"".join(b"".join(lines.feed(b"x" * 100)) for _ in range(1000))
    assert len(passed) >= 100_000 - MAX_LINE


def edited(pieces: list[bytes], **wheels: str) -> bytes:
    editor = WheelEditor(WheelFaults(**wheels), at=0.0)
    return b"".join(editor.edit_commands(editor.edit_feedback(piece, 0.0), 0.0) for piece in pieces)


def test_broken_wheels_in_a_line() -> None:
    assert edited([LINE], reversed="abcd") == b"an01.00,bp02.00,cn03.00,dp00.00,\r\n"
    assert edited([LINE], stuck="ac") == b"ap00.00,bn02.00,cp00.00,dp00.00,\r\n"
    assert edited([LINE], dead="b") == b"ap01.00,bp00.00,cp03.00,dp00.00,\r\n"
    assert edited([LINE]) == LINE


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
    for readings in (
        Decoder().feed(edited([stream], dead="bd")),
        Decoder().feed(edited([stream[:at], stream[at:]], dead="bd")),
    ):
        assert all(reading.speeds[1] in (None, 0.0) for reading in readings)
        assert all(reading.speeds[3] in (None, 0.0) for reading in readings)


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


def test_lots_are_uniform_and_independent() -> None:
    keys = np.random.default_rng(0).random(20).tolist()
    rows = [
        [line_hash(key, whose, float(number), kind) for key in keys for number in range(200)]
        for whose, kind in (
            (FEEDBACK_LINE, 0),
            (FEEDBACK_LINE, 4),
            (COMMAND_LINE, 0),
            (WHOLE_EPISODE, 0),
        )
    ]
    table = np.array(rows)
    assert np.histogram(table, 10, (0.0, 1.0))[0] / table.size == pytest.approx(0.1, abs=0.01)
    assert np.corrcoef(table) == pytest.approx(np.eye(4), abs=0.06)
    assert np.corrcoef(table[0, 1:], table[0, :-1])[0, 1] == pytest.approx(0.0, abs=0.06)
