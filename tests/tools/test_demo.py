"""The whole demo on a tiny budget, its emulator in another process on a real tty."""

from __future__ import annotations

from pathlib import Path

import psutil
import pytest
from processes import first_line, program

from acsar_gym.resources import AGENTS
from acsar_gym.testing import wait_until
from acsar_gym.tools import demo
from acsar_gym.tools.evaluation import report

HOLDS_AN_EMULATOR = """
import time
import psutil
from acsar_gym.tools.emulation.board import run_emulator

with run_emulator("--body", "planar"):
    print(*(child.pid for child in psutil.Process().children()), flush=True)
    time.sleep(600)
"""


def test_run_demo_fills_both_rows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Everything but the training is real. The packaged policy takes its place."""
    policy = AGENTS / "policies" / "point_goal.onnx"
    monkeypatch.setattr(demo, "train_demo_policy", lambda *_: policy)
    done = demo.run_demo(steps=0, episodes=3, serial_episodes=1, out=tmp_path)
    assert done[0][1].header["link"] == "bullet"
    rows = [(name, run.summary) for name, run in done]
    assert [summary.episodes for _, summary in rows] == [3, 1]
    assert all(summary.success_rate == 1.0 and summary.ticks > 0 for _, summary in rows)
    assert 0.0 <= rows[0][1].odometry_error < 0.1  # a busy machine's emulator loses time
    assert rows[1][1].odometry_error >= 0.0
    assert len(report.summary_table("demo", rows).columns) == 3


def test_run_emulator_ends_with_the_demo_even_if_it_is_killed() -> None:
    with program(HOLDS_AN_EMULATOR) as holder:
        (emulator,) = map(int, first_line(holder).split())
        holder.kill()
        wait_until(lambda: has_ended(emulator), "the emulator's end")


def has_ended(pid: int) -> bool:
    """Whether a process that isn't ours is gone. Not every container's init reaps zombies."""
    try:
        return psutil.Process(pid).status() == psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return True
