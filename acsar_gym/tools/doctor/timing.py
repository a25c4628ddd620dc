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
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from rich.table import Table

from acsar_gym.config import RobotConfig
from acsar_gym.errors import BUSY_HINT, ConfigError, LinkError, MissingExtraError, show_value
from acsar_gym.links.lateness import (
    DurationHistogram,
    DurationSpread,
    LatenessHistogram,
    TickTiming,
)
from acsar_gym.links.serial import SerialLink
from acsar_gym.robot import Robot
from acsar_gym.safety.rules import Reason
from acsar_gym.tasks import State
from acsar_gym.tasks.base import new_memory
from acsar_gym.tasks.goal import PointGoal
from acsar_gym.tools.doctor import host as realtime
from acsar_gym.tools.doctor.checks import STATUS_MARKS, Check
from acsar_gym.tools.policies import OnnxPolicy, Policy

# The report of `doctor --timing`.

HISTOGRAM_EDGES = (2e-5, 5e-5, 1e-4, 2e-4, 5e-4, 1e-3, 2e-3, 5e-3, 0.01, 0.02, 0.05, 0.1)
"""Upper edges of the histogram's bins [s]; the last bin has none."""
LONGEST_BAR = 24
"""Length of the longest bar [characters]."""

MAX_LATE_SHARE = 0.001
"""Share of late ticks above which the report warns."""
MAX_P99_RATIO = 2.0
"""Ratio of the 99th percentiles, to the bare loop's, above which it warns."""
MAX_CPU_SHARE = 0.05
"""Share of a core above which it warns."""
MIN_LINE_SHARE = 0.99
"""Share of the expected feedback lines below which it warns."""


@dataclass(frozen=True, slots=True)
class TimingReport:
    """Results of the measurement. Times in s."""

    device: str
    rate: float
    """Ticks per second [Hz]."""
    lateness: TickTiming
    """Lateness of the control loop: time from a tick's deadline to its wake-up."""
    bare: TickTiming
    """Lateness of the bare loop."""
    histogram: tuple[int, ...]
    """Ticks per bin of EDGES, with one more bin above the last edge."""
    bare_histogram: tuple[int, ...]
    seconds: float
    """Time from the first to the last tick, with the blocks of the bare loop."""
    lines: int
    """Valid feedback lines during this time."""
    lines_expected: float
    """Lines expected by the configured feedback rate; a board's clock can be off by 1 %."""
    refused: int
    """Damaged parts of lines."""
    feedback_age: DurationSpread
    """Age of the newest line after a tick; 0 if it arrived during the tick."""
    cpu_share: float
    """CPU time of the control loop, as a share of one core."""
    policy_time: DurationSpread | None
    """Duration of a decision of the policy; None without a policy."""
    findings: tuple[Check, ...]
    """Results of the checks of computer and adapter."""

    @property
    def ratio(self) -> float:
        """99th percentile of lateness, divided by that of the bare loop."""
        return self.lateness.p99 / max(self.bare.p99, 1e-6)

    @property
    def lost_lines(self) -> int:
        """Number of missing lines; one at either end isn't counted."""
        return max(0, math.floor(self.lines_expected) - 2 - self.lines)

    @property
    def figures(self) -> list[Check]:
        """Judge the measurement; round trips can't be measured without turning wheels."""
        return [
            self._late(),
            self._against_bare(),
            self._feedback(),
            self._age(),
            self._processor(),
            Check("round trip", "skip", "needs turning wheels", "acsar-gym doctor DEVICE --spin"),
        ]

    def _late(self) -> Check:
        """Judge the share of late ticks."""
        late = self.lateness
        bad = late.late_share > MAX_LATE_SHARE
        return Check(
            "late ticks",
            "warn" if bad else "ok",
            f"{late.late_ticks} of {late.ticks} over 1 ms ({late.late_share:.2%}), "
            f"{late.missed_ticks} missed",
            f"{BUSY_HINT}; see the computer below" if bad else "",
        )

    def _against_bare(self) -> Check:
        """Judge the lateness in comparison with the bare loop."""
        bad = self.ratio > MAX_P99_RATIO
        return Check(
            "lateness",
            "warn" if bad else "ok",
            f"p50 {_ms(self.lateness.p50)}, p99 {_ms(self.lateness.p99)}, worst "
            f"{_ms(self.lateness.worst)}; p99 is {self.ratio:.2f} times a bare loop's",
            "a policy that takes longer than a tick, or a blocking driver" if bad else "",
        )

    def _feedback(self) -> Check:
        """Judge the number of feedback lines."""
        few = self.lines < MIN_LINE_SHARE * self.lines_expected - 2.0
        return Check(
            "feedback lines",
            "warn" if few or self.refused else "ok",
            f"{self.lines} of {self.lines_expected:.0f} expected, {self.lost_lines} lost, "
            f"{self.refused} bad parts",
            "check the cable; is firmware.feedback_rate what the board sends?"
            if few or self.refused
            else "",
        )

    def _age(self) -> Check:
        """Report the age of the feedback."""
        age = self.feedback_age
        return Check(
            "feedback age",
            "ok",
            f"p50 {_ms(age.p50)}, p99 {_ms(age.p99)}, worst {_ms(age.worst)}",
        )

    def _processor(self) -> Check:
        """Judge the CPU time."""
        bad = self.cpu_share > MAX_CPU_SHARE
        policy = self.policy_time
        thinking = f"policy {_ms(policy.p50)} a step" if policy else "no policy: no onnxruntime"
        return Check(
            "processor",
            "warn" if bad else "ok",
            f"{self.cpu_share:.1%} of a core; {thinking}",
            "use a lower control_rate or a smaller policy" if bad else "",
        )

    def tables(self) -> list[Table]:
        """Format histogram, figures and advice as tables."""
        return [
            self._drawn(),
            _checks("the control loop", self.figures),
            _checks("the computer", self.findings),
        ]

    def _drawn(self) -> Table:
        """Format both histograms as a table."""
        title = f"lateness of {self.lateness.ticks} ticks at {self.rate:g} Hz over {self.device}"
        drawn = Table(title=title, title_justify="left", caption="Bars are logarithmic.")
        drawn.add_column("up to", justify="right")
        for column in ("control loop", "bare loop"):
            drawn.add_column("ticks", justify="right")
            drawn.add_column(column, width=LONGEST_BAR)
        counts = list(zip(self.histogram, self.bare_histogram, strict=True))
        used = [number for number, pair in enumerate(counts) if any(pair)]
        most = max(map(max, counts))
        for number in range(used[0], used[-1] + 1):
            edge = (
                f"{HISTOGRAM_EDGES[number] * 1000.0:g} ms"
                if number < len(HISTOGRAM_EDGES)
                else "more"
            )
            own, bare = counts[number]
            drawn.add_row(edge, f"{own}", _bar(own, most), f"{bare}", _bar(bare, most))
        return drawn

    def as_dict(self) -> dict[str, Any]:
        """Return everything for JSON."""
        return asdict(self) | {
            "edges": HISTOGRAM_EDGES,
            "late_share": self.lateness.late_share,
            "p99_ratio": self.ratio,
            "lost_lines": self.lost_lines,
            "round_trip": None,
            "figures": [asdict(check) for check in self.figures],
        }


def _ms(seconds: float) -> str:
    return f"{seconds * 1000.0:.2f} ms"


def _bar(count: int, most: int) -> str:
    return "█" * math.ceil(LONGEST_BAR * math.log1p(count) / math.log1p(most))


def _checks(title: str, checks: tuple[Check, ...] | list[Check]) -> Table:
    """Format check results as a table."""
    drawn = Table(title=title, title_justify="left")
    for column in ("", "", "found", "what to change"):
        drawn.add_column(column, overflow="fold")
    for check in checks:
        drawn.add_row(check.name, STATUS_MARKS[check.status], check.found, check.fix)
    return drawn


BLOCK_TIME = 0.5
"""Duration of a block of either loop [s]; feedback waits in the device's buffer meanwhile."""
LONGEST_MEASUREMENT = 86_400.0
"""Longest measurement [s]."""
SHORTEST_BLOCK = 5
"""Smallest number of ticks of a block."""
DECISION_RATE = 10.0
"""Approximate rate of the policy [Hz]."""


def examine_timing(device: str | None, config: RobotConfig, duration: float) -> TimingReport:
    """Run `measure` with the packaged policy; ConfigError without a device."""
    if device is None:
        raise ConfigError("--timing needs a device, as in: acsar-gym doctor /dev/ttyUSB0 --timing")
    return measure_timing(device, config, duration)


def measure_timing(
    device: str, config: RobotConfig, duration: float, policy: Policy | None = None
) -> TimingReport:
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
    if not 0.0 < duration <= LONGEST_MEASUREMENT:
        raise ConfigError(
            f"duration = {show_value(duration)}: must be a positive number of seconds, at most "
            f"{LONGEST_MEASUREMENT:,.0f}, a day"
        )
    link = _WakeUpLink(device, config)
    loop = _ControlLoop(link, config, policy or _packaged())
    bare = _Sleeps(config.period)
    ticks = max(SHORTEST_BLOCK, round(BLOCK_TIME * config.control_rate))
    with loop.robot:
        loop.robot.drive(0.0, 0.0)
        begin, start = link.woke, loop.robot.decoder.lines
        for _ in range(math.ceil(duration * config.control_rate / ticks)):
            bare.run(ticks)
            loop.run(ticks)
        return _report(loop, bare, link.woke - begin, start)


def _report(loop: _ControlLoop, bare: _Sleeps, seconds: float, first_line: int) -> TimingReport:
    """Build the report of both loops over `seconds`, counting lines from `first_line` on."""
    config, decoder, device = loop.robot.config, loop.robot.decoder, loop.device
    return TimingReport(
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
        findings=tuple(realtime.check_computer(device, config)),
    )


def _packaged() -> Policy | None:
    """Load the packaged policy, if onnxruntime is installed."""
    try:
        return OnnxPolicy("point_goal")
    except MissingExtraError:
        return None


class _WakeUpLink(SerialLink):
    """A link that records when it woke up: it reads right after the deadline of a tick."""

    woke = 0.0

    def read_now(self) -> bytes:
        """Record the time, then read."""
        self.woke = time.monotonic()
        return super().read_now()


class _Record:
    """Lateness of the ticks of one loop, with a histogram."""

    def __init__(self, period: float) -> None:
        self.lateness = LatenessHistogram(period)
        self.bars = [0] * (len(HISTOGRAM_EDGES) + 1)
        self._period = period

    def add(self, woke: float, deadline: float) -> float:
        """Count a tick; returns the next deadline, which restarts after a missed tick."""
        lateness = woke - deadline
        self.lateness.add(lateness)
        self.bars[bisect_left(HISTOGRAM_EDGES, lateness)] += 1
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

    def __init__(self, link: _WakeUpLink, config: RobotConfig, policy: Policy | None) -> None:
        self.robot = Robot(link, config)
        self.device = link.device
        self.record = _Record(config.period)
        self.ages, self.decision_times = DurationHistogram(), DurationHistogram()
        self.processor = self.seconds = 0.0
        self._link = link
        self._period = config.period
        self._policy = policy
        self._decisions = _decisions(policy, self.robot) if policy else None
        self._ticks_per_step = max(1, round(config.control_rate / DECISION_RATE))
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
    memory, action = new_memory(task), (0.0, 0.0)
    top = (robot.config.max_linear, robot.config.max_angular)
    while True:
        begin = time.perf_counter()
        pose, twist = robot.odometry.pose, robot.odometry.twist
        state = State(pose=pose, twist=twist, action=action, goal=goal, max_twist=top)
        numbers = np.array(task.observe(state, memory), np.float32)
        linear, angular = policy(numbers).tolist()
        action = (linear, angular)
        yield time.perf_counter() - begin
