"""What `doctor --timing` found, judged and drawn."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

from rich.table import Table

from acsar_gym.doctor.checks import MARKS, Check
from acsar_gym.links.lateness import Spread, Timing

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
