"""The codec: numbers and lines, damage in any pieces, and a flood of random bytes."""

from __future__ import annotations

import math
import pickle
import re

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from acsar_gym.config import LINE_BYTES
from acsar_gym.errors import CommandError
from acsar_gym.protocol import MAX_LINE, MAX_SPEED, WHEELS, Decoder, Speeds, encode

GRAMMAR = re.compile(rb"a[pn]\d\d\.\d\d,b[pn]\d\d\.\d\d,c[pn]\d\d\.\d\d,d[pn]\d\d\.\d\d,?\r\n")
NOT_NUMBERS = (
    "nan|1e+10|--1.00|+ 1.00|001.00|01.000|01.0|01.|.01|01:00|01.00 |\u0660\u0661.\u0660\u0660|"
)
GOOD = b"ap12.50,bn08.75,cp15.00,dn10.25"
GOOD_SPEEDS = (12.5, -8.75, 15.0, -10.25)


def on_a_rounding_edge(thousandths: int, side: float) -> float:
    """A multiple of 0.001, or its neighbour among the doubles."""
    return math.nextafter(thousandths / 1000, side) if side else thousandths / 1000


finite = st.one_of(
    st.floats(allow_nan=False, allow_infinity=False),
    st.floats(-120, 120),
    st.builds(
        on_a_rounding_edge,
        st.integers(-101_000, 101_000),
        st.sampled_from([0.0, math.inf, -math.inf]),
    ),
)
four_speeds = st.tuples(finite, finite, finite, finite)
noise_kinds = [
    st.binary(max_size=40),
    st.text("abcdepnx0123456789.,- \r\n", max_size=60).map(str.encode),
    st.integers(MAX_LINE - 40, 3 * MAX_LINE).map(lambda length: b"x" * length),
    four_speeds.map(encode),
    st.builds("{}p{:.2f},".format, st.sampled_from("abcd"), st.floats(-200, 200)).map(str.encode),
    st.sampled_from([b"\r", b"\n", b"\r\n", b",", GOOD, GOOD + b"\n", b"ap01.00"]),
]
noise = st.one_of(noise_kinds)
streams = st.lists(noise, max_size=12).map(b"".join)


def on_the_wire(speed: float) -> float:
    return max(-MAX_SPEED, min(MAX_SPEED, round(speed, 2)))


def speeds_of(data: bytes) -> list[tuple[float | None, ...]]:
    return [reading.speeds for reading in Decoder().feed(data)]


@given(speeds=four_speeds, comma=st.booleans())
@example(speeds=(1e308, 1e308, 1e308, 1e308), comma=False)
def test_decoder_reads_encoded_speeds_rounded_and_saturated(speeds: Speeds, comma: bool) -> None:
    expected = tuple(on_the_wire(speed) for speed in speeds)
    assert speeds_of(encode(speeds, trailing_comma=comma)) == [expected]


@given(speeds=four_speeds, comma=st.booleans())
@example(speeds=(-0.0, -0.001, -0.00499, -5e-324), comma=False)
def test_encode_fits_the_grammar_and_no_zero_is_negative(speeds: Speeds, comma: bool) -> None:
    line = encode(speeds, trailing_comma=comma)
    assert GRAMMAR.fullmatch(line)
    assert line.endswith(b",\r\n") is comma
    assert len(line) == LINE_BYTES + comma
    assert b"n00.00" not in line


@given(chunks=st.lists(st.one_of(noise, st.binary(max_size=3 * MAX_LINE)), max_size=20))
def test_decoder_takes_any_bytes_in_bounded_memory(chunks: list[bytes]) -> None:
    decoder = Decoder()
    for chunk in chunks:
        decoder.feed(chunk)
        assert len(pickle.dumps(vars(decoder))) < MAX_LINE + 500


@pytest.mark.parametrize("index", range(4))
def test_encode_refuses_what_is_not_four_finite_speeds(index: int) -> None:
    for bad in (math.nan, -math.inf):
        speeds = [1.0, 2.0, 3.0, 4.0]
        speeds[index] = bad
        with pytest.raises(CommandError, match=f"^{WHEELS[index]} speed is {bad}"):
            encode(speeds)
    for length in (3, 5):
        with pytest.raises(CommandError, match=f"got {length}"):
            encode([0.0] * length)


def test_decoder_takes_any_line_end_with_or_without_a_trailing_comma() -> None:
    for end in (b"\r", b"\n", b"\r\n", b",\r\r\n", b",\n"):
        decoder = Decoder()
        assert [reading.speeds for reading in decoder.feed((GOOD + end) * 3)] == [GOOD_SPEEDS] * 3
        assert (decoder.lines, decoder.refused) == (3, {})


@pytest.mark.parametrize(
    ("line", "speeds", "refused"),
    [
        (b"dn04.00,ap01.00", (1.0, None, None, -4.0), {}),
        (b"ap01.00,ep02.00,cp03.00", (1.0, None, 3.0, None), {"unknown motor": 1}),
        (b"Ap01.00,bp02.00", (None, 2.0, None, None), {"unknown motor": 1}),
        (b"a,bx01.00,cp02.00", (None, None, 2.0, None), {"unknown direction": 2}),
        (b"ap1.00,bp02.00,cp,dp04.00", (None, 2.0, None, 4.0), {"malformed number": 2}),
        (b"ap01.00,,cp03.00,,", (1.0, None, 3.0, None), {"empty part": 2}),
        (b"ap01.00,ap02.00,an03.00", (-3.0, None, None, None), {"duplicate motor": 2}),
        (GOOD + b"0", (*GOOD_SPEEDS[:3], None), {"malformed number": 1}),
        (b"\xff\x00" + GOOD, (None, *GOOD_SPEEDS[1:]), {"unknown motor": 1}),
    ],
)
def test_decoder_refuses_and_counts_bad_parts(
    line: bytes, speeds: tuple[float | None, ...], refused: dict[str, int]
) -> None:
    decoder = Decoder()
    assert [reading.speeds for reading in decoder.feed(line + b"\n")] == [speeds]
    assert decoder.refused == refused
    assert decoder.lines == 1


@pytest.mark.parametrize("number", NOT_NUMBERS.split("|"))
def test_decoder_refuses_numbers_of_another_form(number: str) -> None:
    decoder = Decoder()
    assert decoder.feed(f"ap{number},bp02.00\n".encode())[0].speeds == (None, 2.0, None, None)
    assert decoder.refused == {"malformed number": 1}


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
    read = decoder.feed(f"{','.join(parts)},\r\n".encode())
    assert read[0].speeds == tuple(speeds)
    assert "-0.0" not in map(str, read[0].speeds)
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
    uncut = decoder.feed(good + b"\r\n")[0].speeds
    (reading,) = decoder.feed(good[:place] + good + b",\r\n")
    assert reading.speeds == uncut
    assert (decoder.refused, decoder.lines) == ({}, 2)


@pytest.mark.parametrize("chunk", [7, 10 * MAX_LINE])
@pytest.mark.parametrize(("excess", "read"), [(0, 1), (1, 0), (MAX_LINE, 0)])
def test_decoder_drops_lines_beyond_the_limit(excess: int, read: int, chunk: int) -> None:
    line = b"ap01.00".rjust(MAX_LINE + excess - 8, b"x") + b",bp02.00"
    stream = line + b"\n" + GOOD + b"\n"
    decoder = Decoder()
    readings = [
        r for i in range(0, len(stream), chunk) for r in decoder.feed(stream[i : i + chunk])
    ]
    dropped = {"unknown motor": 1} if read else {"line too long": 1}
    assert len(readings) == read + 1
    assert (readings[-1].speeds, decoder.refused) == (GOOD_SPEEDS, dropped)


def test_decoder_keeps_notes() -> None:
    decoder = Decoder()
    decoder.feed(b"# a cut: stalled\r\nap01.00\r\n# b cut\n# a cut: stalled\r\n# \xff\n")
    assert decoder.notes == ["b cut", "a cut: stalled", "\\xff"]
    assert (decoder.lines, decoder.refused, decoder.damaged) == (1, {}, 0)
    assert decoder.feed(b"#,bp02.00\n")[0].speeds == (None, 2.0, None, None)
    assert decoder.refused == {"unknown motor": 1}
    decoder.feed(b"".join(b"# %d\n" % number for number in range(100)))
    assert decoder.notes == [str(number) for number in range(92, 100)]
    decoder.reset()
    assert decoder.notes == []
