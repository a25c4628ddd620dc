"""Turn towards the goal, then drive to it: the simplest law that reaches every goal in sight."""

from __future__ import annotations

from acsar_gym.baselines.base import BaselinePolicy
from acsar_gym.policies.setting import GOAL, Seen

AIMED = 0.35
"""It turns on the spot while the goal's bearing is larger than this [rad]."""
GAIN = 2.5
"""Yaw rate for a bearing of 1 rad [1/s]."""


class TurnDrive(BaselinePolicy):
    """Turns on the spot until the goal lies ahead, then drives at full speed and keeps it there."""

    name = "turn_drive"
    needs = GOAL

    def act(self, seen: Seen) -> tuple[float, float]:
        """Return the velocity command [m/s, rad/s]."""
        top = 0.0 if abs(seen.bearing) > AIMED else self.setting.config.max_linear
        return top, GAIN * seen.bearing
