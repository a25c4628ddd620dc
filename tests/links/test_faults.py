"""What faults may be asked for, what broken wheels do to lines, and which lines suffer."""

from __future__ import annotations

import math
from collections import Counter
from typing import Any

import numpy as np
import pytest

from acsar_gym.errors import ConfigError
from acsar_gym.links.faults import (
    Faults,
    WheelEditor,
    WheelFaults,
)
from acsar_gym.protocol import Speeds, encode

LINE = encode((1.0, -2.0, 3.0, 0.0))


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


def test_named_wheels_are_those_and_numbers_are_drawn() -> None:
    rng = np.random.default_rng(1)
    faults = Faults(stuck_encoders="db", reversed_encoders=0, dead_wheels=2)
    drawn = [WheelFaults.draw(faults, rng) for _ in range(2000)]
    assert {(wheels.stuck, wheels.reversed) for wheels in drawn} == {("db", "")}
    pairs = Counter(wheels.dead for wheels in drawn)
    assert set(pairs) == {"ab", "ac", "ad", "bc", "bd", "cd"}
    assert min(pairs.values()) > 250


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
