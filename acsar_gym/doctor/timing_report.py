"""The report of `doctor --timing`."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

from rich.table import Table

from acsar_gym.doctor.checks import MARKS, Check
from acsar_gym.errors import AHEAD
from acsar_gym.links.lateness import Spread, Timing

EDGES = (2e-5, 5e-5, 1e-4, 2e-4, 5e-4, 1e-3, 2e-3, 5e-3, 0.01, 0.02, 0.05, 0.1)
"""Upper edges of the histogram's bins [s]; the last bin has none."""
BAR = 24
"""Length of the longest bar [characters]."""

MOST_LATE = 0.001
"""Share of late ticks above which the report warns."""
MOST_RATIO = 2.0
"""Ratio of the 99th percentiles, to the bare loop's, above which it warns."""
MOST_CPU = 0.05
"""Share of a core above which it warns."""
FEWEST_LINES = 0.99
"""Share of the expected feedback lines below which it warns."""


@dataclass(frozen=True, slots=True)
class Report:
    """Results of the measurement. Times in s."""

    device: str
    rate: float
    """Ticks per second [Hz]."""
    lateness: Timing
    """Lateness of the control loop: time from a tick's deadline to its wake-up."""
    bare: Timing
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
    feedback_age: Spread
    """Age of the newest line after a tick; 0 if it arrived during the tick."""
    cpu_share: float
    """CPU time of the control loop, as a share of one core."""
    policy_time: Spread | None
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
        bad = late.late_share > MOST_LATE
        return Check(
            "late ticks",
            "warn" if bad else "ok",
            f"{late.late_ticks} of {late.ticks} over 1 ms ({late.late_share:.2%}), "
            f"{late.missed_ticks} missed",
            f"{AHEAD}; see the computer below" if bad else "",
        )

    def _against_bare(self) -> Check:
        """Judge the lateness in comparison with the bare loop."""
        bad = self.ratio > MOST_RATIO
        return Check(
            "lateness",
            "warn" if bad else "ok",
            f"p50 {_ms(self.lateness.p50)}, p99 {_ms(self.lateness.p99)}, worst "
            f"{_ms(self.lateness.worst)}; p99 is {self.ratio:.2f} times a bare loop's",
            "a policy that takes longer than a tick, or a blocking driver" if bad else "",
        )

    def _feedback(self) -> Check:
        """Judge the number of feedback lines."""
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
        """Report the age of the feedback."""
        age = self.feedback_age
        return Check(
            "feedback age",
            "ok",
            f"p50 {_ms(age.p50)}, p99 {_ms(age.p99)}, worst {_ms(age.worst)}",
        )

    def _processor(self) -> Check:
        """Judge the CPU time."""
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
        """Return everything for JSON."""
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
    """Format check results as a table."""
    drawn = Table(title=title, title_justify="left")
    for column in ("", "", "found", "what to change"):
        drawn.add_column(column, overflow="fold")
    for check in checks:
        drawn.add_row(check.name, MARKS[check.status], check.found, check.fix)
    return drawn
