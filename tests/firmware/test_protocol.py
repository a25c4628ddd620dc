"""The program's parser and printer, compiled for this computer, against the host's codec."""

from __future__ import annotations

import re
from pathlib import Path

import protocol_tools
import pytest
from hypothesis import given
from hypothesis import strategies as st
from protocol_tools import Program

from acsar_gym.protocol import MAX_LINE, Decoder, encode

PART = re.compile(rb"([abcd])([pn])([0-9]{2})\.([0-9]{2})")


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return protocol_tools.compiled(tmp_path_factory.mktemp("protocol"))


def expected(data: bytes) -> list[dict[int, int]]:
    """The document's rules, in other words."""
    lines = []
    for line in re.split(rb"[\r\n]", data)[:-1]:
        speeds = {}
        for text in line.split(b",") if len(line) <= MAX_LINE else []:
            if match := PART.fullmatch(text):
                motor, direction, units, cents = match.groups()
                value = int(units) * 100 + int(cents)
                speeds[b"abcd".index(motor)] = value if direction == b"p" else -value
        lines += [speeds] if speeds else []
    return lines


PIECES = st.sampled_from(
    [b"ap12.50", b"bn08.75", b"cp00.00", b"dn99.99", b",", b"\r", b"\n", b"\r\n", b"a", b"p", b"5",
     b".", b"ap5.23", b"en01.00", b"\x00", b"\xff", b" ", b"ap12.5", b"x" * 250]
)  # fmt: skip
STREAMS = st.lists(st.one_of(PIECES, st.binary(max_size=6)), max_size=60).map(b"".join)


@given(STREAMS)
def test_parser_reads_every_stream_by_the_rules(library: Path, stream: bytes) -> None:
    assert Program(library).take(stream) == expected(stream)


@given(st.lists(st.integers(-9999, 9999), min_size=4, max_size=4), st.booleans())
def test_parser_reads_what_the_host_sends(library: Path, cents: list[int], comma: bool) -> None:
    line = encode([value / 100 for value in cents], trailing_comma=comma)
    assert Program(library).take(line) == [dict(enumerate(cents))]


@given(st.lists(st.integers(-32768, 32767), min_size=4, max_size=4), st.booleans())
def test_printer_prints_what_the_host_reads(library: Path, cents: list[int], comma: bool) -> None:
    line = Program(library).line(cents, comma=comma)
    assert line == encode([value / 100 for value in cents], trailing_comma=comma)
    assert len(Decoder().feed(line)) == 1
