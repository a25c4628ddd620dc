"""The folder of a benchmark: finished cells are kept."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
from benchmark_tools import cell, driven, episode
from disk_tools import full_disk

from acsar_gym.errors import ConfigError
from acsar_gym.tools.benchmark.cells import (
    CELLS_FOLDER,
    CellResult,
    Store,
    episode_columns,
    read_episodes,
)

ROOM = 3_000


def test_what_is_added_is_read_again(tmp_path: Path) -> None:
    store = Store(tmp_path)
    assert store.find("a") is None
    refused = CellResult(cell("dwa"), refused="dwa: needs a LiDAR")
    results = {"a": driven(), "b": driven(cell(seed=1)), "c": refused}
    added = {key: store.add(key, result) for key, result in results.items()}
    assert repr(added) == repr(results)
    assert repr({key: Store(tmp_path).find(key) for key in results}) == repr(results)


def test_columns_hold_episodes_with_nothing_that_json_has_not() -> None:
    some = [episode(0, told={"laps": 1.0}), episode(1, 0.0, fault="lost", told={"laps": math.nan})]
    columns = json.loads(json.dumps(episode_columns(some), allow_nan=False))
    assert columns["clearance"] == [None, None]
    assert columns["told"] == {"laps": [1.0, None]}
    assert columns["spl"] == [1.4 / 1.5, 0.0]
    assert repr(read_episodes(columns)) == repr(some)


@pytest.mark.parametrize("content", ["no JSON", "[]", '{"agent": "dwa", "seconds": 0}'])
def test_a_foreign_file_is_refused(tmp_path: Path, content: str) -> None:
    store = Store(tmp_path)
    store.add("a", driven())
    (file,) = (tmp_path / CELLS_FOLDER).iterdir()
    file.write_text(content)
    with pytest.raises(ConfigError, match=file.name):
        store.find("a")


def test_a_full_disk_loses_nothing_that_was_finished(tmp_path: Path) -> None:
    store = Store(tmp_path)
    store.add("a", driven())
    with full_disk(ROOM), pytest.raises(ConfigError, match=CELLS_FOLDER) as caught:
        store.add("b", driven(scores=[0.9] * 1000))
    assert "\n" not in str(caught.value)
    assert (store.find("a") is None, store.find("b") is None) == (False, True)
