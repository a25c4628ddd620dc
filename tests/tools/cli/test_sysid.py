"""The commands identify, calibrate and gap, on simulated robots and in files."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import yaml
from boards import make_link, parse_quirks
from cli_tools import Call, assert_one_line
from rollout_tools import HIDDEN, random_steps
from serial_tools import TRIALS, RobotFile, StartEmulator, cli

from acsar_gym import Robot, RobotConfig, links, open_link
from acsar_gym.links import Link
from acsar_gym.recording import Recorder

pytestmark = pytest.mark.usefixtures("deadline")


@pytest.fixture(scope="module")
def short(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of 2 s."""
    path = tmp_path_factory.mktemp("short") / "short.mcap"
    config = RobotConfig.preset("acsar")
    with Robot(open_link("planar", config), config, recorder=Recorder(path)) as robot:
        for tick in range(200):
            speed = 4.0 if tick % 50 < 25 else -4.0
            robot.tick((speed, -speed, speed, -speed))
    return path


def test_a_short_log_has_reasons_and_no_file(short: Path, call: Call, tmp_path: Path) -> None:
    out, figures = tmp_path / "mine.yaml", tmp_path / "found.json"
    code, said, error = call("identify", str(short), "--out", str(out), "--json", str(figures))
    assert code == 1
    assert_one_line(error, "nothing to write: nothing new was found")
    assert "2.0 s of log: needs 5 s or more" in " ".join(said.split())
    told = {one["name"] for one in json.loads(figures.read_text())["findings"] if one["told"]}
    assert told == {"firmware.feedback_rate"}
    assert not out.exists()


@pytest.mark.parametrize(
    "option",
    [
        ("--twin", "acsar"),
        ("--record", "new.mcap"),
        ("--duration", "5"),
    ],
    ids=lambda option: str(option[0]),
)
def test_options_of_driving_are_refused_with_recordings(
    short: Path, call: Call, option: tuple[str, str]
) -> None:
    commands: list[tuple[Any, ...]] = [("identify", short)]
    if option[0] != "--duration":
        commands.append(("calibrate", short, "straight"))
    for asked in commands:
        code, _, error = call(*asked, *option)
        assert code == 2
        assert_one_line(error, f"{option[0]} is for driving a robot; recordings are only read")


def test_a_robot_whose_wheels_are_dead_has_no_file(call: Call, tmp_path: Path) -> None:
    twin, out = tmp_path / "twin.yaml", tmp_path / "mine.yaml"
    RobotConfig.preset("acsar").with_(motor={"deadband": 30.0}).save(twin)
    options = ("--twin", twin, "--duration", "12", "--out", out, "--anyway")
    code, _, error = call("identify", "planar", *options)
    assert code == 1
    assert_one_line(error, "nothing to write: no wheel turned")
    assert not out.exists()


def test_a_miswired_robot_is_refused(call: Call, tmp_path: Path) -> None:
    twin, out = tmp_path / "twin.yaml", tmp_path / "mine.yaml"
    RobotConfig(wheels={"a": {"motor": "b"}, "b": {"motor": "a"}}).save(twin)
    options = ("--twin", twin, "--duration", "12", "--out", out)
    code, _, error = call("identify", "planar", *options)
    assert code == 1
    assert_one_line(error, "front_right answers front_left's command: run 'acsar-gym doctor DEV")
    assert not out.exists()


@pytest.mark.usefixtures("inside")
def test_a_board_outside_the_model_is_refused_unless_asked(call: Call, tmp_path: Path) -> None:
    out, figures = tmp_path / "mine.yaml", tmp_path / "found.json"
    twin = tmp_path / "twin.yaml"
    RobotConfig.preset("acsar").with_(motor={"gain": 1.5}).save(twin)
    asked = ("identify", "planar", "--twin", twin, "--duration", "12")
    code, said, error = call(*asked, "--out", out, "--json", figures)
    assert code == 1
    misfit = "doesn't fit: every wheel reports 1.50 times the expected speed"
    assert_one_line(error, misfit)
    assert misfit in " ".join(said.split())
    assert json.loads(figures.read_text())["model"].startswith(misfit)
    assert not out.exists()
    assert call(*asked, "--out", out, "--anyway")[0] == 0
    written = RobotConfig.load(out)
    assert written.motor_fit.startswith(misfit)
    assert not written.measured
    again = "mine.yaml: this robot's simulation doesn't fit: "
    gap = ("gap", "log0.mcap", "--robot", "robot.yaml", "--before", out, "--json", figures)
    assert again in call(*gap, "--force")[1]
    assert any(note.startswith(again) for note in json.loads(figures.read_text())["notes"])
    RobotConfig.preset("acsar").with_(motor_fit="doesn't fit: holds at reversals").save(out)
    drive = ("run", "0.6", "0.2", "--link", "planar", "--robot", out)
    assert again + "holds at reversals" in call(*drive)[1]


QUICK = ("--distance", "0.6", "--turns", "1", "--repeats", "1")


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
    out.write_text("# Mine, with new tyres.\nwheel_radius: 0.05   # the maker's\n")
    code, said, _ = call(
        "calibrate", "planar", "all", *QUICK, "--twin", twin, "--out", out, "--json", result
    )
    assert code == 0
    first, second = out.read_text().splitlines()[:2]
    assert first == "# Mine, with new tyres."
    assert second.endswith(" # the maker's")
    assert "wheel_separation_multiplier" in said
    found = RobotConfig.load(out)
    assert found.wheel_radius == pytest.approx(0.051, rel=2e-3)
    assert found.wheel_separation_multiplier == pytest.approx(1.81, rel=3e-3)
    assert found.body.turn_factor == found.wheel_separation_multiplier
    measured = found.measured["wheel_separation_multiplier"]
    assert measured.low <= found.wheel_separation_multiplier <= measured.high
    assert measured.method == "calibrate straight turn"
    assert len(measured.logs[0]) == 16
    told = json.loads(result.read_text(encoding="utf-8"))
    assert told["not_told"] == []
    assert len(told["runs"]) == 3


def test_runs_that_were_finished_before_a_stall_are_used(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A board that hangs 8 s after it began: in the turn, which takes longer."""

    def open_quirky(name: str, config: RobotConfig) -> Link:
        return make_link(name, config, parse_quirks(["frozen=8"]))

    monkeypatch.setattr(links, "open_link", open_quirky)
    out, drive = tmp_path / "my.yaml", ("--distance", "0.6", "--repeats", "1")
    code, said, error = call("calibrate", "planar", "all", *drive, "--out", out)
    assert code == 3
    assert "1 finished runs are used" in said
    assert "wheel_radius" in said
    assert_one_line(error, "no feedback")
    assert set(RobotConfig.load(out).measured) >= {"wheel_radius"}


def test_a_reading_that_contradicts_the_odometry_is_refused(call: Call) -> None:
    drive = ("--distance", "0.6", "--measured", "61.5")
    code, _, error = call("calibrate", "planar", "straight", *drive)
    assert code == 2
    assert_one_line(error, "contradicts the odometry by more than 30%")


def test_over_a_serial_device(
    start_emulator: StartEmulator, robot_file: RobotFile, tmp_path: Path
) -> None:
    emulated, out = start_emulator(), tmp_path / "my.yaml"
    floor = ("--distance", "0.4", "--space", "2", "1", "--measured", "0.41")
    asked = (*floor, "--robot", robot_file())
    refused = cli("calibrate", emulated.device, "straight", *asked)
    assert refused.returncode == 2
    assert "--yes" in refused.stderr
    for _ in range(TRIALS):
        done = cli("calibrate", emulated.device, "straight", *asked, "--yes", "--out", out)
        assert done.returncode == 0, done.stderr
        assert emulated.is_stopped()
        found = RobotConfig.load(out).wheel_radius
        if found == pytest.approx(0.051, rel=0.04):
            break
    assert found == pytest.approx(0.051, rel=0.04)


def test_readings_given_later_keep_what_is_known_of_the_robot(call: Call, tmp_path: Path) -> None:
    mine, out, record = (tmp_path / name for name in ("my.yaml", "out.yaml", "cal.mcap"))
    known = RobotConfig.preset("acsar").with_(motor={"time_constant": 0.14})
    known.save(mine)
    options = ("--record", record, "--robot", mine)
    drive = ("--distance", "0.6", "--repeats", "1", "--measured", "0.6")
    assert call("calibrate", "planar", "straight", *drive, *options)[0] == 0
    code, said, _ = call("calibrate", record, "straight")
    assert code == 0
    assert "no run has a reading" in said
    code, said, _ = call("calibrate", record, "all", "--measured", "0.61", "--out", out)
    assert code == 0
    assert "distance 0.610 m" in said
    assert RobotConfig.load(out).motor == known.motor
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


def test_the_right_robot_has_nearly_no_gap(inside: Path, call: Call) -> None:
    logs = ("log0.mcap", "log1.mcap", "--robot", "robot.yaml")
    code, out, error = call("gap", *logs, "--json", "gap.json")
    assert (code, error) == (0, "")
    assert "2 held-out episodes, 8 s: wheel speeds from" in out
    told = json.loads((inside / "gap.json").read_text())
    before, after = (told[side]["figures"] for side in ("before", "after"))
    assert after["wheel_speed_rms"] < 0.1 * before["wheel_speed_rms"]
    assert after["end_pose"] < 0.1 * before["end_pose"]


def test_a_cut_recording_is_used_as_far_as_it_goes(inside: Path, call: Call) -> None:
    whole = (inside / "log0.mcap").read_bytes()
    (inside / "half.mcap").write_bytes(whole[: len(whole) * 2 // 3])
    code, out, error = call("gap", "half.mcap", "--robot", "robot.yaml")
    assert code == 0, error
    assert "half.mcap: its end is missing" in out
