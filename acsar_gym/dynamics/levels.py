"""Three levels of domain randomization for one robot: narrow, as in training, and beyond that."""

from __future__ import annotations

from acsar_gym.config import RobotConfig
from acsar_gym.dynamics.measured import LEAST_TURN, Range, ranges
from acsar_gym.dynamics.model import turn_factor
from acsar_gym.dynamics.randomization import Randomization
from acsar_gym.errors import ConfigError, shown

WIDTHS = {1: 0.5, 2: 1.0, 3: 2.0}
"""Widths of the levels, relative to what `acsar-gym train` randomizes."""
LEAST_FACTOR = 0.05
"""Least factor of a range that is widened."""
FROM_ZERO = ("latency", "deadband_offset")
"""Parameters whose ranges are scaled about zero; those of factors are scaled about one."""


def level(config: RobotConfig, number: int) -> Randomization:
    """Return the randomization of a level: half, all, or twice of what a robot is trained with.

    Measured delays (`command_delay`, `delay_samples`) are the same on all levels.

    Args:
        config: the robot.
        number: 1, 2 or 3.

    Raises:
        ConfigError: there is no such level.
    """
    if number not in WIDTHS:
        raise ConfigError(f"randomization level {shown(number)}: must be 1, 2 or 3")
    least = LEAST_TURN / turn_factor(config)
    widened = {name: _scaled(name, width, WIDTHS[number]) for name, width in ranges(config).items()}
    low, high = widened["turn_factor"]
    return Randomization.of(widened | {"turn_factor": (max(low, least), high)})  # type: ignore[arg-type]


def _scaled(name: str, width: tuple[float, ...], scale: float) -> tuple[float, ...]:
    """Scale a range about one, or about zero."""
    if name in ("command_delay", "delay_samples"):
        return width
    if name in FROM_ZERO:
        return tuple(scale * end for end in width)
    low, high = (1.0 + scale * (end - 1.0) for end in width)
    narrowed: Range = (max(low, LEAST_FACTOR), high)
    return narrowed
