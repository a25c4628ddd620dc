"""Domain randomization of the single environment's robot."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.dynamics.drawing import SIZE, Drawn, draw, places
from acsar_gym.dynamics.model import physics
from acsar_gym.dynamics.numbers import Physics
from acsar_gym.dynamics.randomization import Randomization
from acsar_gym.dynamics.timing import substep
from acsar_gym.errors import ConfigError

Floats = NDArray[np.float64]


class Randomizer:
    """Draws the physics of one robot, episode by episode."""

    def __init__(self, given: Any, config: RobotConfig, step: float, *, simulated: bool) -> None:
        """Check the ranges.

        Args:
            given: As for `Randomization.of`.
            config: The robot.
            step: Duration of an env step [s].
            simulated: Whether the link is simulated, so that physics can vary.

        Raises:
            ConfigError: Physics can't vary on this link, or as `Randomization.of` and
                `Randomization.ranges`.
        """
        randomization = Randomization.of(given, config)
        self._names = randomization.names
        if self._names and not simulated:
            raise ConfigError(
                f"randomization of {', '.join(self._names)}: only a simulated robot's physics can "
                "vary, and this link is real or a recording"
            )
        ranges = randomization.ranges(config, step)
        self._low, self._high = np.array(ranges.low), np.array(ranges.high)
        self._delays = np.array(ranges.delays)
        self._nominal, self._dt = np.array(physics(config)), substep(config)
        self._drawn = Drawn()

    def draw(self, rng: np.random.Generator) -> Physics | None:
        """Draw the physics of an episode.

        Args:
            rng: the env's generator; one sample is taken for each number that varies.

        Returns:
            The physics; None where nothing varies.
        """
        if not self._names:
            return None
        samples, varies = np.zeros(SIZE), self._high > self._low
        samples[varies] = rng.random(int(varies.sum()))
        own, drawn = draw(self._nominal, self._low, self._high, self._delays, samples, self._dt)
        self._drawn = Drawn(*map(float, drawn))
        return Physics(*map(float, own))

    def info(self) -> dict[str, Any]:
        """What was drawn last, as applied: a float, or an array of four in the order of wheels."""
        return {f"drawn_{name}": _told(self._drawn, name) for name in self._names}


def _told(drawn: Drawn, name: str) -> float | Floats:
    """One parameter's value for info."""
    numbers = np.array([drawn[k] for k in places(name)])
    return float(numbers[0]) if len(numbers) == 1 else numbers
