"""Finds wheels that contradict their commands: dead, blocked, reversed, swapped or too fast.

The check needs no model of the motors, and it works from 5 lines of feedback a second. A wheel
contradicts its commands

- if it is at rest although they have had one direction for longer than its lag, or for longer than
  other wheels need to start,
- if its speed is outside the range of its recent commands, which a lag doesn't leave,
- if its axle turns the robot the other way, with one wheel too slow and one too fast.

`WheelCheck.tick` raises WheelError if that lasts for `WINDOW` and for `MIN_LINES` lines.
"""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.errors import WheelError
from acsar_gym.protocol import WHEELS, ZERO, Speeds

Numbers = NDArray[np.float64]
Mask = NDArray[np.bool_]

# How long a contradiction must last.
WINDOW = 0.13  # 0.15 s, of whose ends each may be 10 ms early or late [s]
MIN_LINES = 3
MIN_INTERVAL = 0.035  # lines that follow sooner aren't compared, to save time [s]

# What sound wheels do. Lags up to 0.3 s and deadbands up to 1.5 rad/s are published.
UNKNOWN_LAG = 0.45  # if none was measured: 0.3 s and half as much again [s]
UNKNOWN_DEADBAND = 1.7  # if none was measured: 1.5 rad/s and 10 % for the gain [rad/s]
SLOWER = 1.5  # lag and deadband may be larger than configured by this factor
MEMORY = 4.0  # lags in which the range of commands fades to a third, as ramps take their time
MAX_FACTOR = 1.4  # over the fastest command, as speed loops overshoot by a quarter
OVERSHOOT = 0.2  # share of the commands in the other direction by which reversals overshoot further
TOLERANCE = 0.3  # about a step of coarse feedback [rad/s]
UNEVEN = 0.2  # share of its speed by which unequal gains and lags turn a robot
CROSSED = 0.25  # share of an axle's commanded difference by which each of its wheels is wrong
PAUSE = 0.1  # boards may stop their wheels if no command comes for this long [s]

# When a wheel is at rest, and when it moves.
REST_SPEED = 0.3  # as `TOLERANCE` [rad/s]
REST_SHARE = 0.15  # of a command of two lags in one direction, as dead wheels roll on
MOVING_SPEED = 0.5  # shows that commands turn wheels [rad/s]
REVERSAL_SHARE = 0.5  # of the time counts if a wheel that reverses is at rest
START_TIME = 0.2  # time after which a wheel turns if others do that were commanded later [s]
APPROACH_SPEED = 0.15  # change towards the command that shows that a slow wheel moves [rad/s]
APPROACH_SHARE = 0.2  # share of the way to the command that shows the same of a fast wheel

# Six channels are checked: the wheels, and how fast each axle turns the robot, right minus left.
WHEEL = slice(4)
AXLE = slice(4, 6)
RIGHT = [0, 3]  # wheels of the front and of the rear axle
LEFT = [1, 2]
TO_CHANNELS = np.vstack([np.eye(4), [[1, -1, 0, 0], [0, 0, -1, 1]]])


class WheelCheck:
    """Compares the measured speeds of a robot's wheels with the commanded speeds.

    Args:
        config: Robot configuration.
        device: Device that error messages name.
    """

    def __init__(self, config: RobotConfig, device: str = "DEVICE") -> None:
        self._device = device
        self._pause = max(PAUSE, 2.5 * config.period)
        motors = [config.motor.of_wheel(number) for number in range(len(WHEELS))]
        self._gains = np.array([motor.gain for motor in motors])
        measured = " ".join(config.measured)

        lag = SLOWER * max(motor.time_constant for motor in motors)
        lag += config.firmware.command_delay + max(config.firmware.delay_samples, default=0.0)
        self._lag = lag if "motor.time_constant" in measured else max(lag, UNKNOWN_LAG)
        reversal = 2.0 * config.max_linear / config.wheel_radius
        self._ramp = reversal / min(motor.acceleration for motor in motors)

        # The speeds that coarse encoders send are whole counts.
        one_count = 2.0 * np.pi / (config.encoder.counts_per_revolution * config.encoder.window)
        deadband = SLOWER * max(motor.deadband for motor in motors)
        is_known = "motor.deadband" in measured
        unknown = MOVING_SPEED if is_known else UNKNOWN_DEADBAND
        self._deadband = max(deadband, unknown, one_count)
        self._tolerance = max(TOLERANCE, one_count)
        self.reset()

    def reset(self) -> None:
        """Forget all commands and lines: the wheels are at rest."""
        self._since_line = 0.0
        self._sent = ZERO
        self._expected = np.zeros(len(TO_CHANNELS))
        self._lowest = self._expected.copy()
        self._highest = self._expected.copy()

        # For how long commands have had a direction beyond the deadband, and what was before.
        self._direction = self._steady = np.zeros(len(WHEELS))
        self._from_rest = np.ones(len(WHEELS), bool)
        self._before = deque([np.zeros((2, len(WHEELS)))] * 2, maxlen=2)

        # Contradictions: for how long they have lasted, and the speeds with which they started.
        self._lines = np.zeros(len(TO_CHANNELS), int)
        self._lasted = self._first = np.zeros(len(TO_CHANNELS))

    def tick(self, sent: Speeds, measured: Speeds, dt: float, *, fresh: bool) -> None:
        """Take command and feedback of one control period.

        Args:
            sent: Wheel speeds that were sent [rad/s].
            measured: Newest wheel speeds [rad/s].
            dt: Duration of the period [s].
            fresh: Whether a line arrived in it.

        Raises:
            WheelError: A wheel has contradicted its commands for too long.
        """
        if sent is not self._sent:
            self._sent = sent
            self._expected = TO_CHANNELS @ (self._gains * sent)
            self._widen(self._expected)
        if dt > self._pause:
            self._widen(0.0)
            self._direction = np.zeros(len(WHEELS))

        self._since_line += dt
        if fresh and self._since_line > MIN_INTERVAL:
            self._compare(TO_CHANNELS @ measured, self._since_line)
            self._since_line = 0.0

    def _widen(self, speeds: Numbers | float) -> None:
        """Add speeds to the range of recent commands."""
        self._lowest = np.minimum(self._lowest, speeds)
        self._highest = np.maximum(self._highest, speeds)

    def _compare(self, speeds: Numbers, passed: float) -> None:
        """Compare a line with the commands. `passed` is the time since the last line [s]."""
        lag = self._lag + passed  # a board may send the mean speed since the last line
        at_rest = self._find_at_rest(speeds[WHEEL], passed, lag)
        is_outside = self._find_outside(speeds[WHEEL]) & any(self._sent)
        is_crossed = self._find_crossed(speeds)
        self._add(speeds, np.append(at_rest | is_outside, is_crossed), at_rest, passed)
        is_certain = (self._lines >= MIN_LINES) & (self._lasted >= WINDOW)
        if is_certain.any():
            raise self._describe_fault(int(np.argmax(is_certain)), speeds)

        fade = passed / (MEMORY * lag + self._ramp)
        self._lowest += fade * (self._expected - self._lowest)
        self._highest += fade * (self._expected - self._highest)

    def _find_at_rest(self, speeds: Numbers, passed: float, lag: float) -> Mask:
        """Return which wheels are at rest, or roll on without power, and should turn by now."""
        commands = self._expected[WHEEL]
        direction = np.sign(commands) * (np.abs(commands) > self._deadband)
        keeps = direction == self._direction
        self._direction = direction
        self._steady = np.abs(direction) * (keeps * self._steady + passed)
        from_rest = (direction * self._before[0]).max(axis=0) < MOVING_SPEED
        self._from_rest = np.where(keeps, self._from_rest, from_rest)
        self._before.append(np.array([commands, speeds]))

        # A wheel that has started from rest shows how soon commands take effect.
        has_started = self._from_rest & (direction * speeds > MOVING_SPEED)
        start_time = max(START_TIME, self._steady[has_started].min(initial=lag))
        rolls_on = ~self._reverses() & (self._steady > 2.0 * lag)
        share = np.where(rolls_on, REST_SHARE, 0.0)
        slow = np.maximum(REST_SPEED, share * np.abs(commands))
        at_rest: Mask = (np.abs(speeds) < slow) & (self._steady >= start_time)
        return at_rest

    def _reverses(self) -> Mask:
        """Return which wheels pass through zero, as their recent commands have both directions."""
        reverses: Mask = self._lowest[WHEEL] * self._highest[WHEEL] < 0.0
        return reverses

    def _find_outside(self, speeds: Numbers) -> Mask:
        """Return which wheels have speeds outside the range of their commands."""
        forward = np.maximum(self._highest[WHEEL], 0.0)
        backward = np.maximum(-self._lowest[WHEEL], 0.0)
        is_slow = np.maximum(forward, backward) < self._deadband  # other wheels may drag it along
        forward[is_slow] = forward.max()
        backward[is_slow] = backward.max()

        ahead = MAX_FACTOR * forward + OVERSHOOT * backward + self._tolerance
        behind = MAX_FACTOR * backward + OVERSHOOT * forward + self._tolerance
        is_outside: Mask = (speeds > ahead) | (speeds < -behind)
        return is_outside

    def _find_crossed(self, speeds: Numbers) -> Mask:
        """Return which axles turn the robot the other way, as if their wheels were swapped."""
        turn = self._expected[AXLE]
        side = np.sign(turn)
        ends = side * np.array([self._lowest[AXLE], self._highest[AXLE]])
        fastest = max(self._highest[WHEEL].max(), -self._lowest[WHEEL].min())
        margin = max(UNEVEN * fastest + self._tolerance, self._deadband)
        is_commanded = (ends.min(axis=0) >= 0.0) & (ends.max(axis=0) >= margin)

        lack = self._expected - speeds
        turns_against = side * speeds[AXLE] < -margin
        errors = np.minimum(side * lack[RIGHT], -side * lack[LEFT])
        is_crossed: Mask = is_commanded & turns_against & (errors > CROSSED * np.abs(turn))
        return is_crossed

    def _add(self, speeds: Numbers, is_wrong: Mask, at_rest: Mask, passed: float) -> None:
        """Add a line to the contradictions. A channel that approaches its command starts again."""
        gap = self._expected - self._first
        approach = np.sign(gap) * (speeds - self._first)
        limit = APPROACH_SHARE * np.abs(gap)
        limit[WHEEL][at_rest] = APPROACH_SPEED
        counted = np.full(len(speeds), passed)
        counted[WHEEL][at_rest & self._reverses()] *= REVERSAL_SHARE

        goes_on = is_wrong & (self._lines > 0) & (approach <= limit)
        self._first = np.where(goes_on, self._first, speeds)
        self._lines = is_wrong * (1 + goes_on * self._lines)
        self._lasted = is_wrong * (counted + goes_on * self._lasted)

    def _describe_fault(self, channel: int, speeds: Numbers) -> WheelError:
        """Return the error for a channel whose speed contradicts its commands."""
        number = channel if channel < len(WHEELS) else RIGHT[channel - len(WHEELS)]
        speed = speeds[number]
        command = self._sent[number]
        which = WHEELS[number]
        if np.abs(speeds[WHEEL]).max() < MOVING_SPEED:
            which = "all wheels stand still"
        elif self._lines[AXLE][number // 2] > 0:
            which += f" answers {WHEELS[number ^ 1]}'s command"
        elif abs(speed) < max(REST_SPEED, REST_SHARE * abs(command)):
            which += " stands still"
        else:
            which += " turns too fast" if speed * command > 0.0 else " turns backward"

        wiring = f"lift the robot and run 'acsar-gym doctor {self._device} --spin'"
        if self._device.startswith("ros2"):
            wiring = "check ros2.joints in the robot's file"
        return WheelError(
            f"{which} ({command:.2f} rad/s commanded, {speed:.2f} measured for "
            f"{self._lasted[channel]:.2f} s)",
            f"{wiring}; check motors and encoders, or identify this robot "
            f"('acsar-gym identify {self._device}')",
            WHEELS[number],
        )
