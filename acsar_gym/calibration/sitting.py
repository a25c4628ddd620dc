"""One call of `acsar-gym calibrate`: runs are driven or read from a file, measured, and fitted."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from acsar_gym.calibration import manoeuvres, runs, session
from acsar_gym.calibration.fit import Fit, fit
from acsar_gym.calibration.manoeuvres import Plan
from acsar_gym.calibration.readings import Scales, check
from acsar_gym.calibration.runs import Run
from acsar_gym.calibration.session import ASKED, Given, Wire
from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError

Ask = Callable[[str], str]


class Sitting:
    """Collects runs and their readings.

    Attributes: `found`, all runs so far; `notes`, lines to be told.

    Args:
        config: of the robot.
        given: readings of the options.
        scales: of the readings that a person takes.
        kept_in: file that keeps the runs; existing ones are fitted, too. None: not kept.
        ask: asks a person, who can answer; None where nobody is there.
        known: whether the file must be there already, with runs; ConfigError if not.
    """

    def __init__(
        self,
        config: RobotConfig,
        given: Given,
        scales: Scales,
        kept_in: Path | None = None,
        ask: Ask | None = None,
        *,
        known: bool = False,
    ) -> None:
        self.found: list[Run] = []
        self.notes: list[str] = []
        self._config, self._given, self._scales = config, given, scales
        self._kept_in, self._ask = kept_in, ask
        if kept_in is not None and (known or kept_in.exists()):
            self.found = runs.load(kept_in, config)
        if known and not self.found:
            raise ConfigError(f"{kept_in}: holds no runs: drive some with --runs {kept_in}")

    def drive(
        self,
        wire: Wire,
        plans: Sequence[Plan],
        space: tuple[float, float] | None,
        before: Callable[[Plan], None],
    ) -> None:
        """Drive runs; each is kept as soon as it has ended.

        Raises:
            ConfigError: the space is too small or not stated, or nobody would measure.
            LinkError: the robot can't be driven, or was stopped.
        """
        session.check_counts(plans, self._given)
        told = self._given.any
        truth = wire.simulated and wire.lidar is None and not told
        if not (truth or told or wire.lidar or self._ask or self._kept_in):
            raise ConfigError(
                "nobody would measure: give --measured, --measured-deg or --corners, --lidar, or "
                "--runs FILE to measure now and give the readings later"
            )
        if not wire.simulated and space is None:
            ahead, aside = manoeuvres.needed(plans, wire.config)
            raise ConfigError(
                f"--space is missing: say how much floor is free ahead and to each side; this "
                f"needs --space {ahead + 0.005:.2f} {aside + 0.005:.2f}"
            )
        asks = not (truth or told or wire.lidar)
        session.drive_all(
            wire, plans, space, before, lambda run: self._ended(run, asks=asks), truth=truth
        )

    def add(self, new: Sequence[Run]) -> None:
        """Add runs of a recording."""
        self.found += new
        self._keep()

    def _ended(self, run: Run, *, asks: bool) -> Run:
        """Keep a run that has ended; ask for its readings if `asks`."""
        if any(run.name == one.name for one in self.found):
            run = replace(run, name=f"{run.name} ({len(self.found) + 1})")
        self.found.append(run)
        self._keep()
        if asks and self._ask is not None:
            self.found[-1] = self._asked(run)
            self._keep()
        return run

    def read(self, manoeuvre: str) -> None:
        """Give readings to runs that have none yet: those of the options, then what a person says.

        Raises:
            ConfigError: their number is another one, or a reading contradicts the odometry.
        """
        self.found = session.assigned(self.found, self._given, self._scales)
        self.notes = session.checked(self.found, self._config)
        self._keep()
        for i, run in enumerate(self.found):
            wanted = manoeuvre in (run.manoeuvre, "all")
            if wanted and not run.readings and self._ask is not None:
                self.found[i] = self._asked(run)
                self._keep()

    def fit(self) -> Fit | None:
        """Fit all runs together; None where none has a reading. ConfigError as for `fit.fit`."""
        if not any(run.readings for run in self.found):
            return None
        return fit(self.found, self._config)

    def _asked(self, run: Run) -> Run:
        """Ask until the answer is a reading of this run, or empty."""
        question = f"{run.name}: {ASKED[run.manoeuvre]} (Enter: none)"
        while self._ask is not None:
            try:
                read = session.parsed(run, self._ask(question), self._scales)
                self.notes += [line for line in [check(read, self._config)] if line]
            except ConfigError as error:
                question = f"{error}; again"
            else:
                return read
        return run

    def _keep(self) -> None:
        """Write the runs to their file."""
        if self._kept_in is not None:
            runs.write(self._kept_in, self.found, self._config)
