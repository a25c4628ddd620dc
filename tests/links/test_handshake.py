"""What is said about boards that don't answer, from the bytes that they sent."""

from __future__ import annotations

import pytest

from acsar_gym import RobotConfig
from acsar_gym.errors import BoardGarbledError, BoardSilentError
from acsar_gym.links.handshake import describe_format, find_echo, silence_error, wait_for_board
from acsar_gym.protocol import ECHO_PROBE, Decoder

GOOD = b"ap00.00,bp00.00,cp00.00,dp00.00\r\n"


def refusal(*chunks: bytes) -> BoardSilentError:
    """The error where a board sends this and nothing more."""
    config = RobotConfig(connect_timeout=0.05)
    arriving = iter(chunks)
    with pytest.raises(BoardSilentError) as caught:
        wait_for_board(lambda: next(arriving, b""), "/dev/ttyX", config)
    return caught.value


@pytest.mark.parametrize(
    ("chunk", "shown"),
    [
        (b"\xf1\x80\x02\xff", r"'\xf1\x80\x02\xff'"),
        (b"left 0.50 right 0.51\r\n", "'left 0.50 right 0.51'"),
        (b"\x1b[31m\n", r"'\x1b[31m'"),
        (b"z" * 500, "'" + "z" * 40 + "'..."),
    ],
    ids=["noise", "another protocol", "control", "long"],
)
def test_a_garbled_board_is_shown(chunk: bytes, shown: str) -> None:
    error = refusal(chunk)
    assert type(error) is BoardGarbledError
    assert shown in error.found
    assert "9600" in error.fix
    assert "'acsar-gym doctor /dev/ttyX'" in error.fix
    assert "\n" not in str(error)


def test_a_board_that_does_not_pad_its_numbers_is_welcome() -> None:
    arriving = iter([b"3,dp0.00,\r\n", b"ap0.00,bp5.23,cp105.20,dp0.00,\r\n"])
    wait_for_board(lambda: next(arriving), "/dev/ttyX", RobotConfig())


class Echo:
    """A board that answers to each command with these lines; without one, with its feedback."""

    def __init__(self, *answers: bytes, feedback: bytes = GOOD) -> None:
        self._answers, self._feedback, self._commands = answers, feedback, 0

    def write(self, data: bytes) -> None:
        assert data.startswith(ECHO_PROBE)
        self._commands += 1

    def read(self) -> bytes:
        said = b"".join(self._answers) * self._commands + self._feedback
        self._commands = 0
        return said


@pytest.mark.parametrize(
    ("board", "echoes"),
    [
        (Echo(), False),
        (Echo(feedback=b""), False),
        (Echo(ECHO_PROBE + b"\r\n"), True),
        (Echo(b"> " + ECHO_PROBE + b",\n"), True),
        (Echo(GOOD, ECHO_PROBE + b"\r", GOOD), True),
    ],
    ids=["none", "silent", "echo", "with a prompt", "among feedback"],
)
def test_whether_a_board_echoes(board: Echo, echoes: bool) -> None:
    config = RobotConfig(connect_timeout=5.0)
    assert find_echo(board.write, board.read, "/dev/ttyX", config) is echoes


def test_a_board_that_only_echoes_is_refused() -> None:
    board = Echo(ECHO_PROBE + b"\r\n", feedback=b"")
    with pytest.raises(BoardSilentError, match="this board echoes, and sends nothing else"):
        find_echo(board.write, board.read, "/dev/ttyX", RobotConfig(connect_timeout=0.05))


@pytest.mark.parametrize(
    ("line", "differs"),
    [
        (b"AP12.50,BN08.75,CP15.00,DN10.25,", "upper-case letters"),
        (b"a+12.50,b-08.75,c+15.00,d-10.25", "signs instead of p and n"),
        (b"A+12.50,B-8.75,C+15.00,D-10.25", "upper-case letters and signs instead of p and n"),
        (b"ap12.5,bn8.7,cp15.0,dn10.2", "one decimal"),
        (b"ap12,bn8,cp15,dn0,", "no decimals"),
        (b"ap12,50,bn08,75,cp15,00,dn10,25", "decimal commas"),
        (b"ap12.50;bn08.75;cp15.00;dn10.25", "other separators than commas"),
        (b"a=12.50,b=08.75,c=15.00,d=10.25", "equals signs or colons and no p or n"),
        (b"rp10.00,ln10.00,", "two wheels, r and l, where this robot has four, a to d"),
    ],
)
def test_what_differs_in_a_line_is_said(line: bytes, differs: str) -> None:
    assert describe_format(line) == differs
    error = refusal(line + b"\r\n")
    assert type(error) is BoardSilentError
    assert f"the board's lines have {differs}: '{line[:20].decode()}" in error.found
    assert "ap12.50,bn08.75" in error.fix
    assert "baud" not in str(error)


@pytest.mark.parametrize("rest", [b"ap05.00,bp0", b"ap05.0\x00\xf8", b"ap05\r\nready, v1.2\r\n"])
def test_a_board_that_is_reset_in_a_drive_is_no_bad_cable(rest: bytes) -> None:
    decoder = Decoder()
    decoder.feed(GOOD * 10 + rest)
    error = silence_error(0.5, decoder)
    assert type(error) is BoardSilentError
    assert "it was reset, hangs, or has lost its power" in error.found
    assert "baud" not in str(error)
    decoder.feed(b"ap0q.00,bp\xf10.00\r\n" * 20)
    assert type(silence_error(0.5, decoder)) is BoardGarbledError
