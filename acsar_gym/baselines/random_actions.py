"""Uniformly random actions: what no policy at all reaches."""

from __future__ import annotations

from acsar_gym.baselines.base import BaselinePolicy
from acsar_gym.policies.setting import Seen


class RandomActions(BaselinePolicy):
    """Draws every action anew, uniformly from the whole action space."""

    name = "random"

    def act(self, seen: Seen) -> tuple[float, float]:
        """Draw a velocity command [m/s, rad/s]."""
        linear, angular = self.rng.uniform(-1.0, 1.0, 2).tolist()
        config = self.setting.config
        return linear * config.max_linear, angular * config.max_angular
