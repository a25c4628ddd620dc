"""The commands identify, calibrate and gap, on simulated robots and in files."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from boards import make_link, parse_quirks
from sysid_tools import HIDDEN, random_steps

from acsar_gym import Robot, RobotConfig, links, open_link
from acsar_gym.links import Link
from acsar_gym.recording import Recorder

pytestmark = pytest.mark.usefixtures("deadline")

ACSAR = RobotConfig.preset("acsar")
ROBOT = ACSAR.with_(**HIDDEN)
QUICK = "--distance 0.6 --repeats 1"


def test_identify_writes_no_file_of_wheels_that_dont_obey(tmp_path: Path, call: Any) -> None:
    twin = tmp_path / "twin.yaml"
    out = tmp_path / "mine.yaml"
    swapped = {"a": {"motor": "b"}, "b": {"motor": "a"}}
    ACSAR.with_(wheels=swapped).save(twin)
    call.refuse(
        "front_right answers front_left's command: run 'acsar-gym doctor DEV",
        f"identify planar --twin {twin} --duration 12 --out {out} --anyway",
        code=1,
    )
    assert not out.exists()


@pytest.mark.usefixtures("inside")
def test_identify_refuses_a_board_outside_the_model_unless_anyway(
    call: Any, tmp_path: Path
) -> None:
    out = tmp_path / "mine.yaml"
    figures = tmp_path / "found.json"
    twin = tmp_path / "twin.yaml"
    ACSAR.with_(motor={"gain": 1.5}).save(twin)
    identify = f"identify planar --twin {twin} --duration 12 --out {out}"
    misfit = "doesn't fit: every wheel reports 1.50 times the expected speed"
    call.refuse(misfit, f"{identify} --json {figures}", code=1)
    model = json.loads(figures.read_text())["model"]
    assert model["verdict"] == f"doesn't fit: {model['pattern']}"
    assert model["verdict"].startswith(misfit)
    assert set(model) == {"verdict", "pattern", "error", "noise"}
    assert not out.exists()

    # A file that was written anyway has a remark, which gap and run repeat.
    assert call(f"{identify} --anyway")[0] == 0
    robot = RobotConfig.load(out)
    assert robot.motor_fit.startswith(misfit)
    assert not robot.measured
    remark = "mine.yaml: this robot's simulation doesn't fit: "
    assert remark in call(f"gap log0.mcap --robot robot.yaml --before {out}")[1]
    ACSAR.with_(motor_fit="doesn't fit: holds at reversals").save(out)
    assert f"{remark}holds at reversals" in call(f"run 0.6 0.2 --link planar --robot {out}")[1]


@pytest.fixture
def twin(tmp_path: Path) -> Path:
    """A robot that turns as one with a longer wheelbase, and has larger wheels."""
    path = tmp_path / "twin.yaml"
    ACSAR.with_(wheel_radius=0.051, wheelbase=0.27).save(path)
    return path


def test_calibrate_in_simulation_writes_a_robot_file(call: Any, twin: Path, tmp_path: Path) -> None:
    out = tmp_path / "my.yaml"
    result = tmp_path / "result.json"
    out.write_text("# Mine, with new tyres.\nwheel_radius: 0.05   # the maker's\n")
    files = f"--twin {twin} --out {out} --json {result}"
    code, text, _ = call(f"calibrate planar all {QUICK} --turns 1 {files}")
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
    call: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A board that hangs 8 s after it began: in the turn, which takes longer."""

    def open_quirky(name: str, config: RobotConfig) -> Link:
        return make_link(name, config, parse_quirks(["frozen=8"]))

    monkeypatch.setattr(links, "open_link", open_quirky)
    out = tmp_path / "my.yaml"
    calibrate = f"calibrate planar all {QUICK} --out {out}"
    text = call.refuse("no feedback", calibrate, code=3)
    assert "1 finished runs are used" in text
    assert "wheel_radius" in text
    assert set(RobotConfig.load(out).measured) >= {"wheel_radius"}


def test_calibrate_points_to_a_recording_only_if_there_is_one(
    call: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    def open_quirky(name: str, config: RobotConfig) -> Link:
        return make_link(name, config, parse_quirks(["frozen=8"]))

    monkeypatch.setattr(links, "open_link", open_quirky)
    calibrate = f"calibrate planar all {QUICK} --speeds 1 --measured-deg 1800"
    text = call.refuse("no feedback", calibrate, code=3)
    assert "no run has a reading" in text
    assert "later" not in text


def test_calibrate_needs_a_radius(call: Any) -> None:
    call.refuse("--radii: name a radius", "calibrate planar turn --radii")


@pytest.mark.usefixtures("inside")
@pytest.mark.parametrize("option", ["--twin acsar", "--record new.mcap", "--view", "--duration 5"])
def test_recordings_refuse_options_for_driving(option: str, call: Any) -> None:
    refusal = f"{option.partition(' ')[0]} is for driving a robot; recordings are only read"
    call.refuse(refusal, f"identify log0.mcap {option}")
    if option != "--duration 5":
        call.refuse(refusal, f"calibrate log0.mcap straight {option}")


def test_calibrate_with_readings_given_later(call: Any, tmp_path: Path) -> None:
    mine = tmp_path / "my.yaml"
    out = tmp_path / "out.yaml"
    record = tmp_path / "calibration.mcap"
    config = ACSAR.with_(motor={"time_constant": 0.14})
    config.save(mine)
    drive = f"{QUICK} --measured 0.6 --record {record} --robot {mine}"
    assert call(f"calibrate planar straight {drive}")[0] == 0

    assert "no run has a reading" in call(f"calibrate {record} straight")[1]
    code, text, _ = call(f"calibrate {record} all --measured 0.61 --out {out}")
    assert code == 0
    assert "distance 0.610 m" in text
    assert RobotConfig.load(out).motor == config.motor
    assert RobotConfig.load(out).wheel_radius == pytest.approx(0.0496, rel=0.01)


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
    ROBOT.save(folder / "robot.yaml")
    return folder


@pytest.fixture
def inside(files: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(files)
    return files


def test_gap_of_the_right_robot_is_small(inside: Path, call: Any) -> None:
    out = call.succeed("gap log0.mcap log1.mcap --robot robot.yaml --json gap.json")
    assert "2 held-out episodes, 8 s: wheel speeds from" in out
    data = json.loads((inside / "gap.json").read_text())
    assert [line.partition(", ")[0] for line in data["conclusion"]] == ["2 held-out episodes"]
    unfitted = data["before"]["figures"]
    fitted = data["after"]["figures"]
    assert fitted["wheel_speed_rms"] < 0.1 * unfitted["wheel_speed_rms"]
    assert fitted["end_pose"] < 0.1 * unfitted["end_pose"]


@pytest.mark.usefixtures("inside")
def test_identify_explains_a_short_log(tmp_path: Path, call: Any) -> None:
    out = tmp_path / "mine.yaml"
    nothing = "nothing to write: nothing new was found"
    text = call.refuse(nothing, f"identify log0.mcap --out {out}", code=1)
    assert "4.0 s of log: needs 5 s or more" in " ".join(text.split())
    assert not out.exists()
