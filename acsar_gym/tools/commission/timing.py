"""Measures how late the ticks of the control loop are on a device, compared with a bare loop.

The loop is the driver's own at the control rate, with zero commands only. It alternates every half
second with a bare loop of absolute sleeps in the same process. The computer delays both equally, so
the ratio shows what the driver adds.
"""

from __future__ import annotations

import contextlib
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
    DurationRecord,
    DurationSpread,
    LatenessRecord,
    TickTiming,
)
from acsar_gym.links.serial import SerialLink
from acsar_gym.robot import Robot
from acsar_gym.safety.rules import Reason
from acsar_gym.tasks import State
from acsar_gym.tasks.goal import PointGoal
from acsar_gym.tasks.task import new_memory
from acsar_gym.tools.commission.checks import Check, draw_checks, warn_if
from acsar_gym.tools.commission.host import check_computer
from acsar_gym.tools.policies import OnnxPolicy, Policy

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

BLOCK_TIME = 0.5
"""Duration of a block of either loop [s]; feedback waits in the device's buffer meanwhile."""
SHORTEST_BLOCK = 5
"""Smallest number of ticks of a block."""
LONGEST_MEASUREMENT = 86_400.0
"""Longest measurement [s]."""
DECISION_RATE = 10.0
"""Approximate rate of the policy [Hz]."""


@dataclass(frozen=True, slots=True)
class TimingReport:
    """Results of the measurement. Times in s."""

    device: str
    rate: float
    """Ticks per second [Hz]."""
    late_tick: float
    """Ticks that are later than this count as late [s]."""
    lateness: TickTiming
    """Lateness of the control loop: time from a tick's deadline to its wake-up."""
    bare: TickTiming
    """Lateness of the bare loop."""
    histogram: tuple[int, ...]
    """Ticks per bin of HISTOGRAM_EDGES, with one more bin above the last edge."""
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
        late, policy = self.lateness, self.policy_time
        few = self.lines < MIN_LINE_SHARE * self.lines_expected - 2.0
        thinking = f"policy {_ms(policy.p50)} a step" if policy else "no policy: no onnxruntime"
        return [
            warn_if(
                late.late_share > MAX_LATE_SHARE,
                "late ticks",
                f"{late.late_ticks} of {late.ticks} over {self.late_tick * 1e3:g} ms "
                f"({late.late_share:.2%}), "
                f"{late.missed_ticks} missed",
                f"{BUSY_HINT}; see the computer below",
            ),
            warn_if(
                self.ratio > MAX_P99_RATIO,
                "lateness",
                f"{_describe_spread(late)}; p99 is {self.ratio:.2f} times a bare loop's",
                "a policy that takes longer than a tick, or a blocking driver",
            ),
            warn_if(
                few or self.refused > 0,
                "feedback lines",
                f"{self.lines} of {self.lines_expected:.0f} expected, {self.lost_lines} lost, "
                f"{self.refused} bad parts",
                "check the cable; is firmware.feedback_rate what the board sends?",
            ),
            Check("feedback age", "ok", _describe_spread(self.feedback_age)),
            warn_if(
                self.cpu_share > MAX_CPU_SHARE,
                "processor",
                f"{self.cpu_share:.1%} of a core; {thinking}",
                "use a lower control_rate or a smaller policy",
            ),
            Check("round trip", "skip", "needs turning wheels", "acsar-gym doctor DEVICE --spin"),
        ]

    def tables(self) -> list[Table]:
        """Format histogram, figures and advice as tables."""
        title = f"lateness of {self.lateness.ticks} ticks at {self.rate:g} Hz over {self.device}"
        drawn = Table(title=title, title_justify="left", caption="Bars are logarithmic.")
        drawn.add_column("up to", justify="right")
        for column in ("control loop", "bare loop"):
            drawn.add_column("ticks", justify="right")
            drawn.add_column(column, width=LONGEST_BAR)
        counts = list(zip(self.histogram, self.bare_histogram, strict=True))
        used = [number for number, pair in enumerate(counts) if any(pair)]
        most = math.log1p(max(map(max, counts)))
        for number in range(used[0], used[-1] + 1):
            last = number == len(HISTOGRAM_EDGES)
            cells = ["more" if last else f"{HISTOGRAM_EDGES[number] * 1000.0:g} ms"]
            for count in counts[number]:
                cells += [f"{count}", "█" * math.ceil(LONGEST_BAR * math.log1p(count) / most)]
            drawn.add_row(*cells)
        return [
            drawn,
            draw_checks(self.figures, "the control loop"),
            draw_checks(self.findings, "the computer"),
        ]

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


def _describe_spread(spread: TickTiming | DurationSpread) -> str:
    return f"p50 {_ms(spread.p50)}, p99 {_ms(spread.p99)}, worst {_ms(spread.worst)}"


class _WakeUpLink(SerialLink):
    """A link that records when it woke up: it reads right after the deadline of a tick."""

    woke = 0.0

    def read_now(self) -> bytes:
        """Record the time, then read."""
        self.woke = time.monotonic()
        return super().read_now()


class _TickRecord(LatenessRecord):
    """Lateness of the ticks of one loop, also as counts of bins."""

    def __init__(self, config: RobotConfig) -> None:
        super().__init__(config)
        self.bins = [0] * (len(HISTOGRAM_EDGES) + 1)

    def next_deadline(self, woke: float, deadline: float) -> float:
        """Count a tick; returns the next deadline, which restarts after a missed tick."""
        lateness = woke - deadline
        self.add(lateness)
        self.bins[bisect_left(HISTOGRAM_EDGES, lateness)] += 1
        return (woke if lateness > self.period else deadline) + self.period


def examine_timing(
    device: str | None, config: RobotConfig, duration: float, policy: Policy | None = None
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
        ConfigError: there is no device, or `duration` isn't positive, or is longer than a day.
    """
    if device is None:
        raise ConfigError("--timing needs a device, as in: acsar-gym doctor /dev/ttyUSB0 --timing")
    if not 0.0 < duration <= LONGEST_MEASUREMENT:
        raise ConfigError(
            f"duration = {show_value(duration)}: must be a positive number of seconds, at most "
            f"{LONGEST_MEASUREMENT:,.0f}, a day"
        )
    link = _WakeUpLink(device, config)
    robot = Robot(link, config)
    own, bare = _TickRecord(config), _TickRecord(config)
    ages, decision_times = DurationRecord(), DurationRecord()
    if policy is None:
        with contextlib.suppress(MissingExtraError):
            policy = OnnxPolicy("point_goal")
    decisions = _time_decisions(policy, robot) if policy else None
    if decisions is not None:
        next(decisions)  # the first one may compile, as a reset does in an episode
    ticks = max(SHORTEST_BLOCK, round(BLOCK_TIME * config.control_rate))
    ticks_per_step = max(1, round(config.control_rate / DECISION_RATE))
    cpu_time = loop_time = 0.0

    def drive_zero() -> None:
        robot.drive(0.0, 0.0)
        if robot.safety.reason is Reason.EMERGENCY_STOP:
            raise LinkError("emergency stop", "start again when all is well")

    with robot:
        drive_zero()
        start, first_line = link.woke, robot.decoder.lines
        for _ in range(math.ceil(duration * config.control_rate / ticks)):
            _sleep_through(ticks, bare)
            drive_zero()  # not measured, as it reads the feedback of the bare loop
            deadline = link.woke + config.period
            begin, used = time.monotonic(), time.process_time()
            for number in range(ticks):
                if number % ticks_per_step == 0 and decisions is not None:
                    decision_times.add(next(decisions))
                drive_zero()
                deadline = own.next_deadline(link.woke, deadline)
                ages.add(robot.feedback_age)
            cpu_time += time.process_time() - used
            loop_time += time.monotonic() - begin
        seconds = link.woke - start
        return TimingReport(
            device=device,
            rate=config.control_rate,
            late_tick=config.late_tick,
            lateness=own.summary(),
            bare=bare.summary(),
            histogram=tuple(own.bins),
            bare_histogram=tuple(bare.bins),
            seconds=seconds,
            lines=robot.decoder.lines - first_line,
            lines_expected=seconds * config.feedback_rate,
            refused=sum(robot.decoder.refused.values()),
            feedback_age=ages.spread(),
            cpu_share=cpu_time / loop_time,
            policy_time=decision_times.spread() if decision_times.count else None,
            findings=tuple(check_computer(device, config)),
        )


def _sleep_through(ticks: int, record: _TickRecord) -> None:
    """Run a block of the bare loop, which only sleeps until absolute deadlines."""
    deadline = time.monotonic() + record.period
    for _ in range(ticks):
        time.sleep(max(0.0, deadline - time.monotonic()))
        deadline = record.next_deadline(time.monotonic(), deadline)


def _time_decisions(policy: Policy, robot: Robot) -> Iterator[float]:
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
