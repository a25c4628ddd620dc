"""The project's own world files: exact round trips, folders, and files that mean harm."""

from __future__ import annotations

import json
import math
import os
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from acsar_gym.errors import ConfigError, WorldError
from acsar_gym.worlds import files
from acsar_gym.worlds.world import MAX_COORDINATE, Region, World

GOOD: dict[str, Any] = {
    "name": "three pillars",
    "circles": [[2.0, 0.3, 0.1], [3, -0.4, 0.1]],
    "segments": [[0.0, 1.0, 4.0, 1.0]],
    "start": {"x": 0.0, "y": 0.0, "theta": 0.5, "radius": 0.1},
    "goal": {"x": 4.0, "y": 0.0, "radius": 0.25},
    "path": [[0.0, 0.0], [4.0, 0.0]],
}
ENDS = "start: {x: 0.0, y: 0.0}\ngoal: {x: 1.0, y: 0.0}\n"
SUFFIXES = (".json", ".yaml", ".yml")

coordinates = st.floats(-MAX_COORDINATE, MAX_COORDINATE)
texts = st.text(st.characters(codec="utf-8"), max_size=20)


def rows(width: int) -> st.SearchStrategy[Any]:
    shape = st.tuples(st.integers(0, 4), st.just(width))
    return shape.flatmap(lambda rows: arrays(np.float64, rows, elements=coordinates))


def regions(theta: st.SearchStrategy[float | None]) -> st.SearchStrategy[Region]:
    return st.builds(Region, coordinates, coordinates, st.floats(0.0, MAX_COORDINATE), theta)


@st.composite
def worlds(draw: st.DrawFn) -> World:
    circles = draw(rows(3))
    circles[:, 2] = np.abs(circles[:, 2])
    start = draw(regions(st.none() | coordinates))
    goal = draw(regions(st.none()))
    return World(circles, draw(rows(4)), start, goal, draw(st.none() | rows(2)), draw(texts))


def same(one: World, other: World) -> bool:
    """Whether two worlds are the same, bit for bit."""
    shapes = [(world.circles.shape, world.segments.shape) for world in (one, other)]
    numbers = [world.circles.tobytes() + world.segments.tobytes() for world in (one, other)]
    paths = [None if world.path is None else world.path.tobytes() for world in (one, other)]
    regions = [repr((world.start, world.goal, world.name)) for world in (one, other)]
    return all(first == second for first, second in (shapes, numbers, paths, regions))


def refused(path: Path, text: str | bytes) -> str:
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    with pytest.raises(WorldError) as caught:
        files.load_world(path)
    message = str(caught.value)
    assert isinstance(caught.value, ConfigError)
    assert message.startswith(f"{path}: ")
    assert "\n" not in message
    assert len(message) < 400 + len(str(path))
    return message


@given(world=worlds(), suffix=st.sampled_from(SUFFIXES))
def test_what_is_saved_is_loaded_bit_for_bit(
    world: World, suffix: str, tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.getbasetemp() / f"round{suffix}"
    files.save_world(world, path)
    assert same(files.load_world(path), world)


def test_a_full_world_is_saved_and_loaded_in_seconds(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    circles, segments = rng.uniform(0, 9, (10_000, 3)), rng.uniform(-9, 9, (10_000, 4))
    world = World(circles, segments, path=rng.uniform(-9, 9, (20_000, 2)))
    for suffix in SUFFIXES[:2]:
        begin = time.process_time()
        files.save_world(world, tmp_path / f"full{suffix}")
        assert same(files.load_world(tmp_path / f"full{suffix}"), world)
        assert time.process_time() - begin < 20.0


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_json_is_yaml_too(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"pillars{suffix}"
    path.write_text(json.dumps(GOOD), encoding="utf-8")
    world = files.load_world(path)
    assert world.name == "three pillars"
    assert world.circles.tolist() == [[2.0, 0.3, 0.1], [3.0, -0.4, 0.1]]
    assert world.segments.tolist() == [[0.0, 1.0, 4.0, 1.0]]
    assert (world.start, world.goal) == (Region(0.0, 0.0, 0.1, 0.5), Region(4.0, 0.0, 0.25))
    assert world.length == 4.0


def test_what_may_be_left_out(tmp_path: Path) -> None:
    path = tmp_path / "Empty.YAML"
    path.write_text(f"\ufeff{ENDS}path: null\n", encoding="utf-8")
    world = files.load_world(path)
    assert (world.obstacles, world.path, world.name) == (0, None, "Empty")
    assert (world.start, world.goal) == (Region(0.0, 0.0), Region(1.0, 0.0))


def test_numbers_of_json_are_numbers_in_yaml(tmp_path: Path) -> None:
    path = tmp_path / "world.yaml"
    path.write_text(ENDS + "circles: [[1e-3, -2E+1, +.5e1], [1, .5, 1.]]", encoding="utf-8")
    assert files.load_world(path).circles.tolist() == [[0.001, -20.0, 5.0], [1.0, 0.5, 1.0]]


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"cirles": []}, "unknown key 'cirles'; did you mean 'circles'?"),
        ({"xyzzy": 1}, "unknown key 'xyzzy'; known: circles, goal, name, path, segments, start"),
        ({"start": None}, "has no start: add a line like 'start: {x: 0.0, y: 0.0}'"),
        ({"goal": None}, "has no goal: add a line like"),
        ({"start": [0, 0]}, "start: must be a mapping with x, y, theta, radius"),
        ({"start": {"x": 0}}, "start: y must be a number, is None"),
        ({"start": {"x": "0", "y": 0}}, "start: x must be a number, is '0'"),
        ({"start": {"x": True, "y": 0}}, "start: x must be a number, is True"),
        ({"start": {"x": 1e5, "y": 0}}, "start: x must be a number"),
        ({"start": {"x": 10**99, "y": 0}}, "start: x must be a number"),
        ({"start": {"x": 10**400, "y": 0}}, "start: x must be a number, is 1000"),
        ({"start": {"x": 0, "y": 0, "radius": -1}}, "region (0, 0, -1, 0.0): "),
        ({"start": {"x": 0, "y": 0, "thet": 1}}, "start: unknown key 'thet'; did you mean 'theta'"),
        ({"goal": {"x": 0, "y": 0, "theta": 1}}, "goal: unknown key 'theta'"),
        ({"circles": [[1, 2]]}, "circles: row 0 must be 3 finite numbers"),
        ({"circles": [[1, 2, 3], [1, 2, "3"]]}, "circles: row 1 must be 3 finite numbers"),
        ({"circles": [[1, 2, None]]}, "circles: row 0 must be"),
        ({"circles": [[1, 2, False]]}, "circles: row 0 must be"),
        ({"circles": [[1, 2, 1e5]]}, "circles: row 0 must be"),
        ({"circles": [[1, 2, 10**99]]}, "circles: row 0 must be"),
        ({"circles": [[1, 2, -3]]}, "circles: a radius must not be negative"),
        ({"circles": {"x": 1}}, "circles: must be a list"),
        ({"circles": "[[1, 2, 3]]"}, "circles: must be a list"),
        ({"circles": [[0, 0, 0]] * 20_001}, "circles: must be a list of at most 20,000 rows"),
        ({"segments": [1, 2, 3, 4]}, "segments: row 0 must be 4 finite numbers"),
        ({"segments": [[[1], 2, 3, 4]]}, "segments: row 0 must be"),
        ({"path": [[1]]}, "path: row 0 must be 2 finite numbers"),
        ({"name": 7}, "name: must be text of 1000 characters at most, is 7"),
        ({"name": "x" * 1001}, "name: must be text of 1000 characters at most"),
    ],
)
def test_bad_fields_are_refused(
    suffix: str, changes: dict[str, Any], message: str, tmp_path: Path
) -> None:
    path = tmp_path / f"bad{suffix}"
    assert message in refused(path, json.dumps({**GOOD, **changes}))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "not valid JSON"),
        ("{", "not valid JSON"),
        ("[1, 2]", "must be a mapping with name"),
        ("null", "must be a mapping"),
        ('{"circles": [[NaN, 0, 1]]}', "not valid JSON: NaN is no number"),
        ('{"circles": [[0, 0, -Infinity]]}', "not valid JSON: -Infinity is no number"),
        ('{"circles": [[0, 0, 1e999]]}', "1e999 is no number"),
        (json.dumps(GOOD).replace("0.3", "1e999"), "1e999 is no number"),
        ("[" * 100_000, "not valid JSON"),
        ("9" * 10_000, "not valid JSON"),
        (b"\xff\xfe{}", "isn't UTF-8"),
    ],
)
def test_bad_json_is_refused(text: str | bytes, message: str, tmp_path: Path) -> None:
    assert message in refused(tmp_path / "bad.json", text)


LAUGHS = "a0: &a0 [ha]\n" + "".join(
    f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]\n" for i in range(1, 10)
)
MERGED_LAUGHS = "a0: &a0 {x: 1}\n" + "".join(
    f"a{i}: &a{i}\n  <<: [{', '.join([f'*a{i - 1}'] * 10)}]\n" for i in range(1, 10)
)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "must be a mapping"),
        ("- 1\n- 2", "must be a mapping"),
        ("a: [", "not valid YAML"),
        ("a: b: c", "not valid YAML"),
        (ENDS + "circles: [[.nan, 0, 1]]", "row 0 must be 3 finite"),
        (ENDS + "circles: [[0, 0, .inf]]", "row 0 must be 3 finite"),
        (ENDS + "circles: [[0, 0, 2020-01-01]]", "row 0 must be 3 finite"),
        (ENDS + "circles: [[0, 0, 2020-99-99]]", "not valid YAML"),
        (ENDS + "circles: !!python/object/apply:os.system ['true']", "not valid YAML"),
        (ENDS + "circles: !!int ''", "not valid YAML"),
        (ENDS + "? [1, 2]\n: 3", "not valid YAML"),
        (ENDS + "7: 8", "line 3: a key must be text"),
        (ENDS + "<<: {a: 1}", "line 3: a key must be text, in quotes if need be (<< is ref"),
        (f"start: {{x: 0x{'f' * 5000}, y: 0}}", "start: x must be a number, is a very long number"),
        (f"start: {{x: 1{':1' * 4000}, y: 0}}", "start: x must be a number, is a very long number"),
        (ENDS + "a: 1" + ":1" * 5000, "line 3: a text of 10,001 characters"),
        (ENDS + f"a: {'x' * 10_001}", "a text of 10,001 characters"),
        (LAUGHS + ENDS, "has an alias"),
        (MERGED_LAUGHS + ENDS, "has an alias"),
        ("a: &a [*a]", "has an alias"),
        (ENDS + "a: " + "[" * 500 + "]" * 500, "nested too deeply"),
        ("[" * 5_000_000, "nested too deeply"),
        ("{" * 5_000_000, "nested too deeply"),
        ("- " * 2_000_000, "nested too deeply"),
        ("[" + "[]," * 1_000_000 + "]", "too many values"),
        (ENDS + f"!<{'x' * 1000}> a: 1", "not valid YAML"),
        (b"\xff\xfe{}", "isn't UTF-8"),
        ("a: \x00", "not valid YAML"),
    ],
)
def test_bad_yaml_is_refused_at_once(text: str | bytes, message: str, tmp_path: Path) -> None:
    begin = time.process_time()
    assert message in refused(tmp_path / "bad.yaml", text)
    assert time.process_time() - begin < 10.0


@given(data=st.binary(max_size=60), suffix=st.sampled_from([*SUFFIXES, ".world"]))
def test_any_garbage_is_one_world_error(
    data: bytes, suffix: str, tmp_path_factory: pytest.TempPathFactory
) -> None:
    refused(tmp_path_factory.getbasetemp() / f"garbage{suffix}", data)


def test_too_large_a_text_is_refused(tmp_path: Path) -> None:
    assert "larger than 5 MB" in refused(tmp_path / "large.json", b" " * (files.MAX_TEXT_BYTES + 1))


@pytest.mark.parametrize("name", ["none.world", "none.json", "none.yaml", "a\0b.json"])
def test_missing_files_are_refused(name: str, tmp_path: Path) -> None:
    with pytest.raises(WorldError, match=r"there is no such file|null byte"):
        files.load_world(tmp_path / name)


def test_only_regular_files_are_read(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.json")  # would wait for a writer for ever
    (tmp_path / "folder.json").mkdir()
    for name in ("pipe.json", "folder.json"):
        with pytest.raises(WorldError, match="isn't a regular file"):
            files.load_world(tmp_path / name)


@pytest.mark.parametrize("name", ["world.txt", "world", "world.npy", "world.xacro"])
def test_other_suffixes_are_refused(name: str, tmp_path: Path) -> None:
    with pytest.raises(WorldError, match=r"read from \.world, \.sdf, \.yaml, \.yml, \.json"):
        files.load_world(tmp_path / name)
    with pytest.raises(WorldError, match=r"saved as \.json, \.yaml or \.yml"):
        files.save_world(World(), tmp_path / name)


def test_where_nothing_can_be_written(tmp_path: Path) -> None:
    with pytest.raises(WorldError, match="can't be written: No such file"):
        files.save_world(World(), tmp_path / "nowhere" / "world.json")
    with pytest.raises(WorldError, match="can't be written"):
        files.save_world(World(name="\ud800"), tmp_path / "world.yaml")


def test_a_folder_is_read_in_natural_order(tmp_path: Path) -> None:
    for name in (
        "world_10.json",
        "world_2.yaml",
        "world_1.yml",
        "b.json",
        "2.json",
        "world_02.yml",
    ):
        files.save_world(World(), tmp_path / name)
    for name in ("README.md", "path_2.npy", ".hidden.json", "map.pgm"):
        (tmp_path / name).write_text("no world", encoding="utf-8")
    (tmp_path / "10.world").write_text("<sdf/>", encoding="utf-8")
    names = [path.name for path in sorted(tmp_path.glob("*[lnd]"), key=files._natural)]
    assert names[:2] == ["2.json", "10.world"]
    assert len(files.load_folder(tmp_path)) == 7
    for number in (1, 2, 10):
        files.save_world(World(name=f"w{number}"), tmp_path / f"world_{number}.json")
    read = [world.name for world in files.load_folder(tmp_path) if world.name.startswith("w")]
    assert read == ["w1", "w2", "w10"]


def test_a_bad_file_in_a_folder_is_named(tmp_path: Path) -> None:
    (tmp_path / "bad.json").write_text("{", encoding="utf-8")
    with pytest.raises(WorldError, match=r"bad\.json: not valid JSON"):
        files.load_folder(tmp_path)


def test_a_folder_of_too_much_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in "abc":
        files.save_world(World(np.ones((2, 3))), tmp_path / f"{name}.json")
    monkeypatch.setattr(files, "MAX_FOLDER_OBSTACLES", 5)
    with pytest.raises(WorldError, match="holds more than 5 obstacles"):
        files.load_folder(tmp_path)
    monkeypatch.setattr(files, "MAX_WORLD_FILES", 2)
    with pytest.raises(WorldError, match="holds 3 worlds, at most 2 are read"):
        files.load_folder(tmp_path)


def test_folders_without_worlds_are_refused(tmp_path: Path) -> None:
    with pytest.raises(WorldError, match="holds no worlds"):
        files.load_folder(tmp_path)
    with pytest.raises(WorldError, match="there is no such folder"):
        files.load_folder(tmp_path / "nowhere")
    (tmp_path / "file.json").write_text("{}", encoding="utf-8")
    with pytest.raises(WorldError, match="there is no such folder"):
        files.load_folder(tmp_path / "file.json")


def test_theta_may_be_missing_or_null(tmp_path: Path) -> None:
    path = tmp_path / "world.json"
    for theta, expected in ((None, None), (math.pi, math.pi)):
        start = {"x": 0, "y": 0, "theta": theta}
        path.write_text(json.dumps({**GOOD, "start": start}), encoding="utf-8")
        assert files.load_world(path).start.theta == expected
