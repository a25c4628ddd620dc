"""The command `demo`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import Field

from acsar_gym.config.section import Section
from acsar_gym.tools.cli.commands import command
from acsar_gym.tools.cli.options import File, check_writable, print_results

Count = Annotated[int, Field(ge=1, le=10**9)]


class DemoOptions(Section):
    """Length of the demo, and its folder."""

    section = "demo"
    steps: Count = 150_000
    """Env steps of the training."""
    episodes: Count = 100
    """Episodes in PyBullet."""
    serial_episodes: Count = 16
    """Episodes over the emulator's pseudo-terminal, in real time."""
    out: Path = Path("runs/demo")
    """Folder for the policy and the logs."""


@command("demo", "first steps")
def show_demo(demo: DemoOptions, json: File = None) -> int:
    """Train a policy, run it in PyBullet, then over a serial device; print one table.

    Args:
        demo: length and folder.
        json: also write the metrics to this file.
    """
    from acsar_gym.tools import demo as demos  # noqa: PLC0415
    from acsar_gym.tools.evaluation import report  # noqa: PLC0415

    check_writable(json)
    report.make_folder(demo.out)
    runs = demos.run_demo(demo.steps, demo.episodes, demo.serial_episodes, demo.out)
    rows = [(name, run.summary) for name, run in runs]
    title = f"One policy file, {demo.out / 'policy.onnx'}, worlds: {runs[0][1].worlds}"
    data = {name: run.as_dict() for name, run in runs}
    print_results(report.summary_table(title, rows), json=json, data=data)
    return 0 if all(summary.success_rate >= 0.95 for _, summary in rows) else 1
