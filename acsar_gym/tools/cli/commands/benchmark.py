"""The command `benchmark`: agents compared over fixed scenes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from acsar_gym.reading import describe_origin
from acsar_gym.tools.cli.commands import command
from acsar_gym.tools.cli.options import File, PageOptions, check_writable, print_results, say

Names = Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME [NAME ...]")]
Folder = Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")]


@dataclass(frozen=True)
class BenchmarkChoice:
    """What is compared."""

    sets: Names = ()
    """Sets of scenes: crowd, barn-fast, clutter, clutter/husky, ...; default: crowd and barn-fast,
    or all of --env."""
    env: Names = ()
    """Ids: barn, crowd, ..., mine.module:mine/Task-v0."""
    robots: Names = ()
    """Robots that drive instead of those of the sets: presets or config files."""
    agents: Names = ()
    """Agents: packaged, baselines such as dwa, names in --trained, and policies of your own:
    mine.onnx, mine.py:act, mine.planner:Planner; default: all but your own, and those that know
    the simulator's truth (orca_true)."""
    trained: Folder = None
    """Trained policies, NAME/SEED/policy.onnx."""
    seeds: int = 5
    """Most training seeds of each trained agent."""
    links: Names = ("planar", "bullet")
    """planar, bullet, mujoco; ros2: a simulation of 'acsar-gym ros driver', in real time."""
    scenes: int = 200
    """Scenes of every set, at most 1,000."""
    conditions: Names = ("nominal",)
    """Conditions: nominal, randomization-1 to -3, dropped-2, ...; a wrong name lists all."""
    barn: Folder = None
    """Folder of the published BARN worlds, in which barn and barn-fast are driven as well."""


@dataclass(frozen=True)
class BenchmarkOutputs(PageOptions):
    """Where it runs, and what it writes."""

    out: Folder = None
    """New folder of the results; default: runs/benchmark/NUMBER."""
    resume: Folder = None
    """Continue an interrupted benchmark in its folder."""
    csv: File = None
    """Also write the table as CSV."""
    latex: File = None
    """Also write the table for LaTeX."""
    figure: File = None
    """Also draw scores, intervals and training seeds, as FILE.svg or FILE.pdf."""
    workers: int | None = None
    """Processes at a time; default: 1, on a cluster one per CPU."""
    address: str | None = None
    """Ray cluster: auto, local, host:port or ray://host:port."""


@command("benchmark", "policies")
def run_benchmark(what: BenchmarkChoice, how: BenchmarkOutputs) -> int:
    """Compare agents over fixed scenes: success, scores and intervals.

    Args:
        what: ids, agents, links, scenes and conditions.
        how: folder, processes and output.
    """
    from acsar_gym.errors import ConfigError  # noqa: PLC0415
    from acsar_gym.tools.benchmark import agents, plan, report, runner, scenes  # noqa: PLC0415
    from acsar_gym.tools.benchmark.table import make_result  # noqa: PLC0415
    from acsar_gym.tools.evaluation.report import write_json  # noqa: PLC0415

    how.check()
    check_writable(how.csv, how.latex, how.figure, force=how.force)
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

    # The episodes, in a folder of their own.
    folder = runner.open_folder(chosen, how.out, how.resume)
    cells = runner.run_plan(chosen, folder, workers=how.workers, address=how.address)

    # The results.
    result = make_result(chosen.as_dict(), cells)
    for path in (folder / runner.RESULT_FILE, how.json):
        write_json(path, {"origin": describe_origin(), **result}, indent=None)
    if how.html is not None:
        report.write_benchmark_page(how.html, result)
    if how.csv is not None:
        report.write_csv(how.csv, result)
    if how.latex is not None:
        report.write_latex(how.latex, result)
    if how.figure is not None:
        report.write_figure(how.figure, result)
    print_results(report.result_table(result))
    for refusal in report.list_refusals(result):
        say(refusal)
    say(f"written: {folder / runner.RESULT_FILE}")
    return 0
