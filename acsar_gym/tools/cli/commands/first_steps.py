"""The commands of the first steps: `demo` and `warm-up`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import Field

from acsar_gym.config.section import Section
from acsar_gym.tools.cli.commands import command
from acsar_gym.tools.cli.options import (
    EnvArg,
    ResultOptions,
    RobotArg,
    print_results,
)

Count = Annotated[int, Field(ge=1, le=10**9)]


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
    """Folder for the policy and the logs; default: runs/demo, or runs/demo-2 and so on."""


@command("demo", "first steps")
def show_demo(demo: DemoOptions, output: ResultOptions) -> int:
    """Train a policy, run it in PyBullet, then over a serial device; print one table.

    Args:
        demo: length and folder.
        output: results in a file.
    """
    from acsar_gym.tools import demo as demos  # noqa: PLC0415
    from acsar_gym.tools.evaluation import report  # noqa: PLC0415
    from acsar_gym.tools.training.record import find_free_folder  # noqa: PLC0415

    output.check()
    out = demo.out or find_free_folder(Path("runs/demo"))
    report.make_folder(out)
    runs = demos.run_demo(demo.steps, demo.episodes, demo.serial_episodes, out)
    rows = [(name, run.summary) for name, run in runs]
    title = f"One policy file, {out / 'policy.onnx'}, worlds: {runs[0][1].worlds}"
    data = {name: run.as_dict() for name, run in runs}
    print_results(report.summary_table(title, rows), json=output.json, data=data)
    return 0 if all(summary.success_rate >= 0.95 for _, summary in rows) else 1


@command("warm-up", "first steps")
def warm_up_caches(env: EnvArg = "", robot: RobotArg = None) -> int:
    """Compile all loops and generate the default worlds now, instead of at first use.

    Args:
        env: only for this env: point_goal, ..., or mine.module:mine/Task-v0.
        robot: preset or config file; generated worlds fit its footprint.
    """
    from acsar_gym.tools import warm_up as warm  # noqa: PLC0415

    found = []
    for name in (env,) if env else warm.ENV_NAMES:
        print(f"{name}: ", end="", flush=True)
        found.append(done := warm.warm_env(name, robot))
        worlds = f", {done.worlds} worlds at hand" if done.worlds else ""
        print(f"{done.functions} functions compiled{worlds}, {done.seconds:.1f} s", flush=True)
    total, seconds = sum(done.functions for done in found), sum(done.seconds for done in found)
    print(f"ready in {seconds:.1f} s" + ("" if total else ": everything had been compiled before"))
    return 0
