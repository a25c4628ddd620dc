"""The command `demo`."""

from __future__ import annotations

from pathlib import Path

from acsar_gym.errors import ConfigError, show_value
from acsar_gym.tools.cli.commands import command
from acsar_gym.tools.cli.options import File, check_writable, print_results

MAX_COUNT = 10**9
"""Largest number of steps or episodes."""


@command("demo", "first steps")
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
