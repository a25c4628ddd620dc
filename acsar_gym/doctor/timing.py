"""How late the control loop's ticks are over a device, next to a bare loop, and what to change.

The loop is the driver's own at the control rate, and all it ever commands is zero. It takes turns
with a bare loop of absolute sleeps in this process, half a second each: what the machine does to
both is the same, so the ratio says what the driver adds.
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
"""Each loop's turn [s]; what arrives meanwhile waits in the device's buffer."""
LONGEST = 86_400.0
"""Of a measurement [s]."""
SHORTEST_BLOCK = 5
"""Ticks of a turn, at least."""
POLICY_RATE = 10.0
"""About how often the policy is asked [Hz]."""


def examine(device: str | None, config: RobotConfig, duration: float) -> Report:
    """`measure` with the packaged policy; ConfigError without a device."""
    if device is None:
        raise ConfigError("--timing needs a device, as in: acsar-gym doctor /dev/ttyUSB0 --timing")
    return measure(device, config, duration)


def measure(
    device: str, config: RobotConfig, duration: float, policy: Policy | None = None
) -> Report:
    """Drive zero commands for `duration` [s], and a bare loop for as long in between.

    The wheels never turn. `policy` is asked ten times a second, as in an episode, and its answer
    dropped; without one it is the packaged point_goal, where onnxruntime is installed.

    Raises LinkError as `Robot.activate` and `Robot.drive`, or at an emergency stop, and ConfigError
    for a duration that isn't a positive number, or is longer than a day.
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
    """What both loops have measured in so many seconds, since the line with this number."""
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
        policy_time=loop.thinking.spread() if loop.thinking.count else None,
        findings=tuple(realtime.machine(device, config)),
    )


def _packaged() -> Policy | None:
    try:
        return OnnxPolicy("point_goal")
    except MissingExtraError:
        return None


class _Stopwatch(SerialLink):
    """Notes when it last woke up: it reads as soon as a tick's deadline has passed."""

    woke = 0.0

    def read_now(self) -> bytes:
        self.woke = time.monotonic()
        return super().read_now()


class _Record:
    """Lateness of the ticks of one loop, and the histogram's bars."""

    def __init__(self, period: float) -> None:
        self.lateness = Lateness(period)
        self.bars = [0] * (len(EDGES) + 1)
        self._period = period

    def add(self, woke: float, deadline: float) -> float:
        """Count one; the next deadline, which starts anew after a missed tick, as the link's do."""
        lateness = woke - deadline
        self.lateness.add(lateness)
        self.bars[bisect_left(EDGES, lateness)] += 1
        return (woke if lateness > self._period else deadline) + self._period


class _Sleeps:
    """The bare loop: nothing but sleeps until absolute deadlines."""

    def __init__(self, period: float) -> None:
        self.record = _Record(period)
        self._period = period

    def run(self, ticks: int) -> None:
        deadline = time.monotonic() + self._period
        for _ in range(ticks):
            time.sleep(max(0.0, deadline - time.monotonic()))
            deadline = self.record.add(time.monotonic(), deadline)


class _ControlLoop:
    """The driver at the control rate, and a policy that nobody obeys."""

    def __init__(self, link: _Stopwatch, config: RobotConfig, policy: Policy | None) -> None:
        self.robot = Robot(link, config)
        self.device = link.device
        self.record = _Record(config.period)
        self.ages, self.thinking = Durations(), Durations()
        self.processor = self.seconds = 0.0
        self._link = link
        self._period = config.period
        self._policy = policy
        self._thoughts = _thoughts(policy, self.robot) if policy else None
        self._ticks_per_step = max(1, round(config.control_rate / POLICY_RATE))
        if self._thoughts is not None:
            next(self._thoughts)  # the first one may compile, which an episode does at its reset

    def run(self, ticks: int) -> None:
        """The first tick reads what came in the bare loop's turn, and isn't measured."""
        self._drive()
        deadline = self._link.woke + self._period
        begin, used = time.monotonic(), time.process_time()
        for number in range(ticks):
            if number % self._ticks_per_step == 0 and self._thoughts is not None:
                self.thinking.add(next(self._thoughts))
            self._drive()
            deadline = self.record.add(self._link.woke, deadline)
            self.ages.add(self.robot.feedback_age)
        self.processor += time.process_time() - used
        self.seconds += time.monotonic() - begin

    def _drive(self) -> None:
        self.robot.drive(0.0, 0.0)
        if self.robot.safety.reason is Reason.EMERGENCY_STOP:
            raise LinkError("emergency stop", "start again when all is well")


def _thoughts(policy: Policy, robot: Robot) -> Iterator[float]:
    """How long each decision on the way to a goal takes [s], observation included."""
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
