"""Whatever file, name or number a user gives ends in one error line, soon and in little memory."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, get_args

import gymnasium
import numpy as np
import pytest

from acsar_gym import RobotConfig
from acsar_gym.config import (
    BodyConfig,
    EncoderConfig,
    FirmwareConfig,
    Geofence,
    LidarConfig,
    MotorConfig,
    SpeedLimits,
)
from acsar_gym.errors import ConfigError, escape_unprintable
from acsar_gym.tools import demo
from acsar_gym.tools.cli import main
from acsar_gym.worlds import generators

Call = Callable[..., tuple[int, str, str]]
SECTIONS = (MotorConfig, EncoderConfig, FirmwareConfig, BodyConfig, SpeedLimits, LidarConfig)


MERGES = "a0: &a0 {x: 1}\n" + "".join(
    f"a{i}: &a{i} {{<<: [*a{i - 1}, *a{i - 1}], k{i}: 1}}\n" for i in range(1, 25)
)
DIGITS = "9" * 400
ROBOTS = {
    "merges.yaml": (MERGES, "has an alias"),
    "merge.yaml": ("motor: {<<: {max_speed: 1}}", "a key must be text"),
    "digits.yaml": (
        f"encoder: {{counts_per_revolution: {DIGITS}}}",
        "counts_per_revolution = 9999",
    ),
    "sixty.yaml": ("wheel_radius: 1" + ":1" * 4_000, "wheel_radius = a very long number"),
    "keys.yaml": (f"{{{', '.join(f'{i}: 1' for i in range(9))}}}", "a key must be text"),
    "text.yaml": (f"odom_frame: {'x' * 20_000}", "which is too long"),
    "many.yaml": ("[" + "[]," * 200_000 + "]", "too many values"),
    "loop.yaml": ("firmware: {loop_rate: 1e8}", "firmware.loop_rate = 100000000.0: must be less"),
    "window.yaml": ("{firmware: {loop_rate: 2000}, encoder: {window: 5}}", "2,000 periods"),
    "slow.yaml": ("{control_rate: 1e-3, firmware: {feedback_rate: 9}}", "at least 0.01 Hz"),
    "unknown.yaml": ("\n".join(f"k{i}: 1" for i in range(5_000)), "unknown field 'k0'"),
    "params.urdf": (
        f"<r><ros2_control><hardware>{'<param/>' * 2_000}</hardware></ros2_control></r>",
        "2,000 params",
    ),
}
WORLD = '{{"name": {}, "start": {{"x": 0, "y": 0}}, "goal": {{"x": 4, "y": 0}}}}'


def assert_one_line(code: int, error: str, found: str) -> None:
    assert code == 2, error
    assert error.startswith("acsar-gym: ")
    assert error.count("\n") == 1
    assert found in error


@pytest.fixture
def call(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Call:
    def run(*arguments: str | Path) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["acsar-gym", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            main()
        assert isinstance(ended.value.code, int)
        return ended.value.code, *capsys.readouterr()

    return run


@pytest.mark.parametrize("name", ROBOTS)
def test_hostile_robots_are_one_line(name: str, tmp_path: Path, call: Call) -> None:
    text, found = ROBOTS[name]
    path = tmp_path / name
    path.write_text(text)
    code, _, error = call("run", "1", "0", "--link", "planar", "--robot", path)
    assert_one_line(code, error, found)


@pytest.mark.parametrize("option", ["--robot", "--worlds", "--link"])
def test_pipes_and_devices_are_not_read(option: str, tmp_path: Path, call: Call) -> None:
    suffix = {"--robot": ".yaml", "--worlds": ".json", "--link": ".mcap"}[option]
    replay = "replay:" if option == "--link" else ""
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", Path("/dev/zero")):
        named = tmp_path / f"name{suffix}"
        named.unlink(missing_ok=True)
        named.symlink_to(path)
        policy = "obstacle_goal" if option == "--worlds" else "point_goal"
        link = () if option == "--link" else ("--link", "planar")
        arguments = ("evaluate", "--policy", policy, *link, option, f"{replay}{named}")
        code, _, error = call(*arguments)
        assert_one_line(code, error, f"{named}: isn't a regular file")


@pytest.mark.parametrize(
    ("arguments", "found"),
    [
        (("show", "clutter:1000000"), "1,000,000 worlds are too many, at most 100"),
        (("show", "clutter:100", "--size", "4096"), "at most 2"),
        (("check", "clutter:1000000"), "1,000,000 worlds are too many, at most 10,000"),
        (("convert", "clutter:1000000", "x.json"), "holds 1,000,000 worlds"),
        (("check", f"clutter:{'9' * 5000}"), "can't be read: File name too long"),
        (("check", f"clutter:{'9' * 30}-{'9' * 30}"), "must be like 'clutter:test'"),
        (("show", "clutter:1", "--out", "/missing/x.png"), "can't be written"),
    ],
    ids=lambda value: " ".join(value)[:40] if isinstance(value, tuple) else "",
)
def test_too_much_is_told_before_anything_is_made(
    arguments: tuple[str, ...], found: str, call: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(generators, "generate_world", None)
    code, _, error = call("worlds", *arguments)
    assert_one_line(code, error, found)


@pytest.mark.parametrize("option", ["--steps", "--episodes", "--serial-episodes"])
def test_a_demo_checks_its_counts_first(
    option: str, call: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(demo, "run_demo", None)
    for count in ("-1", "0", "9" * 400):
        code, _, error = call("demo", option, count)
        assert_one_line(code, error, f"demo.{option.strip('-').replace('-', '_')} = ")


@pytest.mark.parametrize("name", ["\x1b]0;title\x07\x9b31m\r", "a\u202eb"])
def test_no_control_character_of_a_name_reaches_the_terminal(
    name: str, tmp_path: Path, call: Call
) -> None:
    path = tmp_path / "world.json"
    path.write_text(WORLD.format(json.dumps(name)))
    code, out, _ = call("worlds", "check", path)
    assert code == 0
    assert escape_unprintable(name) in out
    assert all(c.isprintable() or c == "\n" for c in out)
    _, _, error = call("run", "1", "0", "--link", f"\x1b[31m{name}")
    assert error.startswith("acsar-gym: unknown link '\\x1b[31m")
    assert all(c.isprintable() or c == "\n" for c in error)


def test_a_terminal_without_unicode_gets_what_it_can_show(tmp_path: Path) -> None:
    path = tmp_path / "world.json"
    path.write_text(WORLD.format('"\\u4e16"'))
    ascii_only = {**os.environ, "PYTHONIOENCODING": "ascii"}
    command = [sys.executable, "-m", "acsar_gym", "worlds", "check", str(path)]
    done = subprocess.run(command, env=ascii_only, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert "\\u4e16" in done.stdout


def test_a_name_that_is_no_text_is_one_line(tmp_path: Path, call: Call) -> None:
    path = tmp_path / "world.json"
    path.write_text(WORLD.format('"\\ud800"'))
    code, _, error = call("worlds", "check", path)
    assert_one_line(code, error, "name")
    assert error.isascii()


HUNGRY = """
import json, re, sys
from pathlib import Path
from acsar_gym import RobotConfig
from acsar_gym.tools import atlas
from acsar_gym.errors import AcsarError
from acsar_gym.worlds import World, files
folder = Path(sys.argv[1])

def most_memory():  # getrusage would count what the parent had before it became this program
    return int(re.search(r"VmHWM:\\s+(\\d+) kB", Path("/proc/self/status").read_text())[1])

for path in folder.iterdir():
    try:
        if path.suffix == ".json":
            worlds = atlas.collect_worlds(str(path), None, None, 1)
            found = atlas.check_worlds(worlds, None)[0].shortest
        else:
            found = str(RobotConfig.load(path))
    except AcsarError as error:
        found = str(error)
    print(json.dumps([path.name, found, most_memory() / 1024.0]))
"""


def test_hostile_files_take_less_than_half_a_gigabyte(tmp_path: Path) -> None:
    for suffix in ("yaml", "urdf"):
        (tmp_path / f"endless.{suffix}").symlink_to("/dev/zero")
        (tmp_path / f"sparse.{suffix}").touch()
        os.truncate(tmp_path / f"sparse.{suffix}", 10**11)
    ends = {"start": {"x": 0, "y": 0}, "goal": {"x": 4, "y": 0}}
    far = {**ends, "circles": [[2, 0, 0.3], [9000, 9000, 1], [-9000, -9000, 1]]}
    (tmp_path / "far.json").write_text(json.dumps(far))
    command = [sys.executable, "-c", HUNGRY, str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    found = {name: (value, peak) for name, value, peak in map(json.loads, done.stdout.splitlines())}
    assert len(found) == 5, done.stdout
    assert max(peak for _, peak in found.values()) < 500.0
    assert found["far.json"][0] == pytest.approx(4.15, abs=0.05)
    assert "isn't a regular file" in found["endless.yaml"][0]


@pytest.mark.parametrize("model", [RobotConfig, *SECTIONS], ids=lambda model: model.__name__)
def test_every_number_of_a_config_has_an_upper_bound(model: Any) -> None:
    for name, field in model.model_fields.items():
        kinds = {int, float} & {field.annotation, *get_args(field.annotation)}
        if not kinds or model is Geofence or name in ("baud_rate", "watchdog_timeout"):
            continue
        for value in (1e30, 10**400):
            with pytest.raises(ConfigError, match=f"{name} = ") as caught:
                model(**{name: value if float in kinds or value > 1e30 else 10**30})
            assert len(str(caught.value)) < 200


@pytest.mark.parametrize("rate", [10**400, 1e-9, 0, -1, math.nan, "10", [10], np.zeros(2), None])
def test_a_policy_rate_is_a_sensible_number(rate: Any) -> None:
    for name in ("PointGoal-v0", "Barn-v1"):
        with pytest.raises(ConfigError, match="policy_rate = ") as caught:
            gymnasium.make(f"acsar_gym/{name}", link="planar", policy_rate=rate)
        assert len(str(caught.value)) < 200


@pytest.mark.parametrize(
    "arguments",
    [
        {"goal_distance": (10**400, 1)},
        {"goal_tolerance": 10**400},
        {"view": np.zeros(2)},
        {"on_fault": np.zeros(2)},
        {"link": np.zeros((2, 2, 2))},
        {"robot": 10**5000},
        {"faults": {"direction": np.zeros(2)}},
    ],
    ids=lambda arguments: next(iter(arguments)),
)
def test_arguments_of_any_kind_are_one_error(arguments: dict[str, Any]) -> None:
    with pytest.raises(ConfigError) as caught:
        gymnasium.make("acsar_gym/PointGoal-v0", **{"link": "planar", **arguments})
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 300
