"""The card of each packaged policy: how it was trained, its figures, and its known weaknesses."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from acsar_gym import reading
from acsar_gym.errors import escape_unprintable
from acsar_gym.resources import AGENTS
from acsar_gym.tools.benchmark.plan import BASELINE, NOMINAL, PACKAGED
from acsar_gym.tools.benchmark.table import LINK_NAMES, main_table
from acsar_gym.tools.policies import OnnxPolicy

Told = Mapping[str, Any]
WEAK = 0.96
"""A condition is a weakness where success falls below this share of nominal."""


def write(told: Told, folder: Path) -> Iterator[Path]:
    """Write a page for each packaged policy that a benchmark has figures of.

    Args:
        told: result of the benchmark.
        folder: to write to.

    Yields:
        The files.

    Raises:
        ConfigError: a file can't be written.
    """
    agent = told["header"]["agents"].get(PACKAGED)
    for each in agent["policies"] if agent else ():
        file = AGENTS / "policies" / each["file"]
        path = folder / f"{file.stem}.md"
        reading.write_atomically(path, card(OnnxPolicy(file), each["id"], told).encode())
        yield path


def card(policy: OnnxPolicy, env_id: str, told: Told) -> str:
    """Return the card of a policy.

    Args:
        policy: the file.
        env_id: its id, without namespace.
        told: result of a benchmark.
    """
    rows = [row for row in told["rows"] if row["id"] == env_id and row["agent"] == PACKAGED]
    nominal = [row for row in rows if row["condition"] == NOMINAL]
    scenes = told["header"]["scenes"][env_id]
    names = "; ".join(
        f"{name}: {about['count']} from {about['first']} on, sha256 {about['sha256'][:16]}"
        for name, about in scenes.items()
    )
    weak = [f"- {line}" for line in weaknesses(rows, told)] or ["- none was found."]
    parts = [
        f"# {policy.path.name}",
        f"Drives `acsar_gym/{env_id}`; `acsar-gym benchmark --cards` writes this page.",
        f"SHA-256 `{policy.sha256}`",
        "## Training",
        "\n".join(trained(policy)),
        "## Figures",
        f"Scenes: {names}. See [the benchmark](../benchmark.md) for what the columns mean.",
        main_table(nominal),
        "## Known weaknesses",
        "\n".join(weak),
    ]
    return "\n\n".join(parts) + "\n"


def trained(policy: OnnxPolicy) -> list[str]:
    """Return how a policy was trained, as lines of a list."""
    bundle = policy.bundle
    training = None if bundle is None else bundle.training
    if bundle is None or training is None:
        return ["Not known: the file doesn't say."]
    said = {
        "command": training.command and f"`{training.command}`",
        "algorithm": training.algorithm,
        "seed": training.seed,
        "steps": training.steps and f"{training.steps:,}",
        "time": training.seconds and f"{training.seconds:.0f} s",
        "worlds": bundle.env.worlds,
        "source": training.revision,
        "versions": ", ".join(f"{name} {text}" for name, text in training.versions.items()),
        "finished": training.finished,
    }
    return [
        f"- {name}: {escape_unprintable(str(text))}"
        for name, text in said.items()
        if text or text == 0
    ]


def weaknesses(rows: Sequence[Told], told: Told) -> Iterator[str]:
    """Yield what the figures say against a policy.

    Args:
        rows: of the policy, under all conditions.
        told: result of the benchmark.
    """
    nominal = {
        (row["link"], row["scenes"]): row
        for row in rows
        if row["condition"] == NOMINAL and not row["refused"]
    }
    for row in nominal.values():
        yield from _failures(row)
    for row in rows:
        yield from _worse(row, nominal, told["header"]["conditions"])
    for row in nominal.values():
        yield from _beaten(row, told["rows"])


def _failures(row: Told) -> Iterator[str]:
    """How nominal episodes fail."""
    place = f"{LINK_NAMES[row['link']]}, {row['scenes']} scenes"
    for name, what in (("collision_rate", "touches an obstacle"), ("fault_rate", "faults")):
        if row[name]:
            yield f"{place}: {what} in {row[name]:.1%} of the episodes"
    late = 1.0 - row["success_rate"] - row["collision_rate"] - row["fault_rate"]
    if late > 1e-9:
        yield f"{place}: {late:.1%} end without goal or collision"


def _worse(row: Told, nominal: Mapping[tuple[str, str], Told], conditions: Told) -> Iterator[str]:
    """Where a condition costs much success, or refuses the policy."""
    words, before = conditions[row["condition"]]["words"], nominal.get((row["link"], row["scenes"]))
    if row["refused"]:
        yield f"{words}: {escape_unprintable(row['refused'])}"
    elif before and row["success_rate"] < WEAK * before["success_rate"]:
        yield (
            f"{LINK_NAMES[row['link']]}, {words}: {row['success_rate']:.1%} success instead of "
            f"{before['success_rate']:.1%}"
        )


def _beaten(row: Told, rows: Sequence[Told]) -> Iterator[str]:
    """Which baseline is as good or better, by each figure."""
    place = [row[name] for name in _PLACE]
    others = [
        each
        for each in rows
        if each["kind"] == BASELINE
        and not each["refused"]
        and [each[name] for name in _PLACE] == place
    ]
    for figure, what in (("success_rate", "success"), ("score_iqm", "score")):
        first = max(others, key=lambda each: each[figure], default=None)
        if first is not None and first[figure] >= row[figure]:
            where = f"{LINK_NAMES[row['link']]}, {row['scenes']} scenes"
            yield f"{where}: {first['agent']} has no lower {what}"


_PLACE = ("id", "scenes", "link", "condition")
