"""What a LiDAR hands over."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class Revolution(NamedTuple):
    """One turn of a LiDAR's head, in the order in which it was measured."""

    bearings: NDArray[np.float64]
    """(n,): counter-clockwise from the LiDAR's zero, which points along the robot's x axis [rad]."""
    distances: NDArray[np.float64]
    """(n,): [m]; 0 where nothing was measured."""
    times: NDArray[np.float64]
    """(n,): when each was taken, on the clock of the robot's link [s]."""
    stamp: float
    """When the revolution ended, on that clock [s]."""
