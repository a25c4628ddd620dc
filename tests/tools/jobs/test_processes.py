"""Jobs in processes of this machine."""

from __future__ import annotations

import multiprocessing
import os
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from job_tools import Job, broken, compiling, missing, square, threads

from acsar_gym.errors import JobError, MissingExtraError
from acsar_gym.tools.jobs import completed

pytestmark = pytest.mark.xdist_group(__name__)


@pytest.fixture(autouse=True)
def _all_ended() -> Iterator[None]:
    """No process is left after a test."""
    before = {*multiprocessing.active_children()}
    yield
    assert {*multiprocessing.active_children()} <= before


def test_one_worker_is_this_process(tmp_path: Path) -> None:
    jobs = [Job(number, tmp_path) for number in range(3)]
    assert list(completed(square, jobs)) == [(0, 0), (1, 1), (2, 4)]
    started = {path.name.rpartition("-")[2] for path in tmp_path.glob("start-*")}
    assert started == {str(os.getpid())}


def test_no_jobs_start_no_process() -> None:
    assert not list(completed(square, [], workers=2))
    assert not list(completed(square, [], address="nowhere:1"))


def test_results_come_in_order_of_completion_and_a_dead_process_costs_none(tmp_path: Path) -> None:
    """The first job ends two processes, then waits for the last job, which the other one runs."""
    last = tmp_path / "end-4"
    jobs = [Job(0, tmp_path, deaths=2, waits=last), *(Job(n, tmp_path) for n in range(1, 5))]
    results = list(completed(square, jobs, workers=2))
    assert results[-1] == (0, 0)
    assert sorted(results) == [(n, n**2) for n in range(5)]
    assert len(list(tmp_path.glob("start-0-*"))) == 3


def test_a_job_that_ends_every_process_is_named(tmp_path: Path) -> None:
    with pytest.raises(JobError, match=r"Job\(number=7.*ended 4 processes.*SIGKILL"):
        list(completed(square, [Job(7, tmp_path, deaths=99), Job(1, tmp_path)], workers=2))


def test_one_process_says_that_it_compiles(capfd: pytest.CaptureFixture[str]) -> None:
    """Each of them has a job."""
    assert sorted(completed(compiling, [1, 2], workers=2)) == [(0, 1), (1, 2)]
    assert capfd.readouterr().err == "compiling\n"


@pytest.mark.parametrize("workers", [1, 2])
def test_an_error_of_this_package_arrives_as_it_is(workers: int) -> None:
    with pytest.raises(MissingExtraError, match=re.escape("pip install 'acsar_gym[scale]'")):
        list(completed(missing, [1, 2], workers=workers))


def test_another_error_names_the_job_and_the_line() -> None:
    with pytest.raises(JobError, match=r"job 5: ZeroDivisionError.*job_tools\.py, line \d+\)"):
        list(completed(broken, [5, 5], workers=2))


def test_a_closed_iterator_ends_running_jobs_in_good_order(tmp_path: Path) -> None:
    jobs = [Job(0, tmp_path), Job(1, tmp_path, waits=tmp_path / "never")]
    results = completed(square, jobs, workers=2)
    assert next(results) == (0, 0)
    while not list(tmp_path.glob("start-1-*")):
        pass
    results.close()
    assert (tmp_path / "end-1").exists()


def test_processes_leave_each_other_the_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("OMP_NUM_THREADS")
    assert dict(completed(threads, ["OMP_NUM_THREADS"] * 2, workers=2)) == {0: "1", 1: "1"}
    assert "OMP_NUM_THREADS" not in os.environ
