"""What randomization has drawn for each robot, as a batch's info tells it."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
from numpy.typing import NDArray

from acsar_gym.kernel import layout
from acsar_gym.randomization import Randomization

Floats = NDArray[np.float64]
WHEELS = {"motor_gain", "motor_lag"}
"""Drawn for each of the four wheels."""


class Drawn:
    """An array for each key that is randomized, named "drawn_" and the key; see `Randomization`.

    One number for each robot, or four, in the order of the wheels.
    """

    def __init__(self, ranges: Randomization, nominal: Floats, dt: float, robots: int) -> None:
        keys = [field.name for field in fields(ranges) if getattr(ranges, field.name) is not None]
        self._arrays = {key: np.zeros((robots, 4) if key in WHEELS else robots) for key in keys}
        self._nominal = nominal
        self._dt = dt
        self.names = tuple(f"drawn_{key}" for key in keys)

    def update(self, state: Floats, began: NDArray[np.bool_]) -> None:
        """Robots in the mask have begun an episode."""
        if self._arrays and began.any():
            robots = np.flatnonzero(began)
            values = self._values(state[layout.MASS : layout.WISHED_WORLD, robots])
            for key, array in self._arrays.items():
                array[robots] = values[key].T

    def info(self) -> dict[str, Floats]:
        """Copies of the arrays."""
        return {name: a.copy() for name, a in zip(self.names, self._arrays.values(), strict=True)}

    def _values(self, rows: Floats) -> dict[str, Floats]:
        """All keys, from rows of the state from MASS on, as they are applied."""

        def of(first: int, count: int = 1) -> tuple[Floats, Floats]:
            """The drawn and the configured values of some rows."""
            at = slice(first - layout.MASS, first - layout.MASS + count)
            nominal = self._nominal[first : first + count, None]
            return (rows[at][0], nominal[0]) if count == 1 else (rows[at], nominal)

        (mass, own_mass), (grip, own_grip) = of(layout.MASS), of(layout.GRIP)
        (blend, own_blend), (radius, own_radius) = of(layout.BLEND, 4), of(layout.RADIUS)
        loops, own_loops = of(layout.COMMAND_LOOPS)
        with np.errstate(divide="ignore", invalid="ignore"):  # motors without lag have none to vary
            lag = np.where(own_blend < 1.0, np.log(1.0 - own_blend) / np.log(1.0 - blend), 1.0)
        return {
            "mass": mass / own_mass,
            "friction": grip / own_grip / (mass / own_mass),
            "motor_gain": of(layout.GAIN, 4)[0],
            "motor_lag": lag,
            "deadband": of(layout.DEADBAND)[0],
            "wheel_radius": radius / own_radius,
            "latency": (loops - own_loops) * self._dt,
            "feedback_rate": 1.0 / (of(layout.FEEDBACK_LOOPS)[0] * self._dt),
            "dropped_lines": of(layout.DROPPED)[0],
        }
