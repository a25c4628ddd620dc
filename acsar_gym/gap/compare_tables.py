"""A comparison as a table in the terminal, and as JSON."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from rich.table import Table

from acsar_gym.evaluation.metrics import finite
from acsar_gym.evaluation.report import plain
from acsar_gym.gap.paired import Comparison
from acsar_gym.gap.sides import VALUES, Sides, conclusion, distances
from acsar_gym.gap.tables import between, cell


def columns(sides: Sides) -> tuple[str, ...]:
    """Return the headings of `rows`."""
    first, second = sides.names
    around = "95 % interval"
    return ("metric", "unit", first, around, second, around, "difference", around, "pairs")


def rows(sides: Sides) -> list[tuple[str, ...]]:
    """Return a row for every metric that both sides have."""
    return [_row(name, one) for name, one in sides.comparisons().items()]


def _row(name: str, one: Comparison) -> tuple[str, ...]:
    """Format one metric."""
    value = VALUES[name]
    cells = [value.label, value.unit]
    for mean, interval in zip(one.values, one.intervals, strict=True):
        cells += [cell(mean, value.scale), between(interval, value.scale)]
    mark = " *" if one.differs else ""
    cells.append(cell(one.difference, value.scale) + mark)
    return (*cells, between(one.interval, value.scale), str(one.pairs))


def table(sides: Sides) -> Table:
    """Make the table of a comparison."""
    task = sides.task or "recordings without an environment"
    title = f"{task}: {sides.names[0]} and {sides.names[1]}, episodes paired by seed"
    if sides.policies:
        title += f"; {sides.policies}"
    made = Table(title=plain(title), title_justify="left")
    for number, name in enumerate(columns(sides)):
        made.add_column(plain(name), justify="left" if number < 2 else "right")
    for row in rows(sides):
        made.add_row(*row)
    made.caption = "* the interval of the paired difference leaves out zero"
    return made


def as_dict(sides: Sides) -> dict[str, Any]:
    """Return the comparison for JSON, in SI units; what isn't known is null."""
    pairs = [
        {
            "seed": first.key[0],
            "values": {n: [v.of(first), v.of(second)] for n, v in VALUES.items()},
        }
        for first, second in sides.pairs
    ]
    told: dict[str, Any] = finite(
        {
            "task": sides.task,
            "sides": list(sides.names),
            "episodes": [len(side) for side in sides.outcomes],
            "metrics": {name: asdict(one) for name, one in sides.comparisons().items()},
            "delays": asdict(sides.delays()),
            "observation_distances": distances(*sides.observations()),
            "action_distances": distances(*sides.actions()),
            "pairs": pairs,
            "notes": list(sides.notes),
            "conclusion": conclusion(sides),
        }
    )
    return told


def sizes(sides: Sides) -> dict[str, float]:
    """Return the differences by metric, for `--fail-over`; NaN where they aren't known."""
    known = {name: one.difference for name, one in sides.comparisons().items()}
    found = {name: known.get(name, float("nan")) for name in VALUES}
    return found | {"delay": sides.delays().difference}
