"""The command `demo`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import Field

from acsar_gym.config.section import Section
from acsar_gym.tools.cli.commands import command
from acsar_gym.tools.cli.options import ResultOptions, print_results
from acsar_gym.tools.training.options import COUNT

Count = Annotated[int, COUNT, Field(ge=1, le=10**9)]


class DemoOptions(Section):
    """Length of the demo, and its folder."""

    section = "demo"
    steps: Count = 150_000
    """Env steps of the training."""
    episodes: Count = 100
    """Episodes in PyBullet."""
    serial_episodes: Count = 6
    """Episodes over the emulator's pseudo-terminal, in real time."""
    out: Path | None = None
    """New or empty folder for the policy and the logs; default: runs/demo/1, 2, ..."""


@command("demo", "first steps")
def show_demo(demo: DemoOptions, output: ResultOptions) -> int:
    """Train a policy, run it in PyBullet, then over a serial device; print one table.

    Args:
        demo: length and folder.
        output: results in a file.
    """
    from acsar_gym.tools import demo as demos  # noqa: PLC0415
    from acsar_gym.tools.evaluation import report  # noqa: PLC0415
    from acsar_gym.tools.training.folders import make_folder  # noqa: PLC0415

    output.check()
    out = make_folder(demo.out, "demo")
    runs = demos.run_demo(demo.steps, demo.episodes, demo.serial_episodes, out)
    rows = [(name, run.summary) for name, run in runs]
    title = f"One policy file, {out / 'policy.onnx'}, worlds: {runs[0][1].worlds}"
    data = {name: run.as_dict() for name, run in runs}
    print_results(report.summary_table(title, rows), json=output.json, data=data)
    return 0 if all(summary.success_rate >= 0.95 for _, summary in rows) else 1
