"""`acsar-gym calibrate` in this process, on simulated robots."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from cli_tools import Call, assert_one_line
from serial_tools import RobotFile, StartEmulator, cli

from acsar_gym import RobotConfig
from acsar_gym.tools.sysid.calibration_runs import write_runs
from acsar_gym.worlds import World
from acsar_gym.worlds.files import save_world

QUICK = ("--distance", "0.6", "--turns", "1", "--size", "0.4", "--repeats", "1")


@pytest.fixture
def twin(tmp_path: Path) -> Path:
    """A robot that turns as one with a longer wheelbase, and has larger wheels."""
    path = tmp_path / "twin.yaml"
    RobotConfig.preset("acsar").with_(wheel_radius=0.051, wheelbase=0.27).save(path)
    return path


def test_in_simulation_truth_measures_and_the_result_is_a_robot_file(
    call: Call, twin: Path, tmp_path: Path
) -> None:
    out, result = tmp_path / "my.yaml", tmp_path / "r.json"
    code, said, _ = call(
        "calibrate", "planar", "all", *QUICK, "--twin", twin, "--out", out, "--json", result
    )
    assert code == 0
    assert "wheel_separation_multiplier" in said
    found = RobotConfig.load(out)
    assert found.wheel_radius == pytest.approx(0.051, rel=2e-3)
    assert found.wheel_separation_multiplier == pytest.approx(1.81, rel=3e-3)
    assert found.body.turn_factor == found.wheel_separation_multiplier
    measured = found.measured["wheel_separation_multiplier"]
    assert measured.low <= found.wheel_separation_multiplier <= measured.high
    assert measured.method == "calibrate square straight turn"
    assert len(measured.logs[0]) == 16
    told = json.loads(result.read_text(encoding="utf-8"))
    assert told["not_told"] == []
    assert len(told["runs"]) == 5


def test_runs_are_kept_and_readings_given_later(call: Call, twin: Path, tmp_path: Path) -> None:
    runs, out = tmp_path / "cal.json", tmp_path / "my.yaml"
    drive = ("--twin", twin, "--runs", runs, *QUICK)
    assert call("calibrate", "planar", "turn", *drive, "--speeds", "1.2")[0] == 0
    code, said, _ = call("calibrate", "planar", "straight", *drive, "--measured", "0.61")
    assert code == 0
    assert "distance 0.610 m" in said
    assert "turn 1" in said
    code, said, _ = call("calibrate", runs, "straight", "--measured", "0.62", "--out", out)
    assert code == 0
    assert "distance 0.620 m" in said
    assert RobotConfig.load(out).wheel_radius == pytest.approx(0.0511, rel=0.02)


def test_a_recording_holds_runs_that_readings_can_be_given_to(call: Call, tmp_path: Path) -> None:
    path = tmp_path / "turns.mcap"
    drive = ("--turns", "0.5", "--speeds", "1.2", "--record", path)
    assert call("calibrate", "planar", "turn", *drive, "--measured-deg", "181")[0] == 0
    code, said, _ = call("calibrate", path, "turn", "--measured-deg", "175")
    assert code == 0
    assert "turn 1 of turns.mcap" in said
    assert "heading 175.0 deg" in said


def test_squares_take_their_corners_from_files(call: Call, twin: Path, tmp_path: Path) -> None:
    files = [tmp_path / name for name in ("cw.csv", "ccw.csv")]
    for path, side in zip(files, (-1.0, 1.0), strict=True):
        path.write_text(f"x,y\n-0.12,{0.245 * side}\n", encoding="utf-8")
    code, said, _ = call(
        "calibrate", "planar", "square", "--size", "0.4", "--twin", twin, "--corners", *files
    )
    assert code == 0
    assert "square cw 1" in said
    assert "square ccw 1" in said


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("planar", "straight", "--space", "1", "1"), "too small: this needs 2."),
        (("planar", "straight", "--measured", "2", "2", "--repeats", "3"), "2 readings for 3"),
        (("planar", "turn", "--speeds", "9"), "--speeds 9: must be more than 0, at most"),
        (("planar", "turn", "--radii", "2"), "--speeds times --radii"),
        (("planar", "straight", "--speed", "0"), "--speed 0: must be more than 0"),
        (("planar", "straight", "--tape", "0"), "--tape must be 0 to 1 m"),
        (("planar", "straight", "--aside", "0.1"), "--aside has 1 readings, --measured 0"),
        (("/dev/ttyUSB9", "straight", "--twin", "acsar"), "--twin is for simulated robots"),
        (("/dev/ttyUSB9", "straight", "--measured", "2"), "--space is missing"),
        (("/dev/ttyUSB9", "straight", "--space", "9", "9"), "nobody would measure"),
        (("missing.json", "straight"), "missing.json: there is no such file"),
        (("planar", "straight", "--out", "missing/my.yaml"), "can't be written"),
        (("/dev/ttyUSB9", "turn", "--yes", "--out", "x.txt"), "path = 'x.txt': a robot is"),
        (("planar", "turn", "--measured-deg", "nan"), "--measured-deg nan: must be"),
        (("planar", "straight", "--measured", "inf"), "--measured inf: must be"),
        (("planar", "straight", "--repeats", "0"), "--repeats 0: must be 1 or more"),
        (("planar", "all", "--repeats", "-1"), "--repeats -1: must be 1 or more"),
    ],
)
def test_what_can_not_be_done_is_one_line(
    call: Call, arguments: tuple[str, ...], said: str
) -> None:
    code, _, error = call("calibrate", *arguments)
    assert code == 2
    assert_one_line(error, said)


def test_a_reading_that_contradicts_the_odometry_is_refused(call: Call, tmp_path: Path) -> None:
    runs = tmp_path / "cal.json"
    drive = ("--distance", "0.6", "--runs", runs, "--measured")
    code, _, error = call("calibrate", "planar", "straight", *drive, "61.5")
    assert code == 2
    assert_one_line(error, "contradicts the odometry by more than 30%")
    code, said, _ = call("calibrate", runs, "straight", "--measured", "0.615")
    assert code == 0
    assert "distance 0.615 m" in said


def test_without_readings_the_runs_wait_in_their_file(call: Call, tmp_path: Path) -> None:
    runs, result = tmp_path / "cal.json", tmp_path / "r.json"
    call("calibrate", "planar", "straight", *QUICK, "--runs", runs, "--measured", "61")
    code, said, _ = call("calibrate", runs, "straight", "--json", result)
    assert code == 0
    assert "1 runs kept in" in said
    assert "--measured" in said
    told = json.loads(result.read_text(encoding="utf-8"))
    assert (told["found"], len(told["not_told"]), len(told["runs"])) == ({}, 3, 1)


def test_a_file_without_runs_is_one_line(call: Call, tmp_path: Path) -> None:
    path = tmp_path / "none.json"
    write_runs(path, [], RobotConfig.preset("acsar"))
    code, _, error = call("calibrate", path, "straight")
    assert code == 2
    assert_one_line(error, "none.json: holds no runs: drive some with --runs")


def test_over_a_serial_device(
    start_emulator: StartEmulator, robot_file: RobotFile, tmp_path: Path
) -> None:
    emulated, out = start_emulator(), tmp_path / "my.yaml"
    floor = ("--distance", "0.4", "--space", "2", "1", "--measured", "0.41")
    asked = (*floor, "--robot", robot_file())
    refused = cli("calibrate", emulated.device, "straight", *asked)
    assert refused.returncode == 2
    assert "--yes" in refused.stderr
    done = cli("calibrate", emulated.device, "straight", *asked, "--yes", "--out", out)
    assert done.returncode == 0, done.stderr
    assert emulated.is_stopped()
    assert RobotConfig.load(out).wheel_radius == pytest.approx(0.051, rel=0.04)


def test_a_lidar_measures_in_a_world(call: Call, twin: Path, tmp_path: Path) -> None:
    room, out = tmp_path / "room.yaml", tmp_path / "my.yaml"
    walls = np.array([(-2, -2, 4, -2), (4, -2, 4, 2), (4, 2, -2, 2), (-2, 2, -2, -2)], np.float64)
    save_world(World(segments=walls), room)
    asked = ("--twin", twin, "--lidar", "simulated", "--world", room, "--out", out)
    assert call("calibrate", "planar", "all", *QUICK, "--speeds", "1.2", *asked)[0] == 0
    found = RobotConfig.load(out)
    assert found.wheel_radius == pytest.approx(0.051, rel=0.01)
    assert found.wheel_separation_multiplier == pytest.approx(1.81, rel=0.01)


@pytest.mark.parametrize("kept", ["cal.json", "cal.mcap"])
def test_readings_given_later_keep_what_is_known_of_the_robot(
    call: Call, tmp_path: Path, kept: str
) -> None:
    mine, out = tmp_path / "my.yaml", tmp_path / "out.yaml"
    known = RobotConfig.preset("acsar").with_(motor={"time_constant": 0.14})
    known.save(mine)
    options = ("--record", tmp_path / "cal.mcap", "--runs", tmp_path / "cal.json", "--robot", mine)
    drive = ("--distance", "0.6", "--repeats", "1", "--measured", "0.6")
    assert call("calibrate", "planar", "straight", *drive, *options)[0] == 0
    later = (tmp_path / kept, "straight", "--measured", "0.61", "--out", out)
    assert call("calibrate", *later)[0] == 0
    assert RobotConfig.load(out).motor == known.motor


def test_without_readings_no_robot_is_written(call: Call, tmp_path: Path) -> None:
    runs, out = tmp_path / "cal.json", tmp_path / "out.yaml"
    drive = ("--distance", "0.6", "--repeats", "1", "--runs", runs)
    assert call("calibrate", "planar", "straight", *drive)[0] == 0
    told = json.loads(runs.read_text(encoding="utf-8"))
    told["runs"][0]["readings"] = []
    runs.write_text(json.dumps(told), encoding="utf-8")
    code, said, _ = call("calibrate", runs, "straight", "--out", out)
    assert code == 0
    assert f"readings: acsar-gym calibrate {runs} straight --measured ..." in said
    assert f"{out} isn't written: there are no readings yet" in said
    assert not out.exists()


def test_nothing_is_announced_where_nobody_can_be_asked(call: Call) -> None:
    arguments = ("/dev/acsar-missing", "straight", "--space", "9", "9", "--measured", "2")
    code, said, error = call("calibrate", *arguments)
    assert (code, said) == (2, "")
    assert_one_line(error, "no terminal to ask on; add --yes")
