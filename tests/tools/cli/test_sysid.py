"""The commands identify, calibrate and gap, on simulated robots and in files."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import yaml
from boards import make_link, parse_quirks
from cli_tools import Call, assert_one_line
from rollout_tools import HIDDEN, random_steps

from acsar_gym import Robot, RobotConfig, links, open_link
from acsar_gym.links import Link
from acsar_gym.recording import Recorder

pytestmark = pytest.mark.usefixtures("deadline")


def test_identify_writes_no_file_of_wheels_that_dont_obey(call: Call, tmp_path: Path) -> None:
    twin = tmp_path / "twin.yaml"
    out = tmp_path / "mine.yaml"
    swapped = {"a": {"motor": "b"}, "b": {"motor": "a"}}
    RobotConfig.preset("acsar").with_(wheels=swapped).save(twin)
    options = ("--twin", twin, "--duration", "12", "--out", out, "--anyway")
    code, _, error = call("identify", "planar", *options)
    assert code == 1
    assert_one_line(error, "front_right answers front_left's command: run 'acsar-gym doctor DEV")
    assert not out.exists()


@pytest.mark.usefixtures("inside")
def test_identify_refuses_a_board_outside_the_model_unless_anyway(
    call: Call, tmp_path: Path
) -> None:
    out = tmp_path / "mine.yaml"
    figures = tmp_path / "found.json"
    twin = tmp_path / "twin.yaml"
    RobotConfig.preset("acsar").with_(motor={"gain": 1.5}).save(twin)
    identify = ("identify", "planar", "--twin", twin, "--duration", "12", "--out", out)
    code, _, error = call(*identify, "--json", figures)
    assert code == 1
    misfit = "doesn't fit: every wheel reports 1.50 times the expected speed"
    assert_one_line(error, misfit)
    assert json.loads(figures.read_text())["model"].startswith(misfit)
    assert not out.exists()

    # A file that was written anyway has a remark, which gap and run repeat.
    assert call(*identify, "--anyway")[0] == 0
    robot = RobotConfig.load(out)
    assert robot.motor_fit.startswith(misfit)
    assert not robot.measured
    remark = "mine.yaml: this robot's simulation doesn't fit: "
    gap = ("gap", "log0.mcap", "--robot", "robot.yaml", "--before", out)
    assert remark in call(*gap)[1]
    RobotConfig.preset("acsar").with_(motor_fit="doesn't fit: holds at reversals").save(out)
    run = ("run", "0.6", "0.2", "--link", "planar", "--robot", out)
    assert f"{remark}holds at reversals" in call(*run)[1]


QUICK = ("--distance", "0.6", "--turns", "1", "--repeats", "1")


@pytest.fixture
def twin(tmp_path: Path) -> Path:
    """A robot that turns as one with a longer wheelbase, and has larger wheels."""
    path = tmp_path / "twin.yaml"
    RobotConfig.preset("acsar").with_(wheel_radius=0.051, wheelbase=0.27).save(path)
    return path


def test_calibrate_in_simulation_writes_a_robot_file(
    call: Call, twin: Path, tmp_path: Path
) -> None:
    out = tmp_path / "my.yaml"
    result = tmp_path / "result.json"
    out.write_text("# Mine, with new tyres.\nwheel_radius: 0.05   # the maker's\n")
    options = ("--twin", twin, "--out", out, "--json", result)
    code, text, _ = call("calibrate", "planar", "all", *QUICK, *options)
    assert code == 0

    first, second = out.read_text().splitlines()[:2]
    assert first == "# Mine, with new tyres."
    assert second.endswith(" # the maker's")
    assert "wheel_separation_multiplier" in text
    robot = RobotConfig.load(out)
    assert robot.wheel_radius == pytest.approx(0.051, rel=2e-3)
    assert robot.wheel_separation_multiplier == pytest.approx(1.81, rel=3e-3)
    assert robot.body.turn_factor == robot.wheel_separation_multiplier
    measured = robot.measured["wheel_separation_multiplier"]
    assert measured.low <= robot.wheel_separation_multiplier <= measured.high
    assert measured.method == "calibrate straight turn"
    assert len(measured.logs[0]) == 16
    data = json.loads(result.read_text(encoding="utf-8"))
    assert data["not_told"] == []
    assert len(data["runs"]) == 3


def test_calibrate_uses_runs_that_were_finished_before_a_stall(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A board that hangs 8 s after it began: in the turn, which takes longer."""

    def open_quirky(name: str, config: RobotConfig) -> Link:
        return make_link(name, config, parse_quirks(["frozen=8"]))

    monkeypatch.setattr(links, "open_link", open_quirky)
    out = tmp_path / "my.yaml"
    drive = ("--distance", "0.6", "--repeats", "1")
    code, text, error = call("calibrate", "planar", "all", *drive, "--out", out)
    assert code == 3
    assert "1 finished runs are used" in text
    assert "wheel_radius" in text
    assert_one_line(error, "no feedback")
    assert set(RobotConfig.load(out).measured) >= {"wheel_radius"}


def test_calibrate_with_readings_given_later(call: Call, tmp_path: Path) -> None:
    mine = tmp_path / "my.yaml"
    out = tmp_path / "out.yaml"
    record = tmp_path / "calibration.mcap"
    config = RobotConfig.preset("acsar").with_(motor={"time_constant": 0.14})
    config.save(mine)
    options = ("--record", record, "--robot", mine)
    drive = ("--distance", "0.6", "--repeats", "1", "--measured", "0.6")
    assert call("calibrate", "planar", "straight", *drive, *options)[0] == 0

    code, text, _ = call("calibrate", record, "straight")
    assert code == 0
    assert "no run has a reading" in text
    readings = ("--measured", "0.61", "--out", out)
    code, text, _ = call("calibrate", record, "all", *readings)
    assert code == 0
    assert "distance 0.610 m" in text
    assert RobotConfig.load(out).motor == config.motor
    assert RobotConfig.load(out).wheel_radius == pytest.approx(0.0496, rel=0.01)


ACSAR = RobotConfig.preset("acsar")
ROBOT = ACSAR.with_(**HIDDEN)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with recordings of the hidden robot, and its file."""
    folder = tmp_path_factory.mktemp("files")
    for seed in range(2):
        with Robot(
            open_link("planar", ROBOT), ACSAR, recorder=Recorder(folder / f"log{seed}.mcap")
        ) as robot:
            for speeds in random_steps(seed, 4.0, ACSAR):
                robot.tick(speeds)
    fitted = {**yaml.safe_load(ACSAR.model_dump_json()), **HIDDEN}
    (folder / "robot.yaml").write_text(yaml.safe_dump(fitted), encoding="utf-8")
    return folder


@pytest.fixture
def inside(files: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(files)
    return files


def test_gap_of_the_right_robot_is_small(inside: Path, call: Call) -> None:
    logs = ("log0.mcap", "log1.mcap", "--robot", "robot.yaml")
    code, out, error = call("gap", *logs, "--json", "gap.json")
    assert (code, error) == (0, "")
    assert "2 held-out episodes, 8 s: wheel speeds from" in out
    data = json.loads((inside / "gap.json").read_text())
    unfitted = data["before"]["figures"]
    fitted = data["after"]["figures"]
    assert fitted["wheel_speed_rms"] < 0.1 * unfitted["wheel_speed_rms"]
    assert fitted["end_pose"] < 0.1 * unfitted["end_pose"]


@pytest.mark.usefixtures("inside")
def test_identify_explains_a_short_log(call: Call, tmp_path: Path) -> None:
    out = tmp_path / "mine.yaml"
    code, text, error = call("identify", "log0.mcap", "--out", out)
    assert code == 1
    assert_one_line(error, "nothing to write: nothing new was found")
    assert "4.0 s of log: needs 5 s or more" in " ".join(text.split())
    assert not out.exists()
