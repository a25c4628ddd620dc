"""The codec: the vectors and the page of docs/protocol.md, and damage in any pieces."""

from __future__ import annotations

import json
import math
import pickle
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from acsar_gym.config import LINE_BYTES
from acsar_gym.errors import CommandError
from acsar_gym.protocol import MAX_LINE, MAX_SPEED, WHEELS, Decoder, Speeds, encode

DOCS = Path(__file__).resolve().parents[1] / "docs"
VECTORS: dict[str, Any] = json.loads((DOCS / "protocol-vectors.json").read_text(encoding="ascii"))
PAGE = (DOCS / "protocol.md").read_text(encoding="utf-8")
SPEED = r"[pn][0-9]{2}\.[0-9]{2}"
LINE = re.compile((",".join(letter + SPEED for letter in "abcd") + r",?\r\n").encode())
"""The page's ABNF."""
TERMINALS = {
    "motor-a": "%x61 value",
    "motor-b": "%x62 value",
    "motor-c": "%x63 value",
    "motor-d": "%x64 value",
    "direction": "%x70 / %x6E",
    "speed": '2DIGIT "." 2DIGIT',
}
GOOD = b"ap12.50,bn08.75,cp15.00,dn10.25"

Vector = dict[str, Any]


def named(section: str) -> pytest.MarkDecorator:
    """Run a test for each vector of a section."""
    return pytest.mark.parametrize("vector", VECTORS[section], ids=lambda vector: vector["name"])


def read(data: bytes, piece: int, decoder: Decoder | None = None) -> list[list[float | None]]:
    """What a decoder reads of bytes that come in pieces."""
    decoder = decoder or Decoder()
    pieces = [data[start : start + piece] for start in range(0, len(data), piece)]
    return [list(reading.speeds) for data in pieces for reading in decoder.feed(data)]


@named("encode")
def test_encode_writes_the_vectors(vector: Vector) -> None:
    line = vector["line"].encode()
    assert encode(vector["speeds"], trailing_comma=False) == line
    assert encode(vector["speeds"]) == line.replace(b"\r", b",\r")


@named("encode_refused")
def test_encode_refuses_the_vectors(vector: Vector) -> None:
    with pytest.raises(CommandError):
        encode([float(speed) for speed in vector["speeds"]])


@pytest.mark.parametrize(
    "vector", VECTORS["decode"] + VECTORS["decode_tolerant"], ids=lambda vector: vector["name"]
)
def test_decoder_reads_the_vectors_in_any_pieces(vector: Vector) -> None:
    expected = vector.get("tolerant", vector["lines"])
    data = vector["bytes"].encode("latin-1")
    for piece in (1, 3, 7, len(data)):
        assert read(data, piece) == expected


def test_protocol_page_agrees_with_the_code() -> None:
    rules = dict(re.findall(r"^([\w-]+) += ([^;\n]*?) *(?:;.*)?$", PAGE, re.M))
    assert rules.items() >= TERMINALS.items()
    assert f"A line is {LINE_BYTES} bytes, {LINE_BYTES + 1} with the comma" in PAGE
    assert f"more than {MAX_LINE} bytes" in PAGE
    assert PAGE.splitlines()[2].startswith(f"Version {VECTORS['protocol']}.")


def test_protocol_page_has_a_script_that_makes_a_header(tmp_path: Path) -> None:
    (tmp_path / "protocol-vectors.json").write_text(json.dumps(VECTORS))
    (code,) = re.findall(r"^```python\n(# make_vectors.py\n.*?)^```", PAGE, re.M | re.S)
    subprocess.run([sys.executable, "-c", code], cwd=tmp_path, check=True, timeout=60)
    header = (tmp_path / "vectors.h").read_text()
    assert header.count("\n{") == len(VECTORS["encode"]) + len(VECTORS["decode"])


def on_a_rounding_edge(thousandths: int, side: float) -> float:
    """A multiple of 0.001, or its neighbour among the doubles."""
    return math.nextafter(thousandths / 1000, side) if side else thousandths / 1000


finite = st.one_of(
    st.floats(allow_nan=False, allow_infinity=False),
    st.builds(
        on_a_rounding_edge,
        st.integers(-101_000, 101_000),
        st.sampled_from([0.0, math.inf, -math.inf]),
    ),
)
four_speeds = st.tuples(finite, finite, finite, finite)
noise = st.one_of(
    st.binary(max_size=3 * MAX_LINE),
    st.text("abcdepnx0123456789.,- \r\n", max_size=60).map(str.encode),
    st.integers(MAX_LINE - 40, 3 * MAX_LINE).map(lambda length: b"x" * length),
    four_speeds.map(encode),
)


@given(speeds=four_speeds, comma=st.booleans())
@example(speeds=(1e308, 1e308, 1e308, 1e308), comma=False)
@example(speeds=(-0.0, -0.001, -0.00499, -5e-324), comma=False)
def test_encode_rounds_saturates_and_fits_the_grammar(speeds: Speeds, comma: bool) -> None:
    line = encode(speeds, trailing_comma=comma)
    assert LINE.fullmatch(line)
    assert len(line) == LINE_BYTES + comma
    assert line.endswith(b",\r\n") is comma
    assert b"n00.00" not in line
    expected = [max(-MAX_SPEED, min(MAX_SPEED, round(speed, 2))) for speed in speeds]
    assert read(line, len(line)) == [expected]


@given(chunks=st.lists(noise, max_size=20))
def test_decoder_takes_any_bytes_in_bounded_memory(chunks: list[bytes]) -> None:
    decoder = Decoder()
    for chunk in chunks:
        decoder.feed(chunk)
        assert len(pickle.dumps(vars(decoder))) < MAX_LINE + 500


@pytest.mark.parametrize("index", range(4))
def test_encode_refuses_what_is_not_four_finite_speeds(index: int) -> None:
    speeds = [1.0, 2.0, 3.0, 4.0]
    speeds[index] = -math.inf
    with pytest.raises(CommandError, match=f"^{WHEELS[index]} speed is -inf"):
        encode(speeds)
    for length in (3, 5):
        with pytest.raises(CommandError, match=f"got {length}"):
            encode([0.0] * length)


@pytest.mark.parametrize(
    ("line", "refused"),
    [
        (b"dn04.00,ap01.00", {}),
        (b"ap01.00,ep02.00,Ap03.00", {"unknown motor": 2}),
        (b"a,bx01.00,cp02.00", {"unknown direction": 2}),
        (b"ap1.00,bp02.00,cp,dp04.00", {"malformed number": 2}),
        (b"ap01.00,,cp03.00,,", {"empty part": 2}),
        (b"ap01.00,ap02.00,an03.00", {"duplicate motor": 2}),
    ],
)
def test_decoder_counts_refused_parts(line: bytes, refused: dict[str, int]) -> None:
    decoder = Decoder()
    assert len(decoder.feed(line + b"\n")) == 1
    assert decoder.refused == refused
    assert (decoder.lines, decoder.damaged) == (1, 0)


@given(hundredths=st.tuples(*[st.integers(-12_000, 12_000)] * 4), spaces=st.integers(0, 3))
@example(hundredths=(0, 523, 10520, -320), spaces=0)
@example(hundredths=(0, 0, 0, 0), spaces=1)
def test_decoder_reads_unpadded_numbers(hundredths: Speeds, spaces: int) -> None:
    speeds = [value / 100 for value in hundredths]
    parts = [
        f"{motor}{'n' if speed < 0 else 'p'}{' ' * spaces}{abs(speed):.2f}"
        for motor, speed in zip("abcd", speeds, strict=True)
    ]
    decoder = Decoder()
    numbers = read(f"{','.join(parts)},\r\n".encode(), 99, decoder)
    assert numbers == [speeds]
    assert "-0.0" not in map(str, numbers[0])
    assert not decoder.refused


@pytest.mark.parametrize("place", range(0, len(GOOD), 4))
def test_decoder_forgives_a_first_line_without_its_beginning(place: int) -> None:
    decoder = Decoder()
    decoder.feed(GOOD[place:] + b"\r\n" + GOOD + b"\r\n")
    assert not decoder.refused
    decoder.feed(b"12.50,bn08.75\r\n")
    assert decoder.refused == {"unknown motor": 1}


@pytest.mark.parametrize("good", [GOOD, b"ap5.23,bn105.20,cp0.00,dp7.00"], ids=["padded", "not"])
@pytest.mark.parametrize("place", [1, 5, 8, 25])
def test_decoder_reads_a_line_that_a_reset_cut(good: bytes, place: int) -> None:
    decoder = Decoder()
    uncut = decoder.feed(good + b"\r\n")
    assert decoder.feed(good[:place] + good + b",\r\n") == uncut
    assert (decoder.refused, decoder.lines) == ({}, 2)


@pytest.mark.parametrize("chunk", [7, 10 * MAX_LINE])
@pytest.mark.parametrize(("excess", "lines"), [(0, 2), (1, 1), (MAX_LINE, 1)])
def test_decoder_drops_lines_beyond_the_limit(excess: int, lines: int, chunk: int) -> None:
    line = b"ap01.00".rjust(MAX_LINE + excess - 8, b"x") + b",bp02.00"
    decoder = Decoder()
    assert len(read(line + b"\n" + GOOD + b"\n", chunk, decoder)) == lines
    assert decoder.refused == {"unknown motor" if lines == 2 else "line too long": 1}


def test_decoder_keeps_notes() -> None:
    decoder = Decoder()
    decoder.feed(b"# a cut: stalled\r\nap01.00\r\n# b cut\n# a cut: stalled\r\n# \xff\n")
    assert decoder.notes == ["b cut", "a cut: stalled", "\\xff"]
    assert (decoder.lines, decoder.refused, decoder.damaged) == (1, {}, 0)
    assert read(b"#,bp02.00\n", 99, decoder) == [[None, 2.0, None, None]]
    assert decoder.refused == {"unknown motor": 1}
    decoder.feed(b"".join(b"# %d\n" % number for number in range(100)))
    assert decoder.notes == [str(number) for number in range(92, 100)]
    decoder.reset()
    assert decoder.notes == []
