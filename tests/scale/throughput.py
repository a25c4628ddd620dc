"""What a second Ray node is worth: throughput of one and two nodes of one CPU each.

    make throughput        or   python tests/scale/throughput.py --repeats 3

One job at a time and two at a time take turns on the same cluster; each row is the median of the
repeats. `by the clock` needs a machine with nothing else to do. `by CPU time` doesn't: it lays the
CPU times of the jobs end to end on one and on two nodes, as Ray does with the jobs, and adds the
CPU time of the program that hands them out. So that is what the clock would say if every node had
a core of its own; what nodes of one machine share, such as memory bandwidth, is in it, too.
"""

from __future__ import annotations

import argparse
import heapq
import json
import os
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent.parent))

from cluster_tools import nodes
from throughput_tools import Cost, evaluate, train

from acsar_gym.config import RobotConfig
from acsar_gym.tools.evaluation import runs
from acsar_gym.tools.evaluation.shards import PortablePolicy, Shard
from acsar_gym.tools.jobs import cluster, completed
from acsar_gym.tools.training.plan import TrainingOptions


@dataclass(frozen=True)
class Task:
    """What is measured: jobs that are all alike."""

    name: str
    unit: str
    function: Callable[[Any], Cost]
    jobs: Sequence[Any]
    before: Sequence[Any]
    """Jobs that load what the others need, which isn't measured."""


@dataclass(frozen=True)
class Measured:
    """One run of a task."""

    clock: float
    """Units a second."""
    cpu: float
    """Units a second, if every node had a core of its own."""
    each: float
    """CPU time of one unit [s]."""


def evaluation(link: str, policy: str, episodes: int) -> Task:
    """Evaluation of a packaged policy, in shards of ten episodes."""
    sent, robot = PortablePolicy.of(runs.load_policy(policy, trust=False)), RobotConfig.of(None)

    def shard(first: int) -> Shard:
        return Shard(sent, link, robot, range(first, first + 10), 0, {}, {})

    jobs = [shard(first) for first in range(0, episodes, 10)]
    before = [shard(first) for first in range(10_000, 10_080, 10)]
    return Task(f"evaluation, {policy}, {link}", "episodes", evaluate, jobs, before)


def training(env: str, steps: int, seeds: int) -> Task:
    """Trainings of several seeds, one thread each."""

    def options(seed: int, steps: int) -> TrainingOptions:
        return TrainingOptions(env=env, steps=steps, seed=seed, threads=1, progress=False)

    jobs = [options(seed, steps) for seed in range(seeds)]
    before = [options(99, 40_000)] * 4
    return Task(f"training, {env}, {seeds} seeds", "steps", train, jobs, before)


def once(task: Task, address: str, count: int) -> Measured:
    """Run a task on `count` nodes."""
    begin, own = time.perf_counter(), time.process_time()
    running = completed(task.function, task.jobs, workers=count, address=address)
    costs = [cost for _, cost in running]
    wall, own = time.perf_counter() - begin, time.process_time() - own
    units = sum(cost.units for cost in costs)
    used = [cost.cpu for cost in costs]
    return Measured(units / wall, units / (makespan(used, count) + own), sum(used) / units)


def makespan(times: Sequence[float], count: int) -> float:
    """How long `count` nodes take for jobs of these times; each next job goes to a free node."""
    ends = [0.0] * count
    for each in times:
        heapq.heapreplace(ends, ends[0] + each)
    return max(ends)


def measure(task: Task, repeats: int) -> dict[str, Any]:
    """Measure a task on one node and on two, in turns."""
    found: dict[int, list[Measured]] = {1: [], 2: []}
    with nodes(2) as running, cluster.connect_cluster(running.address):
        list(completed(task.function, task.before, address=running.address))
        for _ in range(repeats):
            for count in (1, 2):
                found[count].append(once(task, running.address, count))
    row: dict[str, Any] = {"task": task.name, "unit": task.unit}
    for name in ("clock", "cpu", "each"):
        values = {n: [getattr(each, name) for each in found[n]] for n in (1, 2)}
        ratios = [two / one for one, two in zip(values[1], values[2], strict=True)]
        one, two = (statistics.median(values[n]) for n in (1, 2))
        row[name] = {"one": one, "two": two, "ratio": statistics.median(ratios)}
    return {**row, "load": os.getloadavg()[0]}


def show(row: dict[str, Any]) -> None:
    """Print a row."""
    print(f"{row['task']} ({row['unit']}/s), load average {row['load']:.1f}")
    for name, said in (("clock", "by the clock"), ("cpu", "by CPU time")):
        one, two, ratio = (row[name][key] for key in ("one", "two", "ratio"))
        print(f"  {said:13} one node {one:9.4g}   two nodes {two:9.4g}   {ratio:.2f} times")
    one, two = (row["each"][key] * 1e3 for key in ("one", "two"))
    print(f"  CPU time of one, in ms: on one node {one:.4g}, on two {two:.4g}")
    sys.stdout.flush()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--only", default="", help="part of the name of a task")
    parser.add_argument("--json", type=Path)
    asked = parser.parse_args()
    os.environ["OMP_NUM_THREADS"] = "1"
    tasks = [
        evaluation("planar", "obstacle_goal", 160),
        evaluation("bullet", "obstacle_goal", 160),
        training("point_goal", 200_000, 4),
        training("obstacle_goal", 400_000, 4),
    ]
    rows = []
    for task in tasks:
        if asked.only in task.name:
            rows.append(measure(task, asked.repeats))
            show(rows[-1])
    if asked.json:
        asked.json.write_text(json.dumps(rows, indent=2), encoding="utf-8")


if __name__ == "__main__":
    main()
