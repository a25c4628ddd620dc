"""The doctor's examination of boards in simulated time."""

from __future__ import annotations

from collections.abc import Sequence

from boards import board

from acsar_gym import Link, RobotConfig
from acsar_gym.tools.commission.board_checks import BoardExamination
from acsar_gym.tools.commission.checks import Check
from acsar_gym.tools.commission.wiring import parse_seen

__all__ = ["board", "examined"]


def examined(
    link: Link, saw: Sequence[str] | None = None, config: RobotConfig | None = None
) -> tuple[BoardExamination, dict[str, Check]]:
    """Examine a board. Returns the examination and its rows by name."""
    turned = None if saw is None else parse_seen(saw)
    examination = BoardExamination(config or RobotConfig(), spin=True, seen=turned)
    return examination, {row.name: row for row in examination.run(link)}
