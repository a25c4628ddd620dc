"""How many edges of the encoders the chip counts."""

from __future__ import annotations

from pathlib import Path

import firmware_tools
import numpy as np
import pytest
from firmware_tools import Script

from acsar_gym.protocol import encode

FULL_SPEED = 36.0


@pytest.mark.parametrize("channels", [2, 1], ids=["every edge", "channel A"])
def test_encoders_lose_no_edge_at_the_limit_that_the_compiler_allows(
    chip: str, tmp_path: Path, channels: int
) -> None:
    """All four wheels at 16,000 counts/s, in both directions, and a full line to the board."""
    counts = 2792
    elf, output = firmware_tools.build_changed(
        tmp_path,
        chip,
        COUNTS_PER_TURN=str(counts),
        ENCODER_CHANNELS=str(channels),
        MAX_SPEED=str(FULL_SPEED),
    )
    assert not output

    edges = counts * (3 - channels)
    options = ("--counts", str(edges), "--gain", "1.1,1.05,1.03,1.07")
    script = Script(chip, options, elf)
    speeds = (FULL_SPEED, -FULL_SPEED, -FULL_SPEED, FULL_SPEED)
    for tick in range(300):
        script.say(0.1 + tick / 100, encode(speeds) * 3)
    ran = script.run(3.1, tmp_path)

    board = [line for time, line in ran.feedback() if time > 2.1]
    true = [line for time, line in ran.states("speeds") if time > 2.1]
    assert len(board) == pytest.approx(100, abs=1)  # no loop is late
    assert np.mean(board, axis=0) == pytest.approx(np.mean(true, axis=0), abs=0.01)
    assert np.mean(true, axis=0) == pytest.approx(speeds, abs=0.01)
    assert ran.figures["busy"] < 0.95
