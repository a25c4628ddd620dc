"""The folder of a benchmark: what is kept, and what an end in mid-run costs."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from benchmark_tools import cell, episode, part, plan
from disk_tools import full_disk

from acsar_gym.errors import ConfigError
from acsar_gym.tools.benchmark.store import (
    RESULTS_FILE,
    Part,
    Store,
    episode_columns,
    episode_records,
)

ROOM = 3_000


def test_what_is_added_is_read_again(tmp_path: Path) -> None:
    store = Store(tmp_path)
    assert store.open(plan()) == []
    told = [part(), part(first=2), Part(cell("dwa"), 0, refused="dwa: needs a LiDAR")]
    added = [store.add(each) for each in told]
    assert repr(Store(tmp_path).open(plan())) == repr(added) == repr(told)


def test_columns_hold_episodes_with_nothing_that_json_has_not() -> None:
    some = [episode(0), episode(1, 0.0, fault="link lost", collision=True)]
    table = json.loads(json.dumps(episode_columns(some), allow_nan=False))
    assert table["clearance"] == [None, None]
    assert repr(episode_records(table)) == repr(some)


def test_a_line_that_was_cut_is_dropped(tmp_path: Path) -> None:
    store = Store(tmp_path)
    store.open(plan())
    store.add(part())
    whole = store.file.read_bytes()
    store.file.write_bytes(whole + whole[: len(whole) // 2])
    assert len(Store(tmp_path).open(plan())) == 1
    assert store.file.read_bytes() == whole
    store.add(part(first=2))
    assert [each.first for each in Store(tmp_path).open(plan())] == [0, 2]


@pytest.mark.parametrize("line", ["no JSON", "[]", '{"cell": {}, "first": 0}'])
def test_a_foreign_file_is_refused(tmp_path: Path, line: str) -> None:
    store = Store(tmp_path)
    store.open(plan())
    store.file.write_text(f"{line}\n")
    with pytest.raises(ConfigError, match="line 1"):
        store.open(plan())


def test_results_without_a_plan_are_refused(tmp_path: Path) -> None:
    (tmp_path / RESULTS_FILE).write_text("")
    with pytest.raises(ConfigError, match=r"plan\.json"):
        Store(tmp_path).open(plan())


def test_a_full_disk_loses_nothing_that_was_finished(tmp_path: Path) -> None:
    store = Store(tmp_path)
    store.open(plan())
    store.add(part())
    with full_disk(ROOM), pytest.raises(ConfigError, match=RESULTS_FILE) as caught:
        for first in range(2, 100, 2):
            store.add(part(first=first))
    assert "\n" not in str(caught.value)
    kept = Store(tmp_path).open(plan())
    assert 1 <= len(kept) < 10
    assert store.file.read_bytes().endswith(b"\n")
