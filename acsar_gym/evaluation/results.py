"""The results of an evaluation, complete or ended early."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from acsar_gym.errors import EmergencyStopError, LinkError
from acsar_gym.evaluation import metrics, report
from acsar_gym.evaluation.episodes import EpisodeResult
from acsar_gym.evaluation.metrics import Summary


@dataclass(frozen=True, slots=True)
class Run:
    """Results of an evaluation, and what it was run with."""

    header: dict[str, Any]
    """What is needed to repeat it; see `provenance`."""
    worlds: str
    """Description of the worlds, such as "clutter 0 to 199 (test split)" or "none"."""
    results: list[EpisodeResult]
    ended: LinkError | KeyboardInterrupt | None = None
    """What ended it before its last episode; None for an evaluation that is complete."""

    @property
    def faults(self) -> list[str]:
        """The faults that ended episodes."""
        return [result.fault for result in self.results if result.fault]

    @property
    def late(self) -> int:
        """Number of episodes with too many late ticks."""
        return sum(not result.valid and not result.fault for result in self.results)

    @property
    def notes(self) -> list[str]:
        """Faults, and an end before the last episode, as lines for people."""
        notes = []
        if self.faults:
            notes.append(f"Faults: {len(self.faults)} of {len(self.results)}: {self.faults[0]}")
        if self.ended is not None:
            asked = self.header["seeds"]
            count = asked["last"] - asked["first"] + 1
            notes.append(f"Ended after {len(self.results)} of {count} episodes: {self._why}.")
        return notes

    @property
    def _why(self) -> str | None:
        """Why it ended early."""
        return None if self.ended is None else str(self.ended) or "interrupted"

    @property
    def summary(self) -> Summary:
        """Rates and means over the episodes."""
        return metrics.summarise(self.results)

    def as_dict(self) -> dict[str, Any]:
        """Return header, means and every episode, for JSON."""
        episodes = metrics.per_episode(self.results)
        early = {"ended_early": self._why}
        return {"header": self.header, **self.summary.as_dict(), **early, "per_episode": episodes}


def collect(
    running: Iterator[EpisodeResult], results: list[EpisodeResult]
) -> LinkError | KeyboardInterrupt | None:
    """Collect results; returns what ended the evaluation early, None where nothing did.

    A link's error before the first result is raised, unless it is an emergency stop.
    """
    try:
        for result in running:
            results.append(result)  # noqa: PERF402 - what is there counts where the rest fails
    except (EmergencyStopError, KeyboardInterrupt) as error:
        return error
    except LinkError as error:
        if not results:
            raise
        return error
    return None


def track(name: str, running: Iterator[EpisodeResult], count: int) -> Iterator[EpisodeResult]:
    """Yield results, with a progress bar that shows the success rate."""
    wins = 0
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("episodes, success {task.fields[rate]}"),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=report.SafeConsole()) as progress:
        task = progress.add_task(report.plain(name), total=count, rate="-")
        for number, result in enumerate(running, start=1):
            yield result
            wins += result.success
            progress.update(task, advance=1, rate=f"{wins / number:.0%}")
