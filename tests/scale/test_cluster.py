"""Jobs and evaluations on a Ray cluster of two nodes; run by `make test-scale`."""

from __future__ import annotations

import json
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
from cluster_tools import Nodes, nodes
from job_tools import Job, broken, missing, square

from acsar_gym.errors import AcsarError, MissingExtraError
from acsar_gym.resources import AGENTS
from acsar_gym.tools.evaluation import runs
from acsar_gym.tools.jobs import run_jobs

PATIENCE = 120.0


@pytest.fixture(scope="module")
def cluster() -> Iterator[Nodes]:
    with nodes(2) as running:
        yield running


def test_jobs_run_on_both_nodes_and_their_results_come_in_order_of_completion(
    cluster: Nodes, tmp_path: Path
) -> None:
    """The first job waits for the second's result, which only another CPU can compute."""
    jobs = [Job(0, tmp_path, waits=tmp_path / "arrived"), Job(1, tmp_path)]
    results = run_jobs(square, jobs, address=cluster.address)
    assert next(results) == (1, 1)
    (tmp_path / "arrived").touch()
    assert list(results) == [(0, 0)]


def test_errors_are_those_of_one_process(cluster: Nodes, tmp_path: Path) -> None:
    with pytest.raises(MissingExtraError, match="this job needs an extra"):
        list(run_jobs(missing, [1], address=cluster.address))
    with pytest.raises(AcsarError, match=r"job 5: ZeroDivisionError.*job_tools\.py, line \d+\)"):
        list(run_jobs(broken, [5], address=cluster.address))
    with pytest.raises(AcsarError, match="a process that ran a job ended"):
        list(run_jobs(square, [Job(7, tmp_path, deaths=99)], address=cluster.address))


def test_a_closed_iterator_ends_running_jobs_in_good_order(cluster: Nodes, tmp_path: Path) -> None:
    jobs = [Job(0, tmp_path), Job(1, tmp_path, waits=tmp_path / "never")]
    results: Any = run_jobs(square, jobs, address=cluster.address)
    assert next(results) == (0, 0)
    while not list(tmp_path.glob("start-1-*")):
        time.sleep(0.01)
    results.close()
    assert (tmp_path / "end-1").exists()


def test_a_killed_node_costs_no_result_of_an_evaluation(monkeypatch: pytest.MonkeyPatch) -> None:
    policy, seeds = runs.load_policy("obstacle_goal", trust=False), range(60)
    with nodes(2) as cluster:

        def noticed(*arguments: Any, **options: Any) -> Iterator[Any]:
            for count, result in enumerate(run_jobs(*arguments, **options)):
                if count == 2:
                    cluster.kill(0)
                yield result

        monkeypatch.setattr(runs, "run_jobs", noticed)
        address = cluster.address
        found = runs.evaluate_policy(policy, "planar", None, seeds, address=address)
    expected = runs.evaluate_policy(policy, "planar", None, seeds)
    assert repr((found.results, found.worlds)) == repr((expected.results, expected.worlds))


def command(*arguments: str) -> list[str]:
    return [sys.executable, "-m", "acsar_gym", "evaluate", "--link", "planar", *arguments]


def test_the_command_runs_on_a_cluster_and_prints_nothing_of_ray(
    cluster: Nodes, tmp_path: Path
) -> None:
    file = tmp_path / "results.json"
    asked = ("--episodes", "20", "--json", str(file), "--address", cluster.address)
    ended = subprocess.run(
        command(*asked), check=False, capture_output=True, text=True, timeout=PATIENCE
    )
    assert (ended.returncode, ended.stderr) == (0, "")
    assert "ray" not in ended.stdout.lower()
    header = json.loads(file.read_text(encoding="utf-8"))["header"]
    assert (header["workers"], header["address"]) == (None, cluster.address)


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


def test_ctrl_c_on_a_cluster_keeps_what_is_finished(cluster: Nodes, tmp_path: Path) -> None:
    file, policy, marker = (tmp_path / name for name in ("results.json", "idle.py", "marker"))
    policy.write_text(IDLE.format(calls=20 * 200, marker=str(marker)), encoding="utf-8")
    asked = ("--policy", f"{policy}:act", "--env", "point_goal", "--episodes", "100000")
    running = subprocess.Popen(
        command(*asked, "--json", str(file), "--address", cluster.address),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    while not marker.exists():
        assert running.poll() is None
        time.sleep(0.1)
    running.send_signal(signal.SIGINT)
    _, error = running.communicate(timeout=PATIENCE)
    assert running.returncode == 130
    assert error.strip().startswith("acsar-gym: interrupted")
    assert "Traceback" not in error
    data = json.loads(file.read_text(encoding="utf-8"))
    assert data["ended_early"] == "interrupted"
    assert 0 < data["episodes"] < 100_000


def test_ray_of_this_machine_alone(tmp_path: Path) -> None:
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[1])}
    script = (
        "from job_tools import threads\nfrom acsar_gym.tools.jobs import run_jobs\n"
        "print(list(run_jobs(threads, ['OMP_NUM_THREADS'], workers=1, address='local')))\n"
    )
    ended = subprocess.run(
        [sys.executable, "-c", script],
        check=False,
        capture_output=True,
        text=True,
        env=environment,
    )
    assert (ended.stdout, ended.stderr) == ("[(0, '1')]\n", "")


def test_trainings_of_seeds_run_on_a_cluster(tmp_path: Path) -> None:
    """One of the nodes dies while both train."""
    out = tmp_path / "out"
    asked = ["--env", "point_goal", "--steps", "300000", "--robots", "64", "--seeds", "0-1"]
    with nodes(2) as cluster:
        arguments = [*asked, "--out", str(out), "--address", cluster.address]
        running = subprocess.Popen([sys.executable, "-m", "acsar_gym", "train", *arguments])
        begun: set[Path] = set()
        killed = False
        while running.poll() is None:
            begun |= set(out.glob("seed-?/learning_curve.csv"))
            if len(begun) == 2 and not killed:
                cluster.kill(0)
                killed = True
            time.sleep(0.05)
        assert running.returncode == 0
        assert killed
    rows = (out / "seeds.csv").read_text(encoding="utf-8").splitlines()[1:]
    assert [row.partition(",")[0] for row in rows] == ["0", "1"]
    for seed in (0, 1):
        assert runs.load_policy(str(out / f"seed-{seed}" / "policy.onnx"), trust=False)


def test_a_sweep_with_ray_tune_prints_its_table(
    cluster: Nodes, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sweep = runpy.run_path(str(AGENTS / "examples" / "tune_randomization.py"))["main"]
    few = {"env": "point_goal", "levels": (0, 3), "seeds": "0-1", "steps": 1, "episodes": 2}
    sweep(**few, address=cluster.address, out=tmp_path)
    rows = [line.split() for line in capsys.readouterr().out.splitlines() if "%" in line]
    assert [row[:2] for row in rows] == [["0", "2"], ["3", "2"]]
