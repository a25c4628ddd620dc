"""What randomization has drawn for each robot, as a batch's info tells it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields

import numpy as np
from numpy.typing import NDArray

from acsar_gym.vector.kernel import layout
from acsar_gym.vector.randomization import Randomization

Floats = NDArray[np.float64]
_FIRST = layout.MASS


class Drawn:
    """An array for each key that is randomized, named "drawn_" and the key; see `Randomization`.

    One number for each robot, or four, in the order of the wheels. The arrays are read-only: those
    that were told once never change.
    """

    def __init__(self, ranges: Randomization, nominal: Floats, dt: float, robots: int) -> None:
        keys = [field.name for field in fields(ranges) if getattr(ranges, field.name) is not None]
        of = _values(nominal[_FIRST : layout.WISHED_WORLD, None], dt)
        self._of = {f"drawn_{key}": of[key] for key in keys}
        shapes = {f"drawn_{key}": (robots, 4) if key in WHEELS else (robots,) for key in keys}
        self.info: dict[str, Floats] = {name: np.zeros(shape) for name, shape in shapes.items()}

    def update(self, state: Floats, began: NDArray[np.bool_]) -> None:
        """Robots in the mask have begun an episode."""
        robots = np.flatnonzero(began) if self._of else ()
        if len(robots):
            rows = state[_FIRST : layout.WISHED_WORLD, robots]
            for name, of in self._of.items():
                told = self.info[name].copy()
                told[robots] = of(rows).T
                told.setflags(write=False)
                self.info[name] = told


WHEELS = "motor_gain", "motor_lag"
"""Drawn for each of the four wheels."""


def _values(own: Floats, dt: float) -> dict[str, Callable[[Floats], Floats]]:
    """Each key from rows of the state from MASS on; `own` are the configured rows."""
    mass, grip, radius = layout.MASS - _FIRST, layout.GRIP - _FIRST, layout.RADIUS - _FIRST
    gain, blend = layout.GAIN - _FIRST, layout.BLEND - _FIRST
    every, loops = layout.FEEDBACK_LOOPS - _FIRST, layout.COMMAND_LOOPS - _FIRST
    lags = own[blend : blend + 4]
    instant = bool((lags >= 1.0).any())  # motors without lag have none to vary
    own_lags = np.ones((4, 1)) if instant else np.log1p(-lags)

    def lag(rows: Floats) -> Floats:
        drawn: Floats = np.ones((4, rows.shape[1]))
        return drawn if instant else own_lags / np.log1p(-rows[blend : blend + 4])

    return {
        "mass": lambda rows: rows[mass] / own[mass],
        "friction": lambda rows: rows[grip] / rows[mass] * (own[mass] / own[grip]),
        "motor_gain": lambda rows: rows[gain : gain + 4],
        "motor_lag": lag,
        "deadband": lambda rows: rows[layout.DEADBAND - _FIRST],
        "wheel_radius": lambda rows: rows[radius] / own[radius],
        "latency": lambda rows: (rows[loops] - own[loops]) * dt,
        "feedback_rate": lambda rows: 1.0 / (rows[every] * dt),
        "dropped_lines": lambda rows: rows[layout.DROPPED - _FIRST],
    }
