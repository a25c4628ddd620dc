"""What is said about boards that don't answer, from the bytes that they sent."""

from __future__ import annotations

import pytest

from acsar_gym import RobotConfig
from acsar_gym.errors import BoardGarbledError, BoardSilentError
from acsar_gym.links.handshake import wait_for_board

GOOD = b"ap00.00,bp00.00,cp00.00,dp00.00\r\n"


def refusal(*chunks: bytes) -> BoardSilentError:
    """The error where a board sends this and nothing more."""
    config = RobotConfig(connect_timeout=0.05)
    arriving = iter(chunks)
    with pytest.raises(BoardSilentError) as caught:
        wait_for_board(lambda: next(arriving, b""), "/dev/ttyX", config)
    return caught.value


@pytest.mark.parametrize("chunk", [b"ap12.50,bn0", b"4,cp15.00", b"5.00"])
def test_a_board_frozen_in_mid_line_is_silent(chunk: bytes) -> None:
    error = refusal(chunk)
    assert type(error) is BoardSilentError
    assert f"'{chunk.decode()}'" in error.found
    assert f"{len(chunk)} bytes" in error.found
    assert "baud" not in error.fix


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
