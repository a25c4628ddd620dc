"""Jobs and evaluations on a Ray cluster of two nodes, run by `make test-scale`."""

from __future__ import annotations

import contextlib
import os
import runpy
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from job_tools import Job, broken, missing, square

from acsar_gym.errors import AcsarError, MissingExtraError
from acsar_gym.resources import AGENTS
from acsar_gym.tools.benchmark import runner
from acsar_gym.tools.benchmark.plan import Plan, choose_agents
from acsar_gym.tools.benchmark.scenes import find_sets
from acsar_gym.tools.evaluation import runs
from acsar_gym.tools.jobs import run_jobs

TESTS = Path(__file__).parent


@contextlib.contextmanager
def two_nodes() -> Iterator[Any]:
    """A cluster with one CPU a node inside the block. Its processes can import tests' modules."""
    from ray.cluster_utils import Cluster

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", os.pathsep.join([str(TESTS), str(TESTS.parent)]))
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        head = {"num_cpus": 1, "include_dashboard": False}
        running: Any = Cluster(initialize_head=True, head_node_args=head)
        try:
            running.add_node(num_cpus=1)
            running.wait_for_nodes()
            yield running
        finally:
            running.shutdown()


def kill_worker(cluster: Any) -> None:
    """SIGKILL the node that isn't the head, as when its power fails."""
    (worker,) = cluster.worker_nodes
    (raylet,) = worker.all_processes["raylet"]
    os.kill(raylet.process.pid, signal.SIGKILL)


PATIENCE = 120.0


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    with two_nodes() as running:
        yield running


def test_run_jobs_on_both_nodes_yields_results_in_order_of_completion(
    cluster: Any, tmp_path: Path
) -> None:
    """The first job waits for the second's result, which only another CPU can compute."""
    jobs = [Job(0, tmp_path, waits=tmp_path / "arrived"), Job(1, tmp_path)]
    results = run_jobs(square, jobs, address=cluster.address)
    assert next(results) == (1, 1)
    (tmp_path / "arrived").touch()
    assert list(results) == [(0, 0)]


def test_run_jobs_raises_the_errors_of_one_process(cluster: Any, tmp_path: Path) -> None:
    with pytest.raises(MissingExtraError, match="this job needs an extra"):
        list(run_jobs(missing, [1], address=cluster.address))
    with pytest.raises(AcsarError, match=r"job 5: ZeroDivisionError.*--workers 1 shows where"):
        list(run_jobs(broken, [5], address=cluster.address))
    with pytest.raises(AcsarError, match="a process that ran a job ended"):
        list(run_jobs(square, [Job(7, tmp_path, deaths=99)], address=cluster.address))


def test_run_jobs_ends_running_jobs_if_it_is_closed(cluster: Any, tmp_path: Path) -> None:
    jobs = [Job(0, tmp_path), Job(1, tmp_path, waits=tmp_path / "never")]
    results: Any = run_jobs(square, jobs, address=cluster.address)
    assert next(results) == (0, 0)
    while not list(tmp_path.glob("start-1-*")):
        time.sleep(0.01)
    results.close()
    assert (tmp_path / "end-1").exists()


def test_run_plan_loses_no_result_with_a_killed_node(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    sets = find_sets("acsar_gym/PointGoal-v0")
    agents = choose_agents(["packaged", "turn_drive"], sets, None, seeds=1)
    conditions = ("nominal", "feedback-30", "dropped-2")
    plan = Plan(tuple(agents), tuple(sets), ("planar",), conditions, count=5)
    folders = [runner.open_folder(plan, tmp_path / name, None) for name in ("here", "cluster")]
    expected = runner.run_plan(plan, folders[0])
    with two_nodes() as cluster:

        def run_and_kill(*arguments: Any, **options: Any) -> Iterator[Any]:
            for count, result in enumerate(run_jobs(*arguments, **options)):
                if count == 2:
                    kill_worker(cluster)
                yield result

        monkeypatch.setattr(runner, "run_jobs", run_and_kill)
        results = runner.run_plan(plan, folders[1], address=cluster.address)
    assert [repr(result.episodes) for result in results.values()] == [
        repr(result.episodes) for result in expected.values()
    ]


def command(cluster: Any, *arguments: str | Path) -> dict[str, Any]:
    """What runs a small benchmark on a cluster, for `subprocess`."""
    small = ("--env", "point_goal", "--sets", "open/acsar", "--links", "planar")
    options = [*small, *map(str, arguments), "--address", cluster.address]
    texts = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return {"args": [sys.executable, "-m", "acsar_gym", "benchmark", *options], **texts}


def test_benchmark_on_a_cluster_prints_nothing_of_ray(cluster: Any, tmp_path: Path) -> None:
    small = ("--agents", "packaged", "--scenes", "20", "--out", tmp_path / "run")
    ended = subprocess.run(**command(cluster, *small), check=False, timeout=PATIENCE)
    assert (ended.returncode, ended.stderr) == (0, "")
    assert "ray" not in ended.stdout.lower()
    assert (tmp_path / "run" / runner.RESULT_FILE).exists()


IDLE = """
from pathlib import Path

calls = 0

def act(observation):
    global calls
    calls += 1
    if calls == {calls}:
        Path({marker!r}).touch()
    return 0.0, 0.0
"""
"""A policy that leaves a file when it has been called often enough for 20 episodes."""


def test_benchmark_on_a_cluster_ends_by_ctrl_c(cluster: Any, tmp_path: Path) -> None:
    policy = tmp_path / "idle.py"
    marker = tmp_path / "marker"
    policy.write_text(IDLE.format(calls=20 * 200, marker=str(marker)), encoding="utf-8")
    large = ("--agents", f"{policy}:act", "--scenes", "1000", "--out", tmp_path / "run")
    running = subprocess.Popen(**command(cluster, *large))
    while not marker.exists():
        assert running.poll() is None
        time.sleep(0.1)

    running.send_signal(signal.SIGINT)
    _, error = running.communicate(timeout=PATIENCE)
    assert running.returncode == 130
    assert error.strip().startswith("acsar-gym: interrupted: 0 of 1 cells are finished")
    assert "Traceback" not in error


def test_run_jobs_on_a_cluster_of_its_own(tmp_path: Path) -> None:
    script = (
        "from job_tools import threads\nfrom acsar_gym.tools.jobs import run_jobs\n"
        "print(list(run_jobs(threads, ['OMP_NUM_THREADS'], workers=1, address='local')))\n"
    )
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[1])}
    started = [sys.executable, "-c", script]
    done = subprocess.run(started, check=False, capture_output=True, text=True, env=environment)
    assert (done.stdout, done.stderr) == ("[(0, '1')]\n", "")


def test_trainings_of_seeds_run_on_a_cluster(tmp_path: Path) -> None:
    """One of the nodes dies while both train."""
    out = tmp_path / "out"
    options = ["--env", "point_goal", "--steps", "300000", "--robots", "64", "--seeds", "0-1"]
    with two_nodes() as cluster:
        arguments = [*options, "--out", str(out), "--address", cluster.address]
        running = subprocess.Popen([sys.executable, "-m", "acsar_gym", "train", *arguments])
        is_killed = False
        while running.poll() is None:
            if not is_killed and len([*out.glob("seed-?/learning_curve.csv")]) == 2:
                kill_worker(cluster)
                is_killed = True
            time.sleep(0.05)
        assert running.returncode == 0
        assert is_killed

    rows = (out / "seeds.csv").read_text(encoding="utf-8").splitlines()[1:]
    assert [row.partition(",")[0] for row in rows] == ["0", "1"]
    for seed in (0, 1):
        assert runs.load_policy(str(out / f"seed-{seed}" / "policy.onnx"), trust=False)


def test_a_sweep_with_ray_tune_prints_its_table(
    cluster: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sweep = runpy.run_path(str(AGENTS / "examples" / "tune_randomization.py"))["main"]
    few = {"env": "point_goal", "levels": (0, 3), "seeds": "0-1", "steps": 1, "episodes": 2}
    sweep(**few, address=cluster.address, out=tmp_path)
    rows = [line.split() for line in capsys.readouterr().out.splitlines() if "%" in line]
    assert [row[:2] for row in rows] == [["0", "2"], ["3", "2"]]
