"""Files, JSON, YAML and names of objects: one error line each, and files that are written whole."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from disk_tools import full_disk

from acsar_gym import RobotConfig, reading
from acsar_gym.errors import ConfigError, PolicyError


def test_read_file_reads_up_to_the_limit(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"12345")
    assert reading.read_file(path, 5) == b"12345"
    with reading.open_file(path) as file:
        assert file.read(2) == b"12"
    with pytest.raises(PolicyError, match=r"file: is larger than 4 bytes"):
        reading.read_file(path, 4, PolicyError)

    os.truncate(path, 10**12)
    with pytest.raises(ConfigError, match="is larger than 8 MB"):
        reading.read_file(path, 8_000_000)


def test_read_file_refuses_what_is_not_a_regular_file(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    link = tmp_path / "link"
    link.symlink_to("/dev/zero")
    for path in (pipe, link, tmp_path, Path("/dev/tty")):
        with pytest.raises(ConfigError, match=f"^{path}: isn't a regular file$"):
            reading.read_file(path, 100)


def test_write_atomically_refuses_a_pipe_that_no_process_reads(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    with pytest.raises(ConfigError, match=f"^{pipe}: can't be written: "):
        reading.write_atomically(pipe, b"data")

    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    reading.write_atomically(pipe, b"data")
    assert os.read(reader, 100) == b"data"
    os.close(reader)


def test_write_atomically_leaves_the_old_file_on_a_full_disk(tmp_path: Path) -> None:
    path = tmp_path / "robot.yaml"
    old = b"max_linear: 0.4\n"  # a robot's file is changed in place, so it must be valid
    path.write_bytes(old)
    robot = RobotConfig.preset("jackal")
    with full_disk(50), pytest.raises(ConfigError, match="can't be written: File too large"):
        robot.save(path)
    assert [file.read_bytes() for file in tmp_path.iterdir()] == [old]

    robot.save(path)
    assert len(path.read_bytes()) > 50
    assert list(tmp_path.iterdir()) == [path]


def test_write_atomically_keeps_permissions_and_links(tmp_path: Path) -> None:
    path = tmp_path / "robot.yaml"
    path.write_bytes(b"old")
    path.chmod(0o640)
    link = tmp_path / "link.yaml"
    link.symlink_to(path)
    dangling = tmp_path / "dangling.yaml"
    dangling.symlink_to(tmp_path / "missing.yaml")

    reading.write_atomically(link, b"new")
    reading.write_atomically(dangling, b"new")
    assert link.is_symlink()
    assert (path.read_bytes(), path.stat().st_mode & 0o777) == (b"new", 0o640)
    assert (tmp_path / "missing.yaml").read_bytes() == b"new"


@pytest.mark.skipif(os.geteuid() == 0, reason="nothing is write-protected for root")
def test_write_atomically_respects_write_protection(tmp_path: Path) -> None:
    path = tmp_path / "robot.yaml"
    path.write_bytes(b"old")
    path.chmod(0o440)
    with pytest.raises(ConfigError, match="can't be written: Permission denied"):
        reading.write_atomically(path, b"new")
    assert path.read_bytes() == b"old"


def test_write_atomically_writes_to_standard_output(tmp_path: Path) -> None:
    code = "import pathlib; from acsar_gym import reading; "
    code += "reading.write_atomically(pathlib.Path('/dev/stdout'), b'whole')"
    with (tmp_path / "out").open("wb") as out:
        subprocess.run([sys.executable, "-c", code], stdout=out, check=True)
    assert (tmp_path / "out").read_bytes() == b"whole"


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("raising:X", "module raising can't be imported: ZeroDivisionError: division by zero"),
        ("nowhere:X", "No module named 'nowhere'"),
        ("math:X", "has no attribute 'X'"),
        ("a..b:c", "must be like 'module:Class'"),
    ],
)
def test_import_object_refuses_a_bad_name_in_one_line(
    name: str, reason: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "raising.py").write_text("1 / 0\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(ConfigError, match=reason) as caught:
        reading.import_object("sensor", name)
    assert str(caught.value).startswith(f"sensor = {name!r}: ")
    assert reading.import_object("task", "pathlib:Path.cwd") == Path.cwd


@pytest.mark.parametrize(
    "text",
    ["NaN", "[" * 100_000, "9" * 5_000, b"\xff"],
    ids=lambda text: str(text)[:20],
)
def test_parse_json_refuses_bad_text_in_one_line(text: str | bytes) -> None:
    with pytest.raises(ConfigError, match=r"^not valid JSON: ") as error:
        reading.parse_json(text)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("a: 1\nb: [", "line 3, column 1"),
        ("a: &x 1\nb: *x", "line 2: has an alias"),
        ("a: 1\n2: 3", "line 2: a key must be text"),
        ("[" * 30_000, "nested too deeply"),
        ("!!python/object/apply:os.abort []", "could not determine a constructor"),
    ],
    ids=lambda text: text[:20],
)
def test_parse_yaml_refuses_bad_text_with_its_place(text: str, reason: str) -> None:
    with pytest.raises(ConfigError) as error:
        reading.parse_yaml(text)
    assert reason in str(error.value)
    assert "\n" not in str(error.value)


def test_format_yaml_is_read_back() -> None:
    same = [1, 2]
    data = {"a": same, "b": same, "c": "1e-3", "d": 1e-5, "e": None, "f": {"g": True}}
    assert reading.parse_yaml(reading.format_yaml(data)) == data
    assert reading.parse_yaml("1e-3") == 0.001
