"""Messages about boards that don't answer, from the bytes that they sent, and about echoes."""

from __future__ import annotations

import contextlib

import pytest

from acsar_gym import RobotConfig
from acsar_gym.errors import BoardGarbledError, BoardSilentError, LinkError
from acsar_gym.links.handshake import check_no_echo, silence_error, wait_for_board
from acsar_gym.protocol import ECHO_PROBE, Decoder

ZEROS = b"ap00.00,bp00.00,cp00.00,dp00.00\r\n"


def refusal(*chunks: bytes) -> BoardSilentError:
    """The error if a board sends this and nothing more."""
    arriving = iter(chunks)
    with pytest.raises(BoardSilentError) as caught:
        wait_for_board(lambda: next(arriving, b""), "/dev/ttyX", RobotConfig(connect_timeout=0.05))
    assert "\n" not in str(caught.value)
    return caught.value


@pytest.mark.parametrize(
    ("chunk", "shown"),
    [(b"\xf1 0.50 \r\n", r"'\xf1 0.50 '"), (b"z" * 500, "'" + "z" * 40 + "'...")],
    ids=["another protocol", "long"],
)
def test_handshake_with_a_garbled_board_is_quoted_with_what_was_expected(
    chunk: bytes, shown: str
) -> None:
    error = refusal(chunk)
    assert type(error) is BoardGarbledError
    assert f"{shown}, expected ap12.50,bn08.75,cp15.00,dn10.25" in error.found
    assert "9600" in error.fix
    assert "'acsar-gym doctor /dev/ttyX'" in error.fix


def test_handshake_with_a_silent_or_interrupted_board() -> None:
    assert "no byte" in refusal().found
    assert "stopped in the middle of a line, 5 bytes" in refusal(b"ap00.").found


def test_handshake_accepts_unpadded_numbers() -> None:
    arriving = iter([b"3,dp0.00,\r\n", b"ap0.00,bp5.23,cp105.20,dp0.00,\r\n"])
    wait_for_board(lambda: next(arriving), "/dev/ttyX", RobotConfig())


class Board:
    """Answers each command with these lines, and sends feedback all the time."""

    def __init__(self, *answers: bytes, feedback: bytes = ZEROS) -> None:
        self._answer = b"".join(answers)
        self._feedback = feedback
        self._commands = 0

    def write(self, data: bytes) -> None:
        assert data.startswith(ECHO_PROBE)
        self._commands += 1

    def read(self) -> bytes:
        received = self._answer * self._commands + self._feedback
        self._commands = 0
        return received


@pytest.mark.parametrize(
    ("board", "echoes"),
    [
        (Board(), False),
        (Board(ZEROS, b"> " + ECHO_PROBE + b"\r", ZEROS), True),
        (Board(ECHO_PROBE + b"\r\n", feedback=b""), True),
    ],
    ids=["sound", "among feedback", "nothing but echo"],
)
def test_echo_is_refused(board: Board, echoes: bool) -> None:
    refused = pytest.raises(LinkError, match=r"^/dev/ttyX: this board echoes: .*delete the echo")
    with refused if echoes else contextlib.nullcontext():
        check_no_echo(board.write, board.read, "/dev/ttyX", RobotConfig())


@pytest.mark.parametrize("remainder", [b"ap05.00,bp0", b"ap05\r\nready, v1.2\r\n"])
def test_silence_of_a_board_that_was_reset(remainder: bytes) -> None:
    decoder = Decoder()
    decoder.feed(ZEROS * 10 + remainder)
    error = silence_error(0.5, decoder)
    assert type(error) is BoardSilentError
    assert "it was reset, hangs, or has lost its power" in error.found

    decoder.feed(b"ap0q.00,bp\xf10.00\r\n" * 20)
    assert type(silence_error(0.5, decoder)) is BoardGarbledError
