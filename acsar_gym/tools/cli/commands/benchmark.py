"""The command `benchmark`: agents compared over fixed scenes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from acsar_gym.reading import describe_origin
from acsar_gym.tools.cli.commands import command
from acsar_gym.tools.cli.options import (
    Count,
    File,
    Names,
    PageOptions,
    check_writable,
    print_results,
    say,
)

Folder = Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")]


@dataclass(frozen=True)
class BenchmarkChoice:
    """What is compared."""

    sets: Names = ()
    """Sets of scenes: crowd, barn-fast, clutter, clutter/husky, ... Default: crowd and barn-fast,
    or all of --env."""
    env: Names = ()
    """Ids: barn, crowd, ..., mine.module:mine/Task-v0."""
    robots: Names = ()
    """Robots that drive instead of those of the sets: presets or config files."""
    agents: Names = ()
    """Agents: packaged, baselines such as dwa, names in --trained, and your own policies:
    mine.onnx, mine.py:act, mine.planner:Planner. Default: all but your own, and those that know
    the simulator's truth (orca_true)."""
    trained: Folder = None
    """Trained policies, NAME/SEED/policy.onnx."""
    seeds: int = 5
    """Most training seeds of each trained agent."""
    links: Names = ("planar", "bullet")
    """planar, bullet, mujoco, or ros2: a simulation of 'acsar-gym ros driver', in real time."""
    scenes: int = 200
    """Scenes of every set, at most 1,000."""
    conditions: Names = ("nominal",)
    """Conditions: nominal, randomization-1 to -3, dropped-2, ... A wrong name lists all."""
    barn: Folder = None
    """Folder of the published BARN worlds, in which barn and barn-fast are driven as well."""


@dataclass(frozen=True)
class BenchmarkOutputs(PageOptions):
    """Where it runs, and what it writes."""

    out: Folder = None
    """New folder of the results. Default: runs/benchmark/NUMBER."""
    resume: Folder = None
    """Continue an interrupted benchmark in its folder."""
    csv: File = None
    """Also write the table as CSV."""
    latex: File = None
    """Also write the table for LaTeX."""
    figure: File = None
    """Also draw scores, intervals and training seeds, as FILE.svg or FILE.pdf."""
    workers: Count = None
    """Processes at a time. Default: 1, on a cluster one per CPU."""
    address: str | None = None
    """Ray cluster: auto, local, host:port or ray://host:port."""


@command("benchmark")
def run_benchmark(what: BenchmarkChoice, how: BenchmarkOutputs) -> int:
    """Compare agents over fixed scenes: success, scores and intervals.

    Args:
        what: Ids, agents, links, scenes and conditions.
        how: Folder, processes and output.
    """
    from acsar_gym.errors import ConfigError
    from acsar_gym.tools.benchmark import agents, plan, report, runner, scenes
    from acsar_gym.tools.benchmark.table import make_result
    from acsar_gym.tools.evaluation.report import write_json

    how.check()
    check_writable(how.csv, how.latex, how.figure)
    report.check_figure(how.figure, how.html)
    if how.out is not None and how.resume is not None:
        raise ConfigError("--resume: continues in its own folder: leave out --out")

    # What is compared.
    sets = scenes.choose_sets(what.env, what.sets, what.robots)
    if what.barn is not None:
        sets += scenes.published_sets(sets, what.barn)
    chosen = plan.Plan(
        agents=tuple(agents.choose_agents(what.agents, sets, what.trained, what.seeds)),
        sets=tuple(sets),
        links=tuple(dict.fromkeys(what.links)),
        conditions=tuple(dict.fromkeys(what.conditions)),
        count=what.scenes,
    )

    # The episodes, in their own folder.
    folder = runner.open_folder(chosen, how.out, how.resume)
    cells = runner.run_plan(chosen, folder, workers=how.workers, address=how.address)

    # The results.
    result = make_result(chosen.as_dict(), cells)
    for path in (folder / runner.RESULT_FILE, how.json):
        write_json(path, {"origin": describe_origin(), **result}, indent=None)
    for path, write in (
        (how.html, report.write_benchmark_page),
        (how.csv, report.write_csv),
        (how.latex, report.write_latex),
        (how.figure, report.write_figure),
    ):
        if path is not None:
            write(path, result)
    print_results(report.result_table(result))
    for refusal in report.list_refusals(result):
        say(refusal)
    say(f"written: {folder / runner.RESULT_FILE}")
    return 0
