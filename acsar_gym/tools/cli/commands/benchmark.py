"""The command `benchmark`: agents compared over fixed scenes, and checks of submissions."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from acsar_gym.errors import ConfigError
from acsar_gym.tools.cli.commands import command
from acsar_gym.tools.cli.options import File, Force, check_writable

Names = Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME [NAME ...]")]
Folder = Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")]
Folders = Annotated[tuple[Path, ...], tyro.conf.arg(metavar="FOLDER [FOLDER ...]")]


@dataclass(frozen=True)
class BenchmarkChoice:
    """What is compared."""

    env: Annotated[Names, tyro.conf.arg(aliases=["--ids"])] = ()
    """Ids: point_goal, obstacle_goal, barn, path_follow, mine.module:mine/Task-v0; default: all of
    acsar_gym's."""
    sets: Names = ()
    """Sets of scenes: open, clutter, clutter/husky, clutter-unseen, barn, barn-fast, ...; default:
    all of these ids."""
    robots: Names = ()
    """Robots that drive instead of those of the sets: presets or config files."""
    agents: Names = ()
    """Agents: packaged, baselines such as dwa, names in --trained, and policies of your own:
    mine.onnx, mine.py:act, mine.planner:Planner; default: all but your own."""
    trained: Folder = None
    """Trained policies, NAME/SEED/policy.onnx."""
    seeds: int = 5
    """Most training seeds of each trained agent."""
    links: Names = ("planar", "bullet")
    """planar, bullet, mujoco, port: the emulated board in real time."""
    scenes: int = 200
    """Scenes of every cell, at most 1,000."""
    port_scenes: int = 40
    """Scenes of every cell behind the emulated port."""
    conditions: Names = ("nominal",)
    """Conditions: nominal, randomization-1 to -3, dropped-2, ...; a wrong name lists all."""
    profile: bool = False
    """All conditions: the robustness profile."""
    barn: Folder = None
    """Folder of the published BARN worlds, in which barn and barn-fast are driven, too."""


@dataclass(frozen=True)
class BenchmarkOutputs:
    """Where it runs, and what it writes."""

    out: Annotated[Path, tyro.conf.arg(metavar="FOLDER")] = Path("runs/benchmark")
    """Folder of results, table and JSON."""
    resume: bool = True
    """Go on where the folder's benchmark ended; --no-resume begins anew."""
    workers: int | None = None
    """Processes at a time; default: 1, on a cluster one per CPU."""
    address: str | None = None
    """Ray cluster: auto, local, host:port or ray://host:port."""
    table: File = None
    """Also write the Markdown tables to this file."""
    json: File = None
    """Also write the JSON to this file."""
    html: File = None
    """Also write an HTML report."""
    force: Force = False


@command("benchmark", "policies")
def run_benchmark(
    what: BenchmarkChoice,
    how: BenchmarkOutputs,
    policy: str = "",
    combine: Folders = (),
    check: File = None,
) -> int:
    """Compare agents over fixed scenes: success, scores and intervals.

    Ctrl-C keeps what is finished; the same command goes on.

    Args:
        what: ids, agents, links, scenes and conditions.
        how: folder, processes and output.
        policy: benchmark this policy alone: an ONNX file, or a function or class such as
            mine.py:act or mine.module:Planner.
        combine: write tables from these folders; runs nothing.
        check: check such a row of --policy, and run nothing.
    """
    from acsar_gym.registration import IDS  # noqa: PLC0415
    from acsar_gym.tools.benchmark import plan, result, scenes  # noqa: PLC0415
    from acsar_gym.tools.evaluation import report  # noqa: PLC0415

    ids = list(dict.fromkeys(plan.find_env(name) for name in what.env))
    if check is not None:
        print(result.check_row(check))
        return 0
    check_writable(how.json, how.html, force=how.force)
    check_writable(how.table, force=how.force, mark=result.TABLE_MARK)
    if policy and (what.agents or what.trained or combine):
        raise ConfigError(
            "--policy: benchmarks one policy; leave out --agents, --trained, --combine"
        )
    if policy and len(ids) > 1:
        raise ConfigError("--policy: drives one --env")
    report.make_folder(how.out)
    if combine:
        told = result.make_result(*result.combine_folders(combine))
    else:
        named = tuple(plan.CONDITIONS) if what.profile else tuple(dict.fromkeys(what.conditions))
        if policy:
            found = [plan.submitted_agent(policy, *ids)]
            ids = [found[0].env]
        else:
            ids = ids or [f"{scenes.OWN_NAMESPACE}{name}" for name in IDS]
            found = plan.choose_agents(what.agents, ids, what.trained, what.seeds)
        every = [some for env_id in ids for some in scenes.find_sets(env_id, what.robots)]
        sets = scenes.choose_sets(every, what.sets)
        if what.barn is not None:
            sets += scenes.published_sets(sets, what.barn)
        told = result.run_benchmark(
            plan.BenchmarkPlan(
                *(tuple(found), tuple(sets), what.links, named, what.scenes, what.port_scenes)
            ),
            how.out,
            workers=how.workers,
            address=how.address,
            resume=how.resume,
            submit=bool(policy),
        )
    result.write_outputs(told, how.out, how.table, how.json, how.html)
    return 0
