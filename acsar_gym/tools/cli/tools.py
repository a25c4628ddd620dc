"""Commands demo, bench and warm-up."""

from __future__ import annotations

from pathlib import Path

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError, show_value
from acsar_gym.tools.cli.options import (
    EnvArg,
    File,
    RobotArg,
    check_writable,
    print_results,
    say,
)

MAX_COUNT = 10**9
"""Largest number of steps or episodes."""


def show_demo(
    steps: int = 150_000,
    episodes: int = 100,
    serial_episodes: int = 16,
    out: Path = Path("runs/demo"),
    json: File = None,
) -> int:
    """Train a policy, run it in PyBullet, then over a serial device; print one table.

    Args:
        steps: env steps of the training.
        episodes: episodes in PyBullet.
        serial_episodes: episodes over the emulator's pseudo-terminal, in real time.
        out: folder for the policy and the logs.
        json: also write the metrics to this file.
    """
    from acsar_gym.tools import demo as demos  # noqa: PLC0415
    from acsar_gym.tools.evaluation import report  # noqa: PLC0415

    check_writable(json)
    counts = {"--steps": steps, "--episodes": episodes, "--serial-episodes": serial_episodes}
    for name, count in counts.items():
        if not 1 <= count <= MAX_COUNT:
            raise ConfigError(f"{name} = {show_value(count)}: must be 1 to {MAX_COUNT:,}")
    report.make_folder(out)
    runs = demos.run_demo(steps, episodes, serial_episodes, out)
    rows = [(name, run.summary) for name, run in runs]
    title = f"One policy file, {out / 'policy.onnx'}, worlds: {runs[0][1].worlds}"
    data = {name: run.as_dict() for name, run in runs}
    print_results(report.summary_table(title, rows), json=json, data=data)
    return 0 if all(summary.success_rate >= 0.95 for _, summary in rows) else 1


def measure_speed(json: File = None, plots: File = None) -> int:
    """Measure the speed of envs, serial protocol and physics.

    Args:
        json: also write the figures to this file.
        plots: folder for plots that compare the planar robot with PyBullet's.
    """
    from acsar_gym.tools import bench, body_comparison  # noqa: PLC0415

    check_writable(json)
    figures = bench.measure_all()
    data = {f"{f.name} [{f.unit}]": f.value for f in figures}
    print_results(bench.figure_table(figures), json=json, data=data)
    for file in body_comparison.plot_drives(plots, RobotConfig.of(None)) if plots else ():
        say(f"drawn: {file}")
    return 0


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
