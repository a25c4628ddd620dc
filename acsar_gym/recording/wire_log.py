"""The bytes of a wire, both ways, with the time of each piece; and what their lines say."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.config.wheels import Letters
from acsar_gym.protocol import ZERO, Decoder, Reading, Speeds

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class WireLog:
    """What was written to a robot's wire and what arrived, on the link's clock."""

    sent_stamps: Floats
    """(n,): when each write was done [s]."""
    sent: tuple[bytes, ...]
    """The bytes of each write."""
    got_stamps: Floats
    """(m,): when each piece arrived, i.e. the time of its last byte [s]."""
    got: tuple[bytes, ...]
    """The bytes of each piece."""

    def commands(self, config: RobotConfig) -> tuple[Floats, Floats]:
        """Decode what was sent.

        Args:
            config: of the robot.

        Returns:
            Stamps [s], (n,), and speeds [rad/s] of the logical wheels, (n, 4): one row for each
            complete line.
        """
        return _decoded(self.sent_stamps, self.sent, config.wheels.motors)

    def feedback(self, config: RobotConfig) -> tuple[Floats, Floats]:
        """Decode what arrived.

        Args:
            config: of the robot.

        Returns:
            Stamps of each line's last byte [s], (k,), and speeds [rad/s] of the logical wheels,
            (k, 4). A wheel that a line doesn't name keeps its last speed.
        """
        return _decoded(self.got_stamps, self.got, config.wheels.encoders)


def _decoded(
    stamps: Floats, pieces: Sequence[bytes], letters: Letters | None
) -> tuple[Floats, Floats]:
    """Decode pieces of a byte stream; each line gets the stamp of the piece that ends it."""
    decoder, speeds = Decoder(), ZERO
    when: list[float] = []
    rows: list[Speeds] = []
    for stamp, piece in zip(stamps.tolist(), pieces, strict=True):
        for each in decoder.feed(piece):
            reading = Reading(letters.to_wheels(each.speeds)) if letters else each
            speeds = reading.over(speeds)
            when.append(stamp)
            rows.append(speeds)
    return np.array(when, np.float64), np.array(rows, np.float64).reshape(-1, 4)
