"""A submission: the row of anybody's policy, which others can check.

`acsar-gym benchmark --policy mine.onnx` writes `mine.row.json`: the JSON of its benchmark and
`sha256`, the hash of all the rest. `check` compares that hash, the hashes of the scenes with those
of this package, and the figures with those computed anew from the episodes. It can't know whether
the episodes were really driven: whoever doubts it runs the policy, whose hash is in the row.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import acsar_gym
from acsar_gym.benchmark import result
from acsar_gym.benchmark.figures import summary
from acsar_gym.benchmark.scenes import SCENES, TEST
from acsar_gym.benchmark.store import MOST_BYTES, SCHEMA, episodes
from acsar_gym.errors import ConfigError
from acsar_gym.reading import bounded

SUFFIX = ".row.json"
CLOSE = 1e-6
"""Largest relative difference of a figure that is computed anew from rounded episodes."""


def write(told: Mapping[str, Any], name: str, folder: Path) -> Path:
    """Sign and write a row.

    Args:
        told: result of a benchmark of one policy.
        name: of the agent.
        folder: to write to.

    Returns:
        The file.
    """
    path = folder / f"{name}{SUFFIX}"
    result.write(path, {**told, "sha256": signature(told)})
    return path


def signature(told: Mapping[str, Any]) -> str:
    """Hash a row without its own hash."""
    rest = {key: value for key, value in told.items() if key != "sha256"}
    text = json.dumps(rest, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def check(path: Path) -> str:
    """Check a row.

    Args:
        path: of its file.

    Returns:
        What was checked, in one line.

    Raises:
        ConfigError: it isn't a row, or says something that isn't so; names what.
    """
    data = bounded.read(path, MOST_BYTES)
    try:
        told = json.loads(data)
        if told["schema"] != SCHEMA:
            raise ConfigError(f"{path}: a row of another version of the benchmark")
        if told["sha256"] != signature(told):
            raise ConfigError(f"{path}: was changed after it was written: its hash is another one")
        _check_scenes(path, told["header"])
        count = sum(_check_cell(path, cell) for cell in told["cells"])
        version = told["header"]["versions"]["acsar_gym"]
        names = [
            f"{name} (sha256 {str(each['policies'][0]['sha256'])[:16]})"
            for name, each in told["header"]["agents"].items()
        ]
    except (ValueError, TypeError, LookupError, AttributeError):
        raise ConfigError(f"{path}: isn't a row of 'acsar-gym benchmark --policy'") from None
    note = "" if version == acsar_gym.__version__ else f" (this is {acsar_gym.__version__})"
    return (
        f"{path}: sound: {', '.join(names)}, {count} episodes, acsar_gym {version}{note}, scenes "
        "of this version, figures as computed from the episodes"
    )


def _check_scenes(path: Path, header: Mapping[str, Any]) -> None:
    """Compare the hashes of the scenes; published worlds have none here."""
    for env_id, sets in header["scenes"].items():
        about = sets[TEST]
        if env_id not in SCENES or about["sha256"] != SCENES[env_id].test.sha256:
            raise ConfigError(f"{path}: {env_id}: scene set of another version")


def _check_cell(path: Path, cell: Mapping[str, Any]) -> int:
    """Compute the figures of a cell anew; returns how many episodes it has."""
    if cell["refused"]:
        return 0
    own = summary(episodes(cell["episodes"]))
    for name, value in cell["summary"].items():
        if not _alike(value, own.get(name)):
            raise ConfigError(
                f"{path}: {cell['id']}, {cell['link']}, {cell['condition']}: {name} = {value} "
                f"isn't that of its episodes, {own.get(name)}"
            )
    return int(own["episodes"])


def _alike(one: Any, other: Any) -> bool:
    """Whether two figures are equal, but for rounding."""
    if isinstance(one, list | tuple) and isinstance(other, list | tuple):
        return len(one) == len(other) and all(map(_alike, one, other))
    if isinstance(one, int | float) and isinstance(other, int | float):
        return math.isclose(one, other, rel_tol=CLOSE, abs_tol=CLOSE)
    return one is None and other is None
