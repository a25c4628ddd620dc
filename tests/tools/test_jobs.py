"""Jobs in processes of this machine. Tests/scale has the clusters."""

from __future__ import annotations

import itertools
import os
import re
import signal
import socket
import subprocess
import sys
import time
import warnings
from pathlib import Path

import psutil
import pytest
from job_tools import Job, broken, missing, square, threads

from acsar_gym.errors import AcsarError, LinkError, MissingExtraError
from acsar_gym.tools import jobs
from acsar_gym.tools.jobs import run_jobs

pytestmark = pytest.mark.xdist_group(__name__)
TESTS = Path(__file__).parents[1]


@pytest.fixture(autouse=True)
def _workers_find_the_jobs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(TESTS), str(TESTS.parent)]))


def test_run_jobs_yields_results_in_order_of_completion(tmp_path: Path) -> None:
    """The first job waits until the others' results, by another process, have arrived."""
    waiting = Job(0, tmp_path, waits=tmp_path / "arrived")
    results = run_jobs(square, [waiting, *(Job(n, tmp_path) for n in range(1, 5))], workers=2)
    assert sorted(itertools.islice(results, 4)) == [(n, n**2) for n in range(1, 5)]
    (tmp_path / "arrived").touch()
    assert list(results) == [(0, 0)]


def test_run_jobs_leaves_the_callers_warnings_alone(tmp_path: Path) -> None:
    def warn_between() -> None:
        results = run_jobs(square, [Job(0, tmp_path), Job(1, tmp_path)], workers=2)
        next(results)
        warnings.warn("between two results", stacklevel=1)
        assert len(list(results)) == 1

    with pytest.warns(UserWarning, match="between two results"):
        warn_between()


def test_run_jobs_reports_a_process_that_ended(tmp_path: Path) -> None:
    with pytest.raises(AcsarError, match="a process that ran a job ended") as error:
        list(run_jobs(square, [Job(7, tmp_path, deaths=99), Job(1, tmp_path)], workers=2))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("workers", [1, 2])
def test_run_jobs_raises_an_error_of_this_package_as_it_is(workers: int) -> None:
    with pytest.raises(MissingExtraError, match=re.escape("constraints.txt '.[scale]'")):
        list(run_jobs(missing, [1, 2], workers=workers))


def test_run_jobs_names_the_job_of_other_errors() -> None:
    with pytest.raises(AcsarError, match=r"job 5: ZeroDivisionError: .*--workers 1 shows where"):
        list(run_jobs(broken, [5, 5], workers=2))


def list_jobs(folder: Path) -> list[Path]:
    """Files of the jobs that have started."""
    return list(folder.glob("start-*"))


def ignores_interrupts(process: int) -> bool:
    status = Path(f"/proc/{process}/status").read_text(encoding="ascii")
    (line,) = (line for line in status.splitlines() if line.startswith("SigIgn:"))
    return bool(int(line.split()[1], 16) >> (signal.SIGINT - 1) & 1)


INTERRUPTED = """
import sys
from pathlib import Path
from job_tools import Job, square
from acsar_gym.tools.jobs import run_jobs

if __name__ == "__main__":
    folder = Path(sys.argv[1])
    jobs = [Job(number, folder, waits=folder / "never") for number in range(3)]
    try:
        list(run_jobs(square, jobs, workers=2))
    except KeyboardInterrupt:
        print("interrupted", flush=True)
"""


@pytest.mark.parametrize("moment", ["starting", "running"])
def test_run_jobs_ends_all_processes_upon_ctrl_c(moment: str, tmp_path: Path) -> None:
    """As on a terminal, where it reaches them all."""
    script = tmp_path / "script.py"
    script.write_text(INTERRUPTED, encoding="utf-8")
    running = subprocess.Popen(
        [sys.executable, str(script), str(tmp_path)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )

    def list_workers() -> list[int]:
        children = psutil.Process(running.pid).children()
        return [child.pid for child in children if "popen_loky" in " ".join(child.cmdline())]

    while len(list_workers()) < 2 or (moment == "running" and len(list_jobs(tmp_path)) < 2):
        assert running.poll() is None
        time.sleep(0.05)
    while ignores_interrupts(running.pid):
        time.sleep(0.01)
    workers = list_workers()
    time.sleep(0.2)  # imports are interrupted, and not the start of Python
    os.killpg(running.pid, signal.SIGINT)
    out, error = running.communicate(timeout=60.0)
    assert (out, error) == ("interrupted\n", "")
    for worker in workers:
        with pytest.raises(ProcessLookupError):
            os.kill(worker, 0)


@pytest.mark.parametrize("kind", ["", "ray://"])
def test_run_jobs_reports_an_address_that_doesnt_answer(
    kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("ray")
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"{kind}127.0.0.1:{server.getsockname()[1]}"
    with pytest.raises(LinkError, match=f"--address '{address}': .*: start a cluster"):
        list(run_jobs(threads, [""], address=address))
    monkeypatch.setenv("RAY_ADDRESS", address)
    with pytest.raises(LinkError, match=r"'auto': .*: start a cluster"):
        list(run_jobs(threads, [""], address="auto"))


def test_run_jobs_reports_an_address_of_another_program(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ray itself would wait for it without an end."""
    pytest.importorskip("ray")
    monkeypatch.setattr(jobs, "CLUSTER_TIMEOUT", 0.5)
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"127.0.0.1:{server.getsockname()[1]}"
        with pytest.raises(LinkError, match=f"--address '{address}': .*isn't a Ray cluster"):
            list(run_jobs(threads, [""], address=address))
