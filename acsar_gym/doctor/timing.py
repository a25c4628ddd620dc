"""Measures how late the ticks of the control loop are on a device, compared with a bare loop.

The loop is the driver's own at the control rate, with zero commands only. It alternates every half
second with a bare loop of absolute sleeps in the same process. The computer delays both equally, so
the ratio shows what the driver adds.
"""

from __future__ import annotations

import math
import time
from bisect import bisect_left
from collections.abc import Iterator

import numpy as np

from acsar_gym.config import RobotConfig
from acsar_gym.doctor import host as realtime
from acsar_gym.doctor.timing_report import EDGES, Report
from acsar_gym.errors import ConfigError, LinkError, MissingExtraError, shown
from acsar_gym.links.lateness import Durations, Lateness
from acsar_gym.links.serial import SerialLink
from acsar_gym.policies import OnnxPolicy, Policy
from acsar_gym.robot import Robot
from acsar_gym.safety.rules import Reason
from acsar_gym.tasks import State
from acsar_gym.tasks.base import remembered
from acsar_gym.tasks.goal import PointGoal

BLOCK = 0.5
"""Duration of a block of either loop [s]; feedback waits in the device's buffer meanwhile."""
LONGEST = 86_400.0
"""Longest measurement [s]."""
SHORTEST_BLOCK = 5
"""Smallest number of ticks of a block."""
POLICY_RATE = 10.0
"""Approximate rate of the policy [Hz]."""


def examine(device: str | None, config: RobotConfig, duration: float) -> Report:
    """Run `measure` with the packaged policy; ConfigError without a device."""
    if device is None:
        raise ConfigError("--timing needs a device, as in: acsar-gym doctor /dev/ttyUSB0 --timing")
    return measure(device, config, duration)


def measure(
    device: str, config: RobotConfig, duration: float, policy: Policy | None = None
) -> Report:
    """Measure the timing with zero commands; the wheels never turn.

    Args:
        device: the serial device.
        config: configuration of the robot.
        duration: time of the control loop [s]; the bare loop takes as long again.
        policy: called ten times per second, its action isn't used; None for the packaged
            point_goal, if onnxruntime is installed.

    Raises:
        LinkError: as Robot.activate and Robot.drive, and for an emergency stop.
        ConfigError: `duration` isn't positive, or is longer than a day.
    """
    if not 0.0 < duration <= LONGEST:
        raise ConfigError(
            f"duration = {shown(duration)}: must be a positive number of seconds, at most "
            f"{LONGEST:,.0f}, a day"
        )
    link = _Stopwatch(device, config)
    loop = _ControlLoop(link, config, policy or _packaged())
    bare = _Sleeps(config.period)
    ticks = max(SHORTEST_BLOCK, round(BLOCK * config.control_rate))
    with loop.robot:
        loop.robot.drive(0.0, 0.0)
        begin, start = link.woke, loop.robot.decoder.lines
        for _ in range(math.ceil(duration * config.control_rate / ticks)):
            bare.run(ticks)
            loop.run(ticks)
        return _report(loop, bare, link.woke - begin, start)


def _report(loop: _ControlLoop, bare: _Sleeps, seconds: float, first_line: int) -> Report:
    """Build the report of both loops over `seconds`, counting lines from `first_line` on."""
    config, decoder, device = loop.robot.config, loop.robot.decoder, loop.device
    return Report(
        device=device,
        rate=config.control_rate,
        lateness=loop.record.lateness.summary(),
        bare=bare.record.lateness.summary(),
        histogram=tuple(loop.record.bars),
        bare_histogram=tuple(bare.record.bars),
        seconds=seconds,
        lines=decoder.lines - first_line,
        lines_expected=seconds * config.feedback_rate,
        refused=sum(decoder.refused.values()),
        feedback_age=loop.ages.spread(),
        cpu_share=loop.processor / loop.seconds,
        policy_time=loop.decision_times.spread() if loop.decision_times.count else None,
        findings=tuple(realtime.machine(device, config)),
    )


def _packaged() -> Policy | None:
    """Load the packaged policy, if onnxruntime is installed."""
    try:
        return OnnxPolicy("point_goal")
    except MissingExtraError:
        return None


class _Stopwatch(SerialLink):
    """A link that records when it woke up: it reads right after the deadline of a tick."""

    woke = 0.0

    def read_now(self) -> bytes:
        """Record the time, then read."""
        self.woke = time.monotonic()
        return super().read_now()


class _Record:
    """Lateness of the ticks of one loop, with a histogram."""

    def __init__(self, period: float) -> None:
        self.lateness = Lateness(period)
        self.bars = [0] * (len(EDGES) + 1)
        self._period = period

    def add(self, woke: float, deadline: float) -> float:
        """Count a tick; returns the next deadline, which restarts after a missed tick."""
        lateness = woke - deadline
        self.lateness.add(lateness)
        self.bars[bisect_left(EDGES, lateness)] += 1
        return (woke if lateness > self._period else deadline) + self._period


class _Sleeps:
    """The bare loop, which only sleeps until absolute deadlines."""

    def __init__(self, period: float) -> None:
        self.record = _Record(period)
        self._period = period

    def run(self, ticks: int) -> None:
        """Run a block of ticks."""
        deadline = time.monotonic() + self._period
        for _ in range(ticks):
            time.sleep(max(0.0, deadline - time.monotonic()))
            deadline = self.record.add(time.monotonic(), deadline)


class _ControlLoop:
    """The control loop with a policy whose actions aren't used."""

    def __init__(self, link: _Stopwatch, config: RobotConfig, policy: Policy | None) -> None:
        self.robot = Robot(link, config)
        self.device = link.device
        self.record = _Record(config.period)
        self.ages, self.decision_times = Durations(), Durations()
        self.processor = self.seconds = 0.0
        self._link = link
        self._period = config.period
        self._policy = policy
        self._decisions = _decisions(policy, self.robot) if policy else None
        self._ticks_per_step = max(1, round(config.control_rate / POLICY_RATE))
        if self._decisions is not None:
            next(self._decisions)  # the first one may compile, as a reset does in an episode

    def run(self, ticks: int) -> None:
        """Run a block; its first tick isn't measured, as it reads the feedback of the bare loop."""
        self._drive()
        deadline = self._link.woke + self._period
        begin, used = time.monotonic(), time.process_time()
        for number in range(ticks):
            if number % self._ticks_per_step == 0 and self._decisions is not None:
                self.decision_times.add(next(self._decisions))
            self._drive()
            deadline = self.record.add(self._link.woke, deadline)
            self.ages.add(self.robot.feedback_age)
        self.processor += time.process_time() - used
        self.seconds += time.monotonic() - begin

    def _drive(self) -> None:
        """Send a zero command; LinkError at an emergency stop."""
        self.robot.drive(0.0, 0.0)
        if self.robot.safety.reason is Reason.EMERGENCY_STOP:
            raise LinkError("emergency stop", "start again when all is well")


def _decisions(policy: Policy, robot: Robot) -> Iterator[float]:
    """Yield the duration of each decision of a policy, observation included [s]."""
    task, goal = PointGoal(), (2.0, 1.0)
    memory, action = remembered(task), (0.0, 0.0)
    top = (robot.config.max_linear, robot.config.max_angular)
    while True:
        begin = time.perf_counter()
        pose, twist = robot.odometry.pose, robot.odometry.twist
        state = State(pose=pose, twist=twist, action=action, goal=goal, max_twist=top)
        numbers = np.array(task.observe(state, memory), np.float32)
        linear, angular = policy(numbers).tolist()
        action = (linear, angular)
        yield time.perf_counter() - begin
