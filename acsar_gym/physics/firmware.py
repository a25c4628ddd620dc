"""An emulation of the microcontroller: bytes in, bytes out, over a Body, with a simulated clock.

It parses command lines by the same rules as the driver, ramps the motors' set points, stops the
motors when commands stop, and sends encoder lines at its own rate. The time that bytes take on the
UART (10 bits each at the baud rate, in sequence) and in the processor is simulated.
"""

from __future__ import annotations

import math
from collections import deque

from acsar_gym.config import BITS_PER_BYTE, RobotConfig
from acsar_gym.physics import Physics, compute_physics
from acsar_gym.physics.body import Body
from acsar_gym.physics.model import loop_period, ramp_set_points, read_encoders
from acsar_gym.protocol import ZERO, Decoder, Reading, Speeds, encode_line, line_end

TIME_EPSILON = 1e-9
"""Slack for comparing times that are sums of periods [s]."""


class Firmware:
    """An emulated board. `advance` lets time pass.

    Args:
        config: Robot configuration.
        body: Body that the board drives.

    Attributes:
        decoder: Decoder of commands, with counters of refused input.
        arrived: Lines that the newest `advance` returned, with the times of their last bytes [s].
    """

    def __init__(self, config: RobotConfig, body: Body) -> None:
        self.decoder = Decoder()
        self._body = body
        self._motors = config.wheels.motors
        self._encoders = config.wheels.encoders
        self._dt = loop_period(config)
        a, b, c, d = (config.motor.of_wheel(wheel).acceleration * self._dt for wheel in range(4))
        self._ramps: Speeds = (a, b, c, d)
        self._top: Speeds = (config.motor.max_speed,) * 4
        self._configured = compute_physics(config)

        self._line_end = line_end(trailing_comma=config.trailing_comma)
        self._byte_time = BITS_PER_BYTE / config.baud_rate
        self._processing = config.firmware.processing_time
        # A board without a time-out keeps the last command forever.
        self._timeout = config.firmware.command_timeout or math.inf

        # A ring of angles, of which the oldest is a window behind the newest.
        window = round(config.encoder.window * config.firmware.loop_rate)
        self._angles: deque[Speeds] = deque(maxlen=window + 1)
        self._per_radian = config.encoder.counts_per_revolution / (2.0 * math.pi)
        self._per_count = 1.0 / (self._per_radian * window * self._dt)
        self._quantum = config.encoder.quantum or 0.0
        self.reset()

    def reset(self, physics: Physics | None = None) -> None:
        """Reset to the state after power-up: nothing on the wire, set points and encoders zero."""
        physics = physics or self._configured
        # Latency delays both directions, the reaction only commands.
        self._latency = physics.latency_loops * self._dt
        self._reaction = self._processing + physics.command_delay + self._latency
        self._feedback_every = physics.feedback_loops

        self._elapsed = 0.0
        self._loops = 0
        self._lines = 0
        self._receive_free = 0.0
        self._send_free = 0.0
        self._received: deque[tuple[float, bytes]] = deque()
        self._sent: deque[tuple[float, bytes]] = deque()
        self.arrived: list[tuple[float, bytes]] = []
        self.decoder.reset()

        self._last_command = -math.inf
        self._targets: Speeds = ZERO
        self._set_points: Speeds = ZERO
        # With a ring full of the present angles, the first line reports wheels at rest.
        self._angles.extend([self._body.wheel_angles] * (self._angles.maxlen or 1))

    def receive(self, data: bytes) -> None:
        """Take bytes that the host sends now. They arrive in sequence."""
        # A UART is a queue: bytes wait until those before them are on the wire.
        start = max(self._receive_free, self._elapsed)
        self._receive_free = start + len(data) * self._byte_time
        self._received.append((self._receive_free + self._reaction, data))

    def advance(self, period: float) -> bytes:
        """Let time pass, and return the feedback bytes that reach the host meanwhile.

        Time that remains after whole firmware loops is added to the next period.
        """
        self._elapsed += period
        end = self._elapsed + TIME_EPSILON

        # By counting loops, and not by adding periods, rounding errors don't accumulate.
        while (self._loops + 1) * self._dt <= end:
            self._run_loop(self._loops * self._dt)

        self.arrived = []
        while self._sent and self._sent[0][0] <= end:
            self.arrived.append(self._sent.popleft())
        return b"".join([line for _, line in self.arrived])

    def _run_loop(self, now: float) -> None:
        """Run one loop: newest commands, ramps, motors, encoders, and a line if it is due."""
        while self._received and self._received[0][0] <= now + TIME_EPSILON:
            self._take_commands(self._received.popleft()[1], now)
        # If the host dies, its last command must not drive the wheels for long.
        if now - self._last_command > self._timeout + TIME_EPSILON:
            self._targets = ZERO
        if self._set_points != self._targets:
            self._set_points = ramp_set_points(self._set_points, self._targets, self._ramps)

        # Motors and tyres move, then the encoders are read.
        self._body.step(self._set_points)
        self._angles.append(self._body.wheel_angles)
        self._loops += 1
        # Loops between lines needn't be a whole number: a count of lines doesn't drift.
        if self._loops >= (self._lines + 1) * self._feedback_every - TIME_EPSILON:
            self._lines += 1
            self._send_line()

    def _take_commands(self, data: bytes, now: float) -> None:
        """Set the targets from command lines, limited to the top speed."""
        for reading in self.decoder.feed(data):
            self._last_command = now

            # A line may leave out wheels: their targets stay as they are.
            wheels = self._motors.to_wheels(reading.speeds) if self._motors else reading.speeds
            self._targets = ramp_set_points(ZERO, Reading(wheels).over(self._targets), self._top)

    def _send_line(self) -> None:
        """Send an encoder line: wheel speeds from the whole counts of the last window [rad/s]."""
        speeds = read_encoders(
            self._angles[0], self._angles[-1], self._per_radian, self._per_count, self._quantum
        )
        if self._encoders is not None:
            speeds = self._encoders.to_wire(speeds)
        line = encode_line(*speeds, self._line_end)

        # The line waits for the processing and for the line before it.
        start = max(self._send_free, self._loops * self._dt + self._processing)
        self._send_free = start + len(line) * self._byte_time
        self._sent.append((self._send_free + self._latency, line))
