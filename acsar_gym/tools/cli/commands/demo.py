"""The command `demo`."""

from __future__ import annotations

from acsar_gym.tools.cli.commands import command
from acsar_gym.tools.cli.options import File, ResultOptions, print_results


@command("demo")
def show_demo(
    output: ResultOptions,
    steps: int = 150_000,
    episodes: int = 100,
    serial_episodes: int = 6,
    out: File = None,
) -> int:
    """Train a policy, run it in PyBullet, then over a serial device. Print one table.

    Args:
        output: Results in a file.
        steps: Env steps of the training.
        episodes: Episodes in PyBullet.
        serial_episodes: Episodes over the emulator's pseudo-terminal, in real time.
        out: New or empty folder for the policy and the logs. Default: runs/demo/1, 2, ...
    """
    from acsar_gym.tools.demo import run_demo
    from acsar_gym.tools.evaluation import report
    from acsar_gym.tools.training.folders import make_folder

    output.check()
    folder = make_folder(out, "demo")
    runs = run_demo(steps, episodes, serial_episodes, folder)
    rows = [(name, run.summary) for name, run in runs]
    title = f"One policy file, {folder / 'policy.onnx'}, worlds: {runs[0][1].worlds}"
    data = {name: run.as_dict() for name, run in runs}
    print_results(report.summary_table(title, rows), json=output.json, data=data)
    return 0 if all(summary.success_rate >= 0.95 for _, summary in rows) else 1
