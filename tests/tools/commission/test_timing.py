"""The timing examination over an emulator in another process: what it counts, and what it says."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from rich.console import Console
from serial_tools import Emulated, no_leak, wait_until

from acsar_gym import RobotConfig
from acsar_gym.errors import LinkError, MissingExtraError
from acsar_gym.guard.estop import StopListener
from acsar_gym.links.lateness import DurationSpread, TickTiming
from acsar_gym.protocol import ZERO
from acsar_gym.tools.commission import timing as doctor_timing
from acsar_gym.tools.commission.checks import Check
from acsar_gym.tools.commission.timing import HISTOGRAM_EDGES, TimingReport, examine_timing

pytestmark = pytest.mark.usefixtures("deadline")

Action = NDArray[np.float32]


@pytest.fixture(autouse=True)
def hurry(monkeypatch: pytest.MonkeyPatch) -> None:
    """Shorter turns than at the command line: ten ticks."""
    monkeypatch.setattr(doctor_timing, "BLOCK_TIME", 0.1)


def forwards(observation: Action) -> Action:
    """A policy that would drive at full speed, were it obeyed."""
    return np.array([1.0, 0.0], np.float32)


@pytest.fixture
def report() -> TimingReport:
    """All is well."""
    timing = TickTiming(1000, 1, 0, 6e-5, 1.1e-4, 0.002)
    return TimingReport(
        device="/dev/ttyUSB0",
        rate=100.0,
        late_tick=0.002,
        lateness=timing,
        bare=dataclasses.replace(timing, p99=1e-4),
        histogram=(0, 10, 900, 89, 0, 0, 1, *[0] * 6),
        bare_histogram=(0, 20, 900, 79, 0, 0, 1, *[0] * 6),
        seconds=20.0,
        lines=1999,
        lines_expected=2000.3,
        refused=0,
        feedback_age=DurationSpread(1000, 0.0, 0.01, 0.02),
        cpu_share=0.03,
        policy_time=DurationSpread(100, 1e-4, 2e-4, 3e-4),
        findings=(Check("load", "warn", "1.9 of 2", "stop other programs"),),
    )


def judged(report: TimingReport) -> dict[str, Check]:
    return {check.name: check for check in report.figures}


def test_a_run_over_the_emulator(config: RobotConfig, shared_device: str) -> None:
    with no_leak():
        report = examine_timing(shared_device, config, 0.25, forwards)
    ticks = 30  # three turns
    assert report.lateness.ticks == report.bare.ticks == ticks
    assert sum(report.histogram) == sum(report.bare_histogram) == ticks
    assert sum(report.histogram[HISTOGRAM_EDGES.index(2e-3) + 1 :]) == report.lateness.late_ticks
    assert report.feedback_age.count == ticks
    assert report.policy_time is not None
    assert report.policy_time.count == 3
    assert report.refused == 0
    assert report.lines_expected == pytest.approx(report.seconds * config.feedback_rate)
    assert report.lines > 0
    assert 0.0 < report.cpu_share < 1.0
    console = Console(width=200)
    with console.capture() as capture:
        console.print(*report.tables())
    assert shared_device in capture.get()


def test_the_wheels_never_turn(config: RobotConfig, emulator: Emulated) -> None:
    examine_timing(emulator.device, config, 0.2, forwards)
    wait_until(lambda: len(emulator.commands()) >= 20, "a command a tick")
    wait_until(emulator.stands, "a robot that stands")
    assert set(emulator.commands()) == {ZERO}


def test_with_the_packaged_policy_and_without_onnxruntime(
    config: RobotConfig, shared_device: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("onnxruntime")
    report = examine_timing(shared_device, config, 0.2)
    assert report.policy_time is not None
    assert report.policy_time.count == 2

    def missing(_: str) -> None:
        raise MissingExtraError("running a policy", "deploy")

    monkeypatch.setattr(doctor_timing, "OnnxPolicy", missing)
    report = examine_timing(shared_device, config, 0.1)
    assert report.policy_time is None
    assert "no policy" in judged(report)["processor"].found


def test_an_emergency_stop_ends_it(
    config: RobotConfig, shared_device: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(StopListener, "is_requested", lambda _: True)
    with no_leak(), pytest.raises(LinkError, match="emergency stop"):
        examine_timing(shared_device, config, 5.0, forwards)


@pytest.mark.parametrize(
    ("changes", "name", "said"),
    [
        ({"lateness": TickTiming(1000, 2, 0, 6e-5, 1.1e-4, 0.002)}, "late ticks", "2 of 1000"),
        ({"lateness": TickTiming(1000, 0, 0, 6e-5, 2.1e-4, 4e-4)}, "lateness", "2.10 times"),
        ({"lines": 1950}, "feedback lines", "48 lost"),
        ({"refused": 3}, "feedback lines", "3 bad parts"),
        ({"cpu_share": 0.2}, "processor", "20.0%"),
    ],
)
def test_what_a_report_warns_of(
    changes: dict[str, Any], name: str, said: str, report: TimingReport
) -> None:
    bad = dataclasses.replace(report, **changes)
    (warning,) = [check for check in bad.figures if check.status == "warn"]
    assert warning.name == name
    assert said in warning.found
    assert warning.fix
