"""docs/protocol-vectors.json and docs/protocol.md against the host's codec."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from acsar_gym.config import LINE_BYTES
from acsar_gym.errors import CommandError
from acsar_gym.protocol import MAX_LINE, Decoder, encode

DOCS = Path(__file__).resolve().parents[1] / "docs"
VECTORS: dict[str, Any] = json.loads((DOCS / "protocol-vectors.json").read_text(encoding="ascii"))
PAGE = (DOCS / "protocol.md").read_text(encoding="utf-8")
SPEED = r"[pn][0-9]{2}\.[0-9]{2}"
LINE = re.compile(",".join(letter + SPEED for letter in "abcd") + r",?\r\n")
"""The page's ABNF."""
TERMINALS = {
    "motor-a": "%x61 value",
    "motor-b": "%x62 value",
    "motor-c": "%x63 value",
    "motor-d": "%x64 value",
    "direction": "%x70 / %x6E",
    "speed": '2DIGIT "." 2DIGIT',
}

Vector = dict[str, Any]


def named(section: str) -> pytest.MarkDecorator:
    """Run a test for each vector of a section."""
    return pytest.mark.parametrize("vector", VECTORS[section], ids=lambda vector: vector["name"])


def read(data: bytes, piece: int) -> list[list[float | None]]:
    """What the decoder reads of bytes that come in pieces."""
    decoder = Decoder()
    pieces = [data[start : start + piece] for start in range(0, len(data), piece)]
    return [list(reading.speeds) for data in pieces for reading in decoder.feed(data)]


@named("encode")
def test_encode_writes_the_vectors(vector: Vector) -> None:
    line = vector["line"]
    assert LINE.fullmatch(line)
    assert encode(vector["speeds"], trailing_comma=False) == line.encode()
    assert encode(vector["speeds"]) == line.replace("\r", ",\r").encode()


@named("encode_refused")
def test_encode_refuses_the_vectors(vector: Vector) -> None:
    with pytest.raises(CommandError):
        encode([float(speed) for speed in vector["speeds"]])


@named("decode")
def test_decoder_reads_the_vectors_in_any_pieces(vector: Vector) -> None:
    expected = vector.get("tolerant", vector["lines"])
    data = vector["bytes"].encode("latin-1")
    for piece in (1, 7, len(data)):
        assert read(data, piece) == expected


@named("decode_tolerant")
def test_decoder_reads_the_tolerant_vectors(vector: Vector) -> None:
    assert read(vector["bytes"].encode("latin-1"), 3) == vector["lines"]


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
