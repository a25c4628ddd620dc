"""What the command `benchmark` does: run, combine, and write."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from acsar_gym.benchmark import agents, cards, result, runner, submission
from acsar_gym.benchmark.plan import Plan
from acsar_gym.benchmark.store import PLAN, RESULTS, Store
from acsar_gym.benchmark.table import markdown
from acsar_gym.errors import ConfigError, printable
from acsar_gym.evaluation import report
from acsar_gym.reading import bounded
from acsar_gym.registration import IDS


@dataclass(frozen=True)
class Command:
    """Where the results of a benchmark go."""

    out: Path
    """Folder of the store, the table and the JSON."""
    table: Path | None = None
    """Another file for the table."""
    json: Path | None = None
    """Another file for the JSON."""
    cards: Path | None = None
    """Folder for a page of each packaged policy."""
    html: Path | None = None
    """File for the HTML report."""
    worst: int = 10
    """How many of the worst episodes the HTML report shows."""

    def run(
        self,
        plan: Plan,
        policy: str = "",
        workers: int | None = None,
        address: str | None = None,
        *,
        resume: bool = True,
    ) -> None:
        """Run a plan, and write everything.

        Args:
            plan: what to measure.
            policy: the only policy, if it is a submission.
            workers: most processes at a time.
            address: of a Ray cluster.
            resume: go on where the folder's benchmark ended.

        Raises:
            AcsarError: as `runner.run`, and where a file can't be written.
        """
        report.make_folder(self.out)
        if not resume:
            self._forget()
        parts = runner.run(plan, Store(self.out), workers=workers, address=address)
        told = result.result(plan.as_dict(), parts)
        if policy:
            said = submission.write(told, plan.agents[0].name, self.out)
            print(printable(f"row to submit: {said}"))
        self._write(told, plan.agents)

    def combine(self, folders: Sequence[Path], trained: Path | None, seeds: int) -> None:
        """Write everything from the folders of several benchmarks.

        Args:
            folders: of the benchmarks.
            trained: folder of the trained policies, for films of their worst episodes.
            seeds: most training seeds of each.

        Raises:
            ConfigError: a folder can't be used, or a file can't be written.
        """
        report.make_folder(self.out)
        told = result.result(*result.combined(folders))
        self._write(told, agents.chosen((), tuple(IDS), trained, seeds) if self.html else ())

    def _forget(self) -> None:
        """Remove the results of an earlier run."""
        for name in (PLAN, RESULTS):
            with contextlib.suppress(FileNotFoundError):
                try:
                    (self.out / name).unlink()
                except PermissionError as error:
                    raise ConfigError(f"{self.out / name}: {bounded.reason(error)}") from None

    def _write(self, told: Mapping[str, Any], some: Sequence[agents.Agent]) -> None:
        """Write JSON, tables, cards and report, and say where they are."""
        page = markdown(told)
        for path in (self.out / result.FILE, self.json):
            if path is not None:
                result.write(path, told)
        for path in (self.out / result.TABLE, self.table):
            if path is not None:
                bounded.write_atomically(path, page.encode())
                print(printable(f"tables: {path}"))
        if self.cards is not None:
            report.make_folder(self.cards)
            for path in cards.write(told, self.cards):
                print(printable(f"card: {path}"))
        if self.html is not None:
            from acsar_gym.benchmark.page import report as html  # noqa: PLC0415 - optional

            html.write(told, self.html, some, self.worst)
            print(printable(f"report: {self.html}"))
