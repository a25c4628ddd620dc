"""The command `benchmark`: agents compared over fixed scenes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from acsar_gym.reading import describe_origin
from acsar_gym.tools.cli.commands import command
from acsar_gym.tools.cli.options import PageOptions, print_results, say

Names = Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME [NAME ...]")]
Folder = Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")]
RESULT_FILE = "benchmark.json"


@dataclass(frozen=True)
class BenchmarkChoice:
    """What is compared."""

    env: Annotated[Names, tyro.conf.arg(aliases=["--ids"])] = ()
    """Ids: point_goal, obstacle_goal, barn, crowd, dyna_barn, path_follow,
    mine.module:mine/Task-v0; default: all of acsar_gym's."""
    sets: Names = ()
    """Sets of scenes: open, clutter, clutter/husky, clutter-unseen, barn, barn-fast, ...; default:
    all of these ids."""
    robots: Names = ()
    """Robots that drive instead of those of the sets: presets or config files."""
    agents: Names = ()
    """Agents: packaged, baselines such as dwa, names in --trained, and policies of your own:
    mine.onnx, mine.py:act, mine.planner:Planner; default: all but your own, and those that know
    what only a simulator does (orca_true)."""
    trained: Folder = None
    """Trained policies, NAME/SEED/policy.onnx."""
    seeds: int = 5
    """Most training seeds of each trained agent."""
    links: Names = ("planar", "bullet")
    """planar, bullet, mujoco; port: the emulated board in real time; ros2: a simulation of
    'acsar-gym ros driver', likewise."""
    scenes: int = 200
    """Scenes of every cell, at most 1,000."""
    port_scenes: int = 40
    """Scenes of every cell in real time."""
    conditions: Names = ("nominal",)
    """Conditions: nominal, randomization-1 to -3, dropped-2, ...; a wrong name lists all."""
    profile: bool = False
    """All conditions: the robustness profile."""
    barn: Folder = None
    """Folder of the published BARN worlds, in which barn and barn-fast are driven, too."""


@dataclass(frozen=True)
class BenchmarkOutputs(PageOptions):
    """Where it runs, and what it writes."""

    out: Annotated[Path, tyro.conf.arg(metavar="FOLDER")] = Path("runs/benchmark")
    """Folder of the finished cells, and of the result as benchmark.json."""
    workers: int | None = None
    """Processes at a time; default: 1, on a cluster one per CPU."""
    address: str | None = None
    """Ray cluster: auto, local, host:port or ray://host:port."""


@command("benchmark", "policies")
def run_benchmark(what: BenchmarkChoice, how: BenchmarkOutputs) -> int:
    """Compare agents over fixed scenes: success, scores and intervals.

    Ctrl-C keeps the cells that are finished; the same command drives the others.

    Args:
        what: ids, agents, links, scenes and conditions.
        how: folder, processes and output.
    """
    from acsar_gym.registration import IDS  # noqa: PLC0415
    from acsar_gym.tools.benchmark import cells, figures, plan, runner, scenes  # noqa: PLC0415
    from acsar_gym.tools.benchmark import report as benchmark_report  # noqa: PLC0415
    from acsar_gym.tools.evaluation import report  # noqa: PLC0415

    ids = list(dict.fromkeys(plan.find_env(name) for name in what.env))
    ids = ids or [f"{scenes.OWN_NAMESPACE}{name}" for name in IDS]
    how.check()
    report.make_folder(how.out)
    agents = plan.choose_agents(what.agents, ids, what.trained, what.seeds)
    sets = scenes.choose_sets(
        [some for env_id in ids for some in scenes.find_sets(env_id, what.robots)], what.sets
    )
    if what.barn is not None:
        sets += scenes.published_sets(sets, what.barn)
    driven = {agent.id for agent in agents}
    asked = plan.BenchmarkPlan(
        tuple(agents),
        tuple(some for some in sets if some.id in driven),
        what.links,
        tuple(plan.CONDITIONS) if what.profile else tuple(dict.fromkeys(what.conditions)),
        what.scenes,
        what.port_scenes,
    )
    store = cells.Store(how.out)
    finished = runner.run_plan(asked, store, workers=how.workers, address=how.address)
    result = figures.make_result(asked.as_dict(), finished)
    for path in (how.out / RESULT_FILE, how.json):
        report.write_json(path, {"origin": describe_origin(), **result}, indent=None)
    if how.html is not None:
        benchmark_report.write_benchmark_page(how.html, result)
    print_results(benchmark_report.result_table(result))
    for refusal in benchmark_report.list_refusals(result):
        say(refusal)
    return 0
