"""The command `bench`."""

from __future__ import annotations

from acsar_gym.config import RobotConfig
from acsar_gym.tools.cli.commands import command
from acsar_gym.tools.cli.options import (
    File,
    check_writable,
    print_results,
    say,
)


@command("bench", "first steps")
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
