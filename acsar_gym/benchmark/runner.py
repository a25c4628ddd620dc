"""Runs a plan: the jobs that aren't finished yet, in parallel, each result kept at once."""

from __future__ import annotations

import contextlib
from collections.abc import Generator, Iterator, Sequence

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn
from rich.progress import TimeElapsedColumn as Elapsed
from rich.progress import TimeRemainingColumn as Remaining

from acsar_gym.benchmark import worker
from acsar_gym.benchmark.plan import Job, Plan
from acsar_gym.benchmark.store import Cell, Part, Store
from acsar_gym.errors import CancelledError
from acsar_gym.evaluation import report
from acsar_gym.scaling import completed

Key = tuple[Cell, int]


def run(
    plan: Plan, store: Store, *, workers: int | None = None, address: str | None = None
) -> list[Part]:
    """Run what isn't finished, and keep every part as soon as it is.

    Args:
        plan: what to measure.
        store: where results are kept; goes on where an earlier run with this plan ended.
        workers: most jobs at a time.
        address: of a Ray cluster.

    Returns:
        All parts, those of earlier runs too.

    Raises:
        CancelledError: after Ctrl-C; the message says how much is finished.
        ConfigError: the scenes or the folder can't be used, or the disk is full.
        LinkError, JobError, ClusterError: a job can't be run.
    """
    plan.check()
    done = {(part.cell, part.first): part for part in store.open(plan.as_dict())}
    every = list(plan.jobs())
    waiting = [job for job in every if (job.cell, job.first) not in done]
    running = completed(worker.run, waiting, workers=workers, address=address)
    try:
        with _progress(every, waiting) as advance, contextlib.closing(_generator(running)) as parts:
            for number, part in parts:
                done[part.cell, part.first] = store.add(part)
                advance(waiting[number])
    except KeyboardInterrupt:
        raise CancelledError(
            f"interrupted: {len(done)} of {len(every)} parts are kept in {store.folder}; the same "
            "command goes on with the others"
        ) from None
    return _in_order(every, done)


def _generator(running: Iterator[tuple[int, Part]]) -> Generator[tuple[int, Part], None, None]:
    """Wrap an iterator, so that closing it ends the running jobs."""
    yield from running


def _in_order(every: Sequence[Job], done: dict[Key, Part]) -> list[Part]:
    """The finished parts in the order of the plan, however they were finished."""
    return [done[job.cell, job.first] for job in every if (job.cell, job.first) in done]


class _Advance:
    """Moves a progress bar on by the episodes of a job."""

    def __init__(self, progress: Progress, total: int, done: int) -> None:
        self._progress = progress
        self._task = progress.add_task("", total=total, completed=done)

    def __call__(self, job: Job) -> None:
        """Note that a job is done."""
        cell = job.cell
        seed = "" if cell.training_seed is None else f" {cell.training_seed}"
        told = f"{cell.id} {cell.link} {cell.condition} {cell.agent}{seed}"
        self._progress.update(self._task, advance=job.count, description=report.plain(told))


@contextlib.contextmanager
def _progress(every: Sequence[Job], waiting: Sequence[Job]) -> Iterator[_Advance]:
    """Show a progress bar on stderr, in episodes."""
    total = sum(job.count for job in every)
    columns = (
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("episodes"),
        Elapsed(),
        Remaining(),
        TextColumn("{task.description}"),
    )
    with Progress(*columns, console=report.SafeConsole(stderr=True)) as progress:
        yield _Advance(progress, total, total - sum(job.count for job in waiting))
