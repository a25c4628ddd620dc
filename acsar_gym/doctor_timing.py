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
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from rich.table import Table

from acsar_gym import realtime
from acsar_gym.config import RobotConfig
from acsar_gym.doctor import MARKS, Check
from acsar_gym.errors import ConfigError, LinkError, MissingExtraError
from acsar_gym.links.serial import SerialLink
from acsar_gym.links.timing import Durations, Lateness, Spread, Timing
from acsar_gym.policy import OnnxPolicy, Policy
from acsar_gym.robot import Robot
from acsar_gym.safety import Reason
from acsar_gym.tasks import State
from acsar_gym.tasks.goal import PointGoal

BLOCK = 0.5
"""Each loop's turn [s]; what arrives meanwhile waits in the device's buffer."""
SHORTEST_BLOCK = 5
"""Ticks of a turn, at least."""
POLICY_RATE = 10.0
"""About how often the policy is asked [Hz]."""
EDGES = (2e-5, 5e-5, 1e-4, 2e-4, 5e-4, 1e-3, 2e-3, 5e-3, 0.01, 0.02, 0.05, 0.1)
"""Upper edges of the histogram's bars [s]; the last bar has none."""
BAR = 24
"""Length of the longest bar."""

MOST_LATE = 0.001
"""A larger share of late ticks is worth a word."""
MOST_RATIO = 2.0
"""The same for the 99th percentile against the bare loop's."""
MOST_CPU = 0.05
"""The same for the share of a core."""
FEWEST_LINES = 0.99
"""The same for feedback lines against those expected."""
AHEAD = "see the computer below; --realtime and --cores put the loop ahead of other programs"


@dataclass(frozen=True, slots=True)
class Report:
    """What was measured. Times in s."""

    device: str
    rate: float
    """Ticks per second [Hz]."""
    lateness: Timing
    """Of the control loop: how long after its deadline each tick woke up."""
    bare: Timing
    """The same of the bare loop."""
    histogram: tuple[int, ...]
    """Ticks up to each of EDGES, and beyond the last."""
    bare_histogram: tuple[int, ...]
    seconds: float
    """From the first to the last tick, the bare loop's turns included."""
    lines: int
    """Valid feedback lines in that time; none is dropped on purpose."""
    lines_expected: float
    """By the configured feedback rate; the board's clock may differ by a percent."""
    refused: int
    """Parts of lines that came damaged."""
    feedback_age: Spread
    """Time since the newest line, as the driver knows it after a tick: 0 where one came in it."""
    cpu_share: float
    """Of one core, while the control loop ran."""
    policy_time: Spread | None
    """Of an evaluation of the policy; None where none was evaluated."""
    findings: tuple[Check, ...]
    """About the computer and the way to the device."""

    @property
    def ratio(self) -> float:
        """The control loop's 99th percentile of lateness in those of the bare loop."""
        return self.lateness.p99 / max(self.bare.p99, 1e-6)

    @property
    def lost_lines(self) -> int:
        """Lines that should have come and didn't; one may be under way at either end."""
        return max(0, math.floor(self.lines_expected) - 2 - self.lines)

    @property
    def figures(self) -> list[Check]:
        """What was measured, judged; round trips can't be where no wheel may turn."""
        return [
            self._late(),
            self._against_bare(),
            self._feedback(),
            self._age(),
            self._processor(),
            Check("round trip", "skip", "needs turning wheels", "acsar-gym doctor DEVICE --spin"),
        ]

    def _late(self) -> Check:
        late = self.lateness
        bad = late.late_share > MOST_LATE
        return Check(
            "late ticks",
            "warn" if bad else "ok",
            f"{late.late_ticks} of {late.ticks} over 1 ms ({late.late_share:.2%}), "
            f"{late.missed_ticks} missed",
            AHEAD if bad else "",
        )

    def _against_bare(self) -> Check:
        bad = self.ratio > MOST_RATIO
        return Check(
            "lateness",
            "warn" if bad else "ok",
            f"p50 {_ms(self.lateness.p50)}, p99 {_ms(self.lateness.p99)}, worst "
            f"{_ms(self.lateness.worst)}; p99 is {self.ratio:.2f} times a bare loop's",
            "a policy that takes longer than a tick, or a blocking driver" if bad else "",
        )

    def _feedback(self) -> Check:
        few = self.lines < FEWEST_LINES * self.lines_expected - 2.0
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
        age = self.feedback_age
        return Check(
            "feedback age",
            "ok",
            f"p50 {_ms(age.p50)}, p99 {_ms(age.p99)}, worst {_ms(age.worst)}",
        )

    def _processor(self) -> Check:
        bad = self.cpu_share > MOST_CPU
        policy = self.policy_time
        thinking = f"policy {_ms(policy.p50)} a step" if policy else "no policy: no onnxruntime"
        return Check(
            "processor",
            "warn" if bad else "ok",
            f"{self.cpu_share:.1%} of a core; {thinking}",
            "use a lower control_rate or a smaller policy" if bad else "",
        )

    def tables(self) -> list[Table]:
        """Histogram, figures, and what to change, for people."""
        return [
            self._drawn(),
            _checks("the control loop", self.figures),
            _checks("the computer", self.findings),
        ]

    def _drawn(self) -> Table:
        title = f"lateness of {self.lateness.ticks} ticks at {self.rate:g} Hz over {self.device}"
        drawn = Table(title=title, title_justify="left", caption="Bars are logarithmic.")
        drawn.add_column("up to", justify="right")
        for column in ("control loop", "bare loop"):
            drawn.add_column("ticks", justify="right")
            drawn.add_column(column, width=BAR)
        counts = list(zip(self.histogram, self.bare_histogram, strict=True))
        used = [number for number, pair in enumerate(counts) if any(pair)]
        most = max(map(max, counts))
        for number in range(used[0], used[-1] + 1):
            edge = f"{EDGES[number] * 1000.0:g} ms" if number < len(EDGES) else "more"
            own, bare = counts[number]
            drawn.add_row(edge, f"{own}", _bar(own, most), f"{bare}", _bar(bare, most))
        return drawn

    def as_dict(self) -> dict[str, Any]:
        """For programs."""
        return asdict(self) | {
            "edges": EDGES,
            "late_share": self.lateness.late_share,
            "p99_ratio": self.ratio,
            "lost_lines": self.lost_lines,
            "round_trip": None,
            "figures": [asdict(check) for check in self.figures],
        }


def _ms(seconds: float) -> str:
    return f"{seconds * 1000.0:.2f} ms"


def _bar(count: int, most: int) -> str:
    return "█" * math.ceil(BAR * math.log1p(count) / math.log1p(most))


def _checks(title: str, checks: tuple[Check, ...] | list[Check]) -> Table:
    drawn = Table(title=title, title_justify="left")
    for column in ("", "", "found", "what to change"):
        drawn.add_column(column, overflow="fold")
    for check in checks:
        drawn.add_row(check.name, MARKS[check.status], check.found, check.fix)
    return drawn


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
    for a duration that isn't a positive number.
    """
    if not 0.0 < duration < math.inf:
        raise ConfigError(f"duration = {duration!r}: must be a positive number of seconds")
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
        seconds = link.woke - begin
        decoder = loop.robot.decoder
        return Report(
            device=device,
            rate=config.control_rate,
            lateness=loop.record.lateness.summary(),
            bare=bare.record.lateness.summary(),
            histogram=tuple(loop.record.bars),
            bare_histogram=tuple(bare.record.bars),
            seconds=seconds,
            lines=decoder.lines - start,
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
    task = PointGoal.of((0.5, 3.0), 0.15, robot.config)
    course = task.begin(np.random.default_rng(0), {"goal": (2.0, 1.0)})
    action = (0.0, 0.0)
    while True:
        begin = time.perf_counter()
        state = State(robot.odometry.pose, robot.odometry.twist, action)
        linear, angular = policy(np.array(course.observe(state), np.float32)).tolist()
        action = (linear, angular)
        yield time.perf_counter() - begin
