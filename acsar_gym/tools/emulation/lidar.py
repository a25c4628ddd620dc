"""Emulates LiDARs on serial devices: a turning head without any I/O, and a pseudo-terminal."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Self

import numpy as np
from numpy.typing import NDArray

from acsar_gym.errors import ConfigError
from acsar_gym.tools.emulation.cable import EmulatedCable

Floats = NDArray[np.float64]
Look = Callable[[Floats, Floats], Floats]
"""Ranges [m] at bearings (N,) [rad] in the sensor's frame, counter-clockwise, each measured so long
(N,) before the end of the period [s]."""
WOBBLE_TURNS = 10.0
"""Turns in which a wobbling head gets faster and slower once."""


class LidarTwin:
    """The head of an emulated LiDAR; subclasses speak a maker's language.

    Time passes only in `advance`. Devices measure at a constant rate, whatever the speed of their
    head, which turns clockwise; those with `even_angles` at constant angles.

    Attributes: `running`, whether its motor runs; `scanning`, whether it sends measurements;
    `turns`, how many turns it has begun while it did.

    Args:
        look: returns the ranges.
        rate: turns per second [Hz].
        samples: measurements per turn.
        max_range: ranges beyond it [m], inf and NaN count as failed measurements.
        spin_up: time from the start of the motor to full speed [s].
        wobble: share by which its speed rises and falls.

    Raises:
        ConfigError: rate, samples, max_range or wobble is out of range.
    """

    even_angles = False
    farthest_range = math.inf
    """Largest distance that a measurement can encode [m]."""

    def __init__(
        self,
        look: Look,
        *,
        rate: float = 5.5,
        samples: int = 360,
        max_range: float = 12.0,
        spin_up: float = 0.0,
        wobble: float = 0.0,
    ) -> None:
        if not (
            0.0 < rate < math.inf
            and 0.0 < max_range <= self.farthest_range
            and samples > 0
            and 0.0 <= wobble < 1.0
        ):
            raise ConfigError(
                f"rate = {rate} Hz, samples = {samples}, max_range = {max_range} m: must be "
                f"positive, max_range at most {self.farthest_range:g} m, and wobble = {wobble} "
                "from 0 to below 1"
            )
        self._look = look
        self._rate = rate
        self._samples = samples
        self._max_range = max_range
        self._spin_up = spin_up
        self._wobble = wobble
        self.running = self.scanning = True
        self._forced = False
        """Whether it measures at rest as well."""
        self._now = self._spun = self._due = 0.0
        self._count = self.turns = 0
        """Measurements since it began to turn."""

    def receive(self, data: bytes) -> bytes:
        """Process bytes from the host."""
        return b""

    def encode(self, degrees: Floats, ranges: Floats, starts: NDArray[np.bool_]) -> bytes:
        """Encode measurements.

        Args:
            degrees: of the head, (N,), from its zero, as it turns.
            ranges: (N,) [m]; 0 where nothing was measured.
            starts: (N,), whether each is the first one of a turn.
        """
        raise NotImplementedError

    def advance(self, dt: float) -> bytes:
        """Let `dt` [s] pass.

        Returns:
            The measurements that were made, or became complete, during this time.
        """
        pace = self._rate * self._samples
        if self.even_angles:
            pace *= self.speed / self._rate
        self._now += dt
        self._due += dt * pace
        count = int(self._due + 1e-9)
        self._due -= count
        turning = self.running and self._spun >= self._spin_up
        if self.running:
            self._spun += dt
        numbers = self._count + np.arange(count + 1) * turning
        self._count = int(numbers[-1])
        if not (self.scanning and (turning or self._forced) and count):
            return b""
        turns = numbers / self._samples
        if self._wobble and not self.even_angles:
            share = 2.0 * np.pi / WOBBLE_TURNS
            turns = turns + self._wobble / share * np.sin(turns * share)
        whole = np.floor(turns)
        degrees = (turns - whole)[1:] * 360.0
        ages: Floats = (np.arange(count, dtype=np.float64)[::-1] + self._due) / pace
        starts = np.diff(whole) > 0.0
        self.turns += int(starts.sum())
        return self.encode(degrees, self.measure(degrees, ages), starts)

    def measure(self, degrees: Floats, ages: Floats) -> Floats:
        """Measure ranges (N,) [m] with the head at these angles; 0 where nothing is measured."""
        ranges = self._look(-np.radians(degrees), ages)
        return np.where((ranges > 0.0) & (ranges <= self._max_range), ranges, 0.0)

    @property
    def speed(self) -> float:
        """Turns per second [Hz]."""
        share = 2.0 * math.pi / WOBBLE_TURNS
        return self._rate * (1.0 + self._wobble * math.cos(self._now * self._rate * share))


class LidarEmulator:
    """An emulated LiDAR on a pseudo-terminal; call `serve_once` periodically.

    Raises:
        ConfigError: for unknown baud rates.
    """

    def __init__(self, twin: LidarTwin, *, baud: int = 115200) -> None:
        self.twin = twin
        self._cable = EmulatedCable(baud)
        self.device = self._cable.device

    def serve_once(self, period: float) -> None:
        """Process requests, let `period` [s] pass, and send answers and measurements.

        It doesn't block; data that nobody reads is dropped, as on a UART.
        """
        request = self._cable.over_uart(self._cable.read())
        answer = self.twin.receive(request) + self.twin.advance(period)
        if answer:
            self._cable.write(self._cable.over_uart(answer))

    def close(self) -> None:
        """Close the terminal. Idempotent."""
        self._cable.pull()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
